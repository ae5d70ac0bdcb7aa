"""Cameras of COLMAP's models on disk: cameras.txt and cameras.bin, and which photo has which camera.

Read here and not by COLMAP, which ends the process on some damaged models.
"""

import struct
from collections.abc import Iterator
from pathlib import Path

from sfm_app.geometry.lenses.camera_models import PARAMETERS, calibration_from_model
from sfm_app.types import Calibration

CAMERA_FILES = ("cameras.bin", "cameras.txt")
"""Names of COLMAP's files of cameras; COLMAP, too, prefers the first."""
MODEL_IDS = {
    0: "SIMPLE_PINHOLE", 1: "PINHOLE", 2: "SIMPLE_RADIAL", 3: "RADIAL", 4: "OPENCV", 5: "OPENCV_FISHEYE",
    6: "FULL_OPENCV", 8: "SIMPLE_RADIAL_FISHEYE", 9: "RADIAL_FISHEYE", 10: "THIN_PRISM_FISHEYE", 14: "SIMPLE_FISHEYE",
    15: "FISHEYE", 17: "EQUIRECTANGULAR",
}  # fmt: skip
"""COLMAP's numbers of the models that a run can use. By definition."""
MOST_CAMERAS, LONGEST_NAME = 1_000_000, 4096
DAMAGED = "its bytes are not those of a COLMAP model"


def read_colmap_text(text: str) -> dict[str, Calibration]:
    """Return the cameras of a cameras.txt by their ids.

    Raises:
        ValueError: a line is no camera.
    """
    found = {}
    for line in _lines(text):
        words = line.split()
        if len(words) < 5 or not words[1].isupper():
            raise ValueError(f"'{line[:60]}' is not a line of COLMAP's cameras.txt")
        try:
            size, params = (int(words[2]), int(words[3])), [float(word) for word in words[4:]]
        except ValueError:
            raise ValueError(f"'{line[:60]}' has something else than numbers after the model") from None
        found[words[0]] = calibration_from_model(words[1], params, size)
    return found


def read_colmap_binary(data: bytes) -> dict[str, Calibration]:
    """Return the cameras of a cameras.bin by their ids.

    Raises:
        ValueError: the bytes are not those of one, or no run can use a camera.
    """
    found, reader = {}, _Reader(data)
    (count,) = reader.take("<Q")
    if count > MOST_CAMERAS:
        raise ValueError(DAMAGED)
    for _ in range(int(count)):
        camera_id, model_id, width, height = reader.take("<IiQQ")
        if model_id not in MODEL_IDS:
            raise ValueError(f"camera {camera_id} has a model that cannot be used: only {', '.join(PARAMETERS)}")
        model = MODEL_IDS[int(model_id)]
        params = reader.take(f"<{len(PARAMETERS[model])}d")
        found[str(camera_id)] = calibration_from_model(model, params, (int(width), int(height)))
    return found


def read_colmap_folder(folder: Path) -> tuple[dict[str, Calibration], dict[str, str]]:
    """Return the cameras of a model by their ids, and the id by photo where there is a file of its images.

    Args:
        folder: holds one of `CAMERA_FILES`.

    Raises:
        OSError: a file cannot be read.
        ValueError: a file is damaged, or no run can use a camera.
    """
    if (folder / "cameras.bin").is_file():
        images = folder / "images.bin"
        known = dict(_binary_images(images.read_bytes())) if images.is_file() else {}
        return read_colmap_binary((folder / "cameras.bin").read_bytes()), known
    images = folder / "images.txt"
    known = dict(_text_images(images.read_text(encoding="utf-8"))) if images.is_file() else {}
    return read_colmap_text((folder / "cameras.txt").read_text(encoding="utf-8")), known


def _lines(text: str) -> list[str]:
    """Return the lines that are no comments; an image without points leaves an empty one, which counts."""
    return [line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]


def _text_images(text: str) -> Iterator[tuple[str, str]]:
    """Yield photos and the ids of their cameras from images.txt, where each photo has two lines."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    for line in lines[::2]:
        words = line.split(maxsplit=9)
        if words:
            if len(words) < 10:
                raise ValueError(f"'{line[:60]}' is not a line of COLMAP's images.txt")
            yield words[9].strip(), words[8]


def _binary_images(data: bytes) -> Iterator[tuple[str, str]]:
    """Yield photos and the ids of their cameras from images.bin."""
    reader = _Reader(data)
    (count,) = reader.take("<Q")
    for _ in range(int(count)):
        *_, camera_id = reader.take("<I7dI")
        name = reader.take_text()
        (points,) = reader.take("<Q")
        reader.skip(24 * int(points))
        yield name, str(camera_id)


class _Reader:
    """Bytes that are taken one value after the other; ValueError at their end."""

    def __init__(self, data: bytes) -> None:
        self.data, self.place = data, 0

    def take(self, form: str) -> tuple[float, ...]:
        start = self.place
        self.skip(struct.calcsize(form))
        return struct.unpack_from(form, self.data, start)

    def take_text(self) -> str:
        end = self.data.find(b"\0", self.place, self.place + LONGEST_NAME)
        if end < 0:
            raise ValueError(DAMAGED)
        text = self.data[self.place : end].decode("utf-8", "replace")
        self.place = end + 1
        return text

    def skip(self, count: int) -> None:
        if self.place + count > len(self.data):
            raise ValueError(DAMAGED)
        self.place += count
