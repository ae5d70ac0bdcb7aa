"""Cameras of a photo set: which photos share one, and the K of each.

Ours; the thesis takes one camera for all photos (5.5.2).
"""

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, count

import numpy as np

from sfm_app.camera.models import guessed_camera_matrix
from sfm_app.numerical import FAILURES, error_reason
from sfm_app.selfcal.consensus import Consensus
from sfm_app.selfcal.groups import CameraGroup, VoteTables, calibrate_cameras
from sfm_app.selfcal.other_cameras import cross_validate, divide_photos, peak_cameras, split_by_focal
from sfm_app.selfcal.pairs import (
    ESTIMATE,
    calibration_from_parameters,
    downgrade_to_estimate,
    guess_calibration,
    parameters_from_calibration,
    prepare,
    undistort_pairs,
)
from sfm_app.selfcal.zero_curves import METHOD
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs, PairId, PhotoPairs
from sfm_app.types.arrays import FloatArray

logger = logging.getLogger("sfm_app")

CalibrateFunction = Callable[[CameraPairs, CalibrationSettings, int], Calibration]

LEAST_TO_SPLIT = 4
"""Photos below which a group is not split: too few to tell which of them disagree. Chosen by hand; halved and doubled
by `benchmarks.sensitivity`."""
SAME_FOCAL = 0.03
"""Parts of a group whose log f differ by less are one camera. docs/algorithms.md, Self-calibration, 6. Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""
MANY_PARTS, PERHAPS_ZOOM = 3, "photos of one size fall into {count} cameras, as those of a zoom do"
"""Parts of a group from which on the borders between them may be anywhere, so that none is relied on; and the reason.
Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
PERHAPS_TWO = "its photos may be of two cameras"
UNASSIGNED_REASON = "no usable pair shows which camera took its photos"
LEAST_DISTORTION = 0.01
"""|k1| from which on photos are undistorted before they are tested for one camera. Chosen by hand; halved and doubled
by `benchmarks.sensitivity`."""


@dataclass(frozen=True, slots=True)
class CalibratedCamera:
    """One camera of the set."""

    name: str
    photos: tuple[int, ...]
    found: Calibration
    family: int = -1
    """Number of the group, where each of its photos has its own camera; else -1."""
    part_count: int = 1
    """Number of cameras that its group was split into."""


def calibrate_photo_set(
    pairs: PhotoPairs, calibrate: CalibrateFunction, options: CalibrationSettings, seed: int, *,
    together: bool, split: bool = True,
) -> list[CalibratedCamera]:  # fmt: skip
    """Return every camera of a set of photos, the one with most photos first.

    Args:
        pairs: all pairs that are not degenerate.
        calibrate: finds one camera from its own pairs.
        options: passed to `calibrate`.
        seed: passed to `calibrate`.
        together: also use the pairs between cameras.
        split: with `together`, also split groups whose photos disagree.
    """
    groups: dict[str, list[int]] = {}
    for photo, group in pairs.groups.items():
        groups.setdefault(group, []).append(photo)
    cameras = [
        CalibratedCamera(
            name, tuple(members), _calibrate_alone(calibrate, pairs.to_camera_pairs(members), options, seed)
        )
        for name, members in groups.items()
    ]
    if together:
        cameras = _calibrate_jointly(cameras, pairs, options, seed, split=split)
    cameras = [replace(camera, found=_fall_back_to_guess(camera, pairs)) for camera in cameras]
    return sorted(cameras, key=lambda camera: (-len(camera.photos), camera.name))


def _calibrate_alone(
    calibrate: CalibrateFunction, own: CameraPairs, options: CalibrationSettings, seed: int
) -> Calibration:
    """Return the calibration from the pairs of one camera; a guess where the computation fails."""
    try:
        return calibrate(own, options, seed)
    except FAILURES as err:
        logger.info("a camera could not be calibrated", exc_info=err)
        return guess_calibration(
            own.size, f"the computation failed: {error_reason(err)}", {"pairs": float(len(own.Fs))}
        )


def _calibrate_jointly(
    cameras: list[CalibratedCamera], pairs: PhotoPairs, options: CalibrationSettings, seed: int, *, split: bool
) -> list[CalibratedCamera]:
    """Return the cameras calibrated from all pairs; unchanged where the computation fails."""
    try:
        return (
            _split_and_calibrate(cameras, pairs, options, seed)
            if split
            else _calibrate_from_all_pairs(cameras, pairs, options)
        )
    except FAILURES as err:
        logger.info("the cameras could not be compared", exc_info=err)
        return cameras


def _split_and_calibrate(
    whole: Sequence[CalibratedCamera], pairs: PhotoPairs, options: CalibrationSettings, seed: int
) -> list[CalibratedCamera]:
    """Divide groups whose photos disagree, and calibrate all cameras from all pairs.

    A group of which two parts turn out to have the same focal stays whole.
    """
    unlike = _mixed_padded_groups(whole, pairs, seed)
    parts = [
        _split_by_photo(camera, len(whole) + unlike[camera.name], pairs)
        if camera.name in unlike
        else _split_group(camera, number, pairs, options, seed)
        for number, camera in enumerate(whole)
    ]
    found = _calibrate_from_all_pairs(list(chain.from_iterable(parts)), pairs, options)
    focals = {camera.name: camera.found.focal_px for camera in found if camera.found.is_estimated}
    kept = [
        [camera]
        if split[0].family < 0 and _has_equal_focals([focals[p.name] for p in split if p.name in focals])
        else split
        for camera, split in zip(whole, parts, strict=True)
    ]
    if sum(map(len, kept)) == len(found):
        return found
    return _calibrate_from_all_pairs(list(chain.from_iterable(kept)), pairs, options)


def _has_equal_focals(focals: Sequence[float]) -> bool:
    """Return whether two of the focals are the same."""
    return bool(np.any(np.diff(np.sort(np.log(focals))) < SAME_FOCAL))


def _split_group(
    camera: CalibratedCamera, number: int, pairs: PhotoPairs, options: CalibrationSettings, seed: int
) -> list[CalibratedCamera]:
    """Return the camera itself, the cameras that its photos are divided among, or one for each photo."""
    if len(camera.photos) < LEAST_TO_SPLIT:
        return [camera]
    own, found = pairs.to_camera_pairs(camera.photos), camera.found
    side = float(max(own.size))
    if abs(found.radial) > LEAST_DISTORTION:
        own = undistort_pairs(own, found)
    ready = prepare(own, unit_px=side, origin_px=(own.size[0] / 2, own.size[1] / 2))
    if len(ready) == 0:
        return [camera]
    starts = peak_cameras(Consensus(ready, options.center_sigma * own.size[0] / side))
    if found.identifiable:
        starts.append(np.append(parameters_from_calibration(found, side)[:4], 0.0))
    tables = VoteTables(ready.F, np.zeros((len(ready), 2), np.int64), ready.weights)
    photos = [own.photos[ready.kept[k]] for k in tables.kept]
    thetas, labels = split_by_focal(tables, photos, starts)
    if cross_validate(tables, photos, starts, labels, seed).is_camera_per_photo:
        return _split_by_photo(camera, number, pairs)
    if len(thetas) == 1:
        two = divide_photos(tables, photos, starts)
        if two is None or not two.is_possible:
            return [camera]
        if not two.is_certain:
            return [replace(camera, found=downgrade_to_estimate(found, PERHAPS_TWO) if found.identifiable else found)]
        thetas, labels = two.cameras, two.labels
    return _parts(camera, thetas, _confirmed_labels(labels, photos), pairs)


def _confirmed_labels(labels: Mapping[int, int], photos: Sequence[PairId]) -> dict[int, int]:
    """Return the labels of photos that share a pair with another of their camera, or are its only photo.

    A pair between two cameras does not tell which of its photos is of which.
    """
    count = Counter(labels.values())
    inside = {photo for pair in photos if labels[pair[0]] == labels[pair[1]] for photo in pair}
    return {photo: label for photo, label in labels.items() if photo in inside or count[label] == 1}


def _parts(
    camera: CalibratedCamera, thetas: FloatArray, labels: Mapping[int, int], pairs: PhotoPairs
) -> list[CalibratedCamera]:
    """Return the cameras that a group was divided into.

    Photos without a label form another camera, which is not known.
    """
    names, size = _names(camera, pairs), pairs.sizes[camera.photos[0]]
    parts = []
    for part, theta in enumerate(thetas):
        members = tuple(photo for photo in camera.photos if labels.get(photo) == part)
        theta[4] = camera.found.radial / np.exp(2.0 * theta[0])
        parts.append(
            CalibratedCamera(
                next(names),
                members,
                calibration_from_parameters(theta, size, camera.found.method),
                part_count=len(thetas),
            )
        )
    rest = tuple(photo for photo in camera.photos if photo not in labels)
    return (
        [
            *parts,
            CalibratedCamera(next(names), rest, guess_calibration(size, UNASSIGNED_REASON, {}), part_count=len(thetas)),
        ]
        if rest
        else parts
    )


def _names(camera: CalibratedCamera, pairs: PhotoPairs) -> Iterator[str]:
    """Return names for the parts of a group; the first keeps the name of the group."""
    taken = set(pairs.groups.values())
    return chain([camera.name], (name for k in count(2) if (name := f"{camera.name} #{k}") not in taken))


def _split_by_photo(camera: CalibratedCamera, family: int, pairs: PhotoPairs) -> list[CalibratedCamera]:
    """Return a camera, not calibrated yet, for each photo of a group."""
    nothing, names = guess_calibration(pairs.sizes[camera.photos[0]], "", {}), _names(camera, pairs)
    return [CalibratedCamera(next(names), (photo,), nothing, family) for photo in sorted(camera.photos)]


def _mixed_padded_groups(whole: Sequence[CalibratedCamera], pairs: PhotoPairs, seed: int) -> dict[str, int]:
    """Find groups that bars have brought to one size with others and whose photos each have their own camera.

    The result maps the name of the group to a number of that size.

    All groups of one size are tested together: if the photos of the others are not of one camera, neither are its own.
    """
    found: dict[str, int] = {}
    for number, size in enumerate(sorted(set(pairs.padded_sizes.values()))):
        groups = [camera for camera in whole if pairs.padded_sizes.get(camera.photos[0]) == size]
        labels = {photo: k for k, camera in enumerate(groups) for photo in camera.photos}
        among = [k for k, pair in enumerate(pairs.photos) if labels.keys() >= set(pair)]
        if len(groups) == 1 or not among:
            continue
        to_px = {photo: _sides_to_pixels(pairs.sizes[photo]) for photo in labels}
        Fs = [to_px[second].T @ pairs.Fs[k] @ to_px[first] for k in among for first, second in (pairs.photos[k],)]
        padded = CameraPairs.from_Fs(np.array(Fs), (1, 1), pairs.weights[among])
        ready = prepare(padded, unit_px=1.0, origin_px=(0.0, 0.0))
        tables = VoteTables(ready.F, np.zeros((len(ready), 2), np.int64), ready.weights)
        photos = [pairs.photos[among[k]] for k in ready.kept]
        if len(photos) and cross_validate(tables, photos, [], labels, seed).is_camera_per_photo:
            found |= dict.fromkeys((camera.name for camera in groups), number)
    return found


def _sides_to_pixels(size: tuple[int, int]) -> FloatArray:
    """Return the (3, 3) transform from longer sides, from the middle, to pixels."""
    side = float(max(size))
    return np.array([[side, 0.0, size[0] / 2], [0.0, side, size[1] / 2], [0.0, 0.0, 1.0]])


def _calibrate_from_all_pairs(
    cameras: Sequence[CalibratedCamera], pairs: PhotoPairs, options: CalibrationSettings
) -> list[CalibratedCamera]:
    """Return all cameras calibrated jointly from all pairs; a single camera stays as it is."""
    if len(cameras) <= 1:
        return list(cameras)
    number = {photo: k for k, camera in enumerate(cameras) for photo in camera.photos}
    everything = CameraPairs(pairs.Fs, pairs.weights, (1, 1), pairs.photos, pairs.inliers)
    members = np.array([[number[first], number[second]] for first, second in pairs.photos]).reshape(-1, 2)
    asked = [
        CameraGroup(
            size=pairs.sizes[camera.photos[0]],
            start=camera.found if camera.found.identifiable else None,
            known=camera.found.identifiable and bool(camera.found.evidence),
            hint_px=_claimed_focal(camera, pairs),
            family=camera.family,
            divided=camera.part_count > 1,
        )
        for camera in cameras
    ]
    answers = calibrate_cameras(asked, everything, members, options, METHOD)
    return [replace(one, found=_downgrade_if_zoom(one, answer)) for one, answer in zip(cameras, answers, strict=True)]


def _downgrade_if_zoom(camera: CalibratedCamera, found: Calibration) -> Calibration:
    """Return the calibration, as an estimate where the group was split into many cameras, as photos of a zoom are."""
    many = found.identifiable and camera.part_count >= MANY_PARTS
    return downgrade_to_estimate(found, PERHAPS_ZOOM.format(count=camera.part_count)) if many else found


def _fall_back_to_guess(camera: CalibratedCamera, pairs: PhotoPairs) -> Calibration:
    """Return the calibration; where nothing was found, a K to start from: EXIF's claim, or 1.2 x the longer side."""
    found = camera.found
    if found.identifiable or found.method == ESTIMATE:
        return found
    claim = _claimed_focal(camera, pairs)
    size = pairs.sizes[camera.photos[0]]
    if not np.isfinite(claim):
        return found if camera.family >= 0 else guess_calibration(size, found.reason, found.evidence)
    K = guessed_camera_matrix(size, claim)
    return replace(found, K=K, method="exif", radial=0.0, spread={}, correlations={}, held=())


def _claimed_focal(camera: CalibratedCamera, pairs: PhotoPairs) -> float:
    claims = [pairs.focal_hints_px[photo] for photo in camera.photos if photo in pairs.focal_hints_px]
    return float(np.median(claims)) if claims else float("nan")
