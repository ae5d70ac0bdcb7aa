"""Which photos each camera of a calibration file took, and that camera for the size of these photos."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from sfm_app.errors import InputError
from sfm_app.types import Calibration, GivenCameras, MatchedImage, MatchGraph
from sfm_app.types.calibration import EQUIRECTANGULAR, KEPT

ROUNDING_PX = 1.0
"""Largest difference in pixels of the shorter side of photos that were only scaled: sizes are whole pixels. By
definition."""


@dataclass(frozen=True, slots=True)
class AssignedCameras:
    """Given cameras of some photos."""

    cameras: Mapping[str, Calibration] = field(default_factory=dict)
    """By camera group, in pixels of its photos."""
    notes: tuple[str, ...] = ()
    """Remarks for the user: which cameras were scaled, and which photos have none and why."""


def assign_cameras(matches: MatchGraph, given: GivenCameras, *, keep: bool) -> AssignedCameras:
    """Return the given camera of every camera group that has one.

    A group has the camera that the file names for its photos, or by the name of the group; else the only one of the
    file, or the only one of the size or the shape of its photos.

    Args:
        matches: has the photos.
        given: contents of the calibration file.
        keep: whether the user wants the cameras unchanged.

    Raises:
        InputError: the file has no camera for any of the photos.
    """
    if not given:
        return AssignedCameras()
    groups: dict[str, list[MatchedImage]] = {}
    for _, image in sorted(matches.images.items()):
        groups.setdefault(image.group, []).append(image)
    cameras, notes, refused = {}, [], []
    for group, images in groups.items():
        if images[0].projection == EQUIRECTANGULAR:
            continue  # nothing about a panorama is unknown
        name, why = _choose_name(group, images, given)
        found, note = fit_to_photos(given.cameras[name], images[0]) if name is not None else (None, why)
        if found is None:
            refused.append(f"the photos {group} have no given camera: {note}")
        else:
            cameras[group] = replace(found, method=KEPT) if keep else found
            notes += [f"the given camera of the photos {group} is scaled: {note}"] if note else []
    if not cameras and refused:
        raise InputError(f"{given.source} fits no photo: {refused[0]}", hint="leave --calibration out to do without")
    return AssignedCameras(cameras, (*notes, *refused))


def fit_to_photos(camera: Calibration, image: MatchedImage) -> tuple[Calibration | None, str]:
    """Return a camera in pixels of a photo, and a note if it was scaled; None with the reason where it cannot be.

    Photos of another shape were cropped, nobody knows where.

    Args:
        camera: for photos of its own size; of any size where that is 0.
        image: one of the photos.
    """
    size = image.width, image.height
    if camera.projection == EQUIRECTANGULAR:
        return None, "the file's camera is that of panoramas, which these photos are not"
    if not camera.width:
        cx, cy = camera.K[:2, 2]
        inside = 0.0 < cx < size[0] and 0.0 < cy < size[1]
        says = f"its optical center lies outside of {size[0]} x {size[1]} pixels"
        return (replace(camera, width=size[0], height=size[1]), "") if inside else (None, says)
    left, top, *shown = image.shown or (0, 0, *size)
    for frame in ((0, 0, *size), (left, top, *shown)):
        across, down = frame[2] / camera.width, frame[3] / camera.height
        if abs(across * camera.height - frame[3]) <= ROUNDING_PX or abs(down * camera.width - frame[2]) <= ROUNDING_PX:
            return _scale(camera, across, down, frame[:2], size)
    turned = camera.width * size[0] == camera.height * size[1]
    return None, (
        f"the file's camera took photos of {camera.width} x {camera.height} pixels, these have {size[0]} x {size[1]}: "
        f"they were {'turned' if turned else 'cropped, or are from another camera'}"
    )


def _scale(
    camera: Calibration, across: float, down: float, corner: tuple[int, ...], size: tuple[int, int]
) -> tuple[Calibration, str]:
    """Return a camera for photos of another size whose picture begins at a corner, and a note."""
    K = camera.K.copy()
    K[0] *= across
    K[1] *= down
    K[:2, 2] += corner
    factors = {"fx": across, "fy": down, "cx": across, "cy": down}
    spread = {name: value * factors.get(name, 1.0) for name, value in camera.spread.items()}
    scaled = (across, down) != (1.0, 1.0)
    note = f"from {camera.width} x {camera.height} to {size[0]} x {size[1]} pixels" if scaled else ""
    return replace(camera, K=K, width=size[0], height=size[1], spread=spread), note


def _choose_name(group: str, images: Sequence[MatchedImage], given: GivenCameras) -> tuple[str | None, str]:
    """Return the name of a group's camera in the file; None with the reason where it has none."""
    named = {given.camera_name(image.name) for image in images} - {None}
    if len(named) == 1:
        return named.pop(), ""
    if len(named) > 1:
        return None, f"the file has several cameras for them: {', '.join(sorted(map(str, named)))}"
    if group in given.cameras:
        return group, ""
    if len(given.cameras) == 1:
        return next(iter(given.cameras)), ""
    size = images[0].width, images[0].height
    same = [name for name, one in given.cameras.items() if (one.width, one.height) == size]
    alike = [name for name, one in given.cameras.items() if fit_to_photos(one, images[0])[0] is not None]
    for names in (same, alike):
        if len(names) == 1:
            return names[0], ""
    if not alike:
        return None, f"none of the file's {len(given.cameras)} cameras took photos of the shape {size[0]} x {size[1]}"
    return None, f"{len(alike)} cameras of the file fit them, and none is named '{group}'"
