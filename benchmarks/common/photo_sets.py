"""Photo sets for calibration: copies without metadata, changed as requested, and their ground truth.

A change is written as steps joined by "+": ``crop:LEFT,TOP`` cuts columns and rows, ``scale:SX,SY`` resizes, and
``window:LEFT,TOP,WIDTH,HEIGHT`` keeps a part. Three steps bring photos of any size to one size, as web services do:
``pad:W,H`` fits the photo in with black bars on both sides, ``corner:W,H`` puts it at the top left, and
``fill:W,H`` covers the frame and cuts off the rest.
"""

import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

FORMATS = (".jpg", ".jpeg", ".png")
STEPS = {"crop": 2, "scale": 2, "window": 4, "pad": 2, "corner": 2, "fill": 2}
"""Kinds of change, and how many numbers each takes."""
ONE_SIZE = ("pad", "corner", "fill")
"""Kinds after which all photos have one size."""

Step = tuple[str, tuple[float, ...]]


def link_or_copy(photo: Path, folder: Path) -> None:
    """Hard-link a photo into another folder, or copy it; the program skips symbolic links out of a folder."""
    place = folder / photo.name
    if not place.exists():
        try:
            os.link(photo.resolve(), place)
        except OSError:
            shutil.copyfile(photo, place)


EVERY = "every:"
"""Prefix of ``every:N``, which takes every Nth photo by name and changes no pixels."""


def stride(text: str) -> int:
    """Return the stride at which a change takes photos, 1 where it names none.

    Raises:
        ValueError: the stride is not positive.
    """
    found = [int(part.removeprefix(EVERY)) for part in text.split("+") if part.startswith(EVERY)]
    if any(number < 1 for number in found):
        raise ValueError(f"'{text}': N of every:N must be at least 1")
    return math.prod(found)


class TrueCamera(NamedTuple):
    """The true camera of a photo."""

    K: NDArray[np.float64]
    k1: float | None = None
    """k1 of COLMAP's SIMPLE_RADIAL; None where it is unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotoSet:
    """Photos without EXIF."""

    name: str
    """Name of the set, a space, and the change."""
    folder: Path
    truth: Mapping[str, TrueCamera]
    """By photo name without suffix; empty where it is unknown."""
    cameras: str = "auto"
    """Which photos share a camera, as in the setting `photos.cameras`."""
    cameras_given: bool = True
    """Whether the program is given `cameras`."""


def steps(text: str) -> list[Step]:
    """Parse the steps of a change.

    Raises:
        ValueError: a kind is unknown, or has the wrong number of values.
    """
    found = []
    for part in (part for part in text.split("+") if part and not part.startswith(EVERY)):
        kind, _, figures = part.partition(":")
        values = tuple(float(value) for value in figures.split(","))
        if STEPS.get(kind) != len(values):
            raise ValueError(
                f"'{part}' is not one of crop:LEFT,TOP scale:SX,SY window:LEFT,TOP,WIDTH,HEIGHT pad:W,H corner fill"
            )
        found.append((kind, values))
    return found


class Frame(NamedTuple):
    """Where a resized photo lies in its frame."""

    size: tuple[int, int]
    """Size of the resized photo."""
    left: int
    top: int
    """Left and top of its first pixel; negative where it is cut off."""


def place_in_frame(kind: str, size: tuple[int, int], wanted: Sequence[float]) -> Frame:
    """Return where a photo of `size` lies in a frame of the `wanted` size; `kind` is one of `ONE_SIZE`."""
    ratios = [side / own for side, own in zip(wanted, size, strict=True)]
    factor = max(ratios) if kind == "fill" else min(ratios)
    width, height = (round(factor * own) for own in size)
    spare = (0, 0) if kind == "corner" else (round(wanted[0]) - width, round(wanted[1]) - height)
    return Frame((width, height), spare[0] // 2, spare[1] // 2)


def changed_size(size: tuple[int, int], step: Step) -> tuple[int, int]:
    """Return the width and height of a photo after a step."""
    kind, values = step
    if kind == "scale":
        return round(size[0] * values[0]), round(size[1] * values[1])
    if kind == "crop":
        return size[0] - round(values[0]), size[1] - round(values[1])
    return round(values[-2]), round(values[-1])


def changed_photo(image: Image.Image, change: Sequence[Step]) -> Image.Image:
    """Apply the steps to a photo."""
    for kind, values in change:
        after = changed_size(image.size, (kind, values))
        if kind == "scale":
            image = image.resize(after, Image.Resampling.LANCZOS)
        elif kind in ONE_SIZE:
            place = place_in_frame(kind, image.size, values)
            frame = Image.new(image.mode, after)
            frame.paste(image.resize(place.size, Image.Resampling.LANCZOS), (place.left, place.top))
            image = frame
        else:
            left, top = round(values[0]), round(values[1])
            image = image.crop((left, top, left + after[0], top + after[1]))
    return image


def changed_camera(K: NDArray[np.float64], change: Sequence[Step], size: tuple[int, int]) -> NDArray[np.float64]:
    """Return the camera matrix of a photo of `size` after these steps; pixel centers at +0.5, so scaling multiplies."""
    K = K.copy()
    for kind, values in change:
        if kind == "scale":
            K[:2] *= np.array(values)[:, None]
        elif kind in ONE_SIZE:
            place = place_in_frame(kind, size, values)
            K[:2] *= np.array([[own / before] for own, before in zip(place.size, size, strict=True)])
            K[:2, 2] += place.left, place.top
        else:
            K[:2, 2] -= values[:2]
        size = changed_size(size, (kind, values))
    return K


def photo_set(data: Path, name: str, change: str, cache: Path, cameras: str = "auto") -> PhotoSet:
    """Make a set of DATA after a change; the copies stay in the cache, and existing ones are not written again.

    Where all photos come from one camera (`cameras` is not "each"), the truth is its median over the photos.
    """
    todo = steps(change)
    title = f"{name} {change}".strip()
    folder = cache / "photos" / title.translate(str.maketrans(" :,", "_--"))
    sources = [path for path in sorted((data / name / "images").iterdir()) if path.suffix.lower() in FORMATS]
    for source in sources[:: stride(change)]:
        target = folder / f"{source.stem}.png"
        if not target.exists():
            save_without_exif(source, target, todo)
    truth = dict(_true_cameras(data / name / "cameras.json", todo))
    if truth and cameras != "each":
        K = np.median([camera.K for camera in truth.values()], axis=0)
        truth = {photo: TrueCamera(K, camera.k1) for photo, camera in truth.items()}
    return PhotoSet(title, folder, truth, cameras, cameras_given=not any(kind in ONE_SIZE for kind, _ in todo))


def save_without_exif(source: Path, target: Path, change: Sequence[Step]) -> None:
    """Save a photo upright, changed, and without metadata: PNG keeps all pixels, and no EXIF is passed on."""
    with Image.open(source) as image:
        upright = ImageOps.exif_transpose(image).convert("RGB")
    target.parent.mkdir(parents=True, exist_ok=True)
    unfinished = target.with_suffix(".part")
    pixels = np.asarray(changed_photo(upright, change))
    Image.fromarray(pixels).save(unfinished, format="PNG", compress_level=1)
    unfinished.replace(target)


def _true_cameras(path: Path, change: Sequence[Step]) -> Iterator[tuple[str, TrueCamera]]:
    if not path.exists():
        return
    square = all(values[0] == values[1] for kind, values in change if kind == "scale")
    for entry in json.loads(path.read_text(encoding="utf-8"))["images"]:
        k1 = float(entry["dist"][0]) if square and entry.get("dist") else None
        K = changed_camera(np.array(entry["K"], np.float64), change, (entry["width"], entry["height"]))
        yield Path(entry["file"]).stem, TrueCamera(K, k1)
