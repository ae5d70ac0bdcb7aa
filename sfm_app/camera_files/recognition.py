"""Recognize the form of a calibration file by its content, and read it."""

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from sfm_app.camera_files.colmap_files import CAMERA_FILES, read_colmap_binary, read_colmap_folder, read_colmap_text
from sfm_app.camera_files.opencv_files import is_opencv_camera, opencv_camera, read_file_storage
from sfm_app.camera_files.opensfm_files import is_opensfm_camera, opensfm_camera
from sfm_app.camera_files.run_files import is_run_camera, is_run_file, run_camera, run_file_cameras
from sfm_app.errors import InputError
from sfm_app.hashing import fingerprint
from sfm_app.types import Calibration, GivenCameras

FORMS = (
    "known are: calibration.json, scene.json or an output folder of sfm-app; COLMAP's cameras.txt or cameras.bin, or a "
    "folder with one; OpenCV's JSON, YAML or XML with camera_matrix and dist_coeffs; OpenSfM's camera_models.json and "
    "ODM's cameras.json"
)
MOST_BYTES = 10_000_000
"""Most bytes of a calibration file. One with a camera for each of a thousand photos has a tenth."""
RUN_FILES = ("scene.json", "calibration.json")
"""Files of an output folder, the better one first."""

Cameras = tuple[dict[str, Calibration], dict[str, str]]
"""Cameras by name, and the name of the camera by photo."""


def read_given_cameras(path: Path) -> GivenCameras:
    """Read a calibration file of any known form, or a folder that holds one.

    Args:
        path: file or folder.

    Raises:
        InputError: it is missing, of no known form, or holds values that are no camera.
    """
    try:
        form, (cameras, camera_of) = _read_folder(path) if path.is_dir() else _read_file(path)
        if not cameras:
            raise ValueError("it holds no camera that is known")
    except OSError as err:
        raise InputError(f"cannot read the calibration file {path}: {err.strerror}", hint=FORMS) from err
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError, RecursionError) as err:
        # Values of other programs may have any type, and any depth.
        reason = str(err) if type(err) is ValueError else "it is of no known form"
        raise InputError(f"{path} is no calibration file: {reason}", hint=FORMS) from err
    known = {name: camera.to_dict() for name, camera in cameras.items()}
    used = {photo: name for photo, name in camera_of.items() if name in cameras}
    return GivenCameras(cameras, used, f"{path} ({form})", fingerprint(known, used))


def _read_folder(folder: Path) -> tuple[str, Cameras]:
    for name in RUN_FILES:
        if (folder / name).is_file():
            return _read_file(folder / name)
    if not any((folder / name).is_file() for name in CAMERA_FILES):
        raise ValueError(f"the folder holds none of {', '.join((*RUN_FILES, *CAMERA_FILES))}")
    return "COLMAP", read_colmap_folder(folder)


def _read_file(path: Path) -> tuple[str, Cameras]:
    with path.open("rb") as file:
        data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise ValueError(f"it is larger than {MOST_BYTES // 1_000_000} MB")
    if b"\0" in data:
        return "COLMAP", (read_colmap_binary(data), {})
    try:
        text = data.decode("utf-8-sig").strip()
    except UnicodeDecodeError:
        raise ValueError("it is neither text nor COLMAP's cameras.bin") from None
    if text.startswith(("%YAML", "<?xml", "<opencv_storage")):
        return "OpenCV", ({"": opencv_camera(read_file_storage(text))}, {})
    if text.startswith(("{", "[")):
        return _read_json(text)
    return "COLMAP", (read_colmap_text(text), {})


def _read_json(text: str) -> tuple[str, Cameras]:
    try:
        values: Any = json.loads(text)
    except ValueError as err:
        raise ValueError(f"it is not valid JSON: {err}") from None
    if not isinstance(values, Mapping):
        raise ValueError("its JSON is not an object")
    if is_run_file(values):
        return "sfm-app", run_file_cameras(values)
    if is_run_camera(values):
        camera = run_camera(values)
        return "sfm-app", ({"": camera} if camera is not None else {}, {})
    if is_opencv_camera(values):
        return "OpenCV", ({"": opencv_camera(values)}, {})
    for form, fits, read in _BY_NAME:
        if values and all(isinstance(entry, Mapping) and fits(entry) for entry in values.values()):
            return form, (dict(_read_by_name(values, read)), {})
    raise ValueError("its JSON is of no known form")


_BY_NAME: tuple[tuple[str, Callable[..., bool], Callable[..., Calibration | None]], ...] = (
    ("sfm-app", is_run_camera, run_camera),
    ("OpenSfM", is_opensfm_camera, opensfm_camera),
    ("OpenCV", is_opencv_camera, opencv_camera),
)
"""Forms of JSON with cameras by name: what tells that an entry is of it, and what reads the entry."""


def _read_by_name(
    values: Mapping[str, Any], read: Callable[..., Calibration | None]
) -> Iterator[tuple[str, Calibration]]:
    """Yield the cameras by name; an error names its camera."""
    for name, entry in values.items():
        try:
            camera = read(entry)
        except ValueError as err:
            raise ValueError(f"camera '{name[:60]}': {err}") from None
        if camera is not None:
            yield name, camera
