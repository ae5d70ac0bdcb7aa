"""Cameras of a photo set: which photos share one, and the K of each.

Ours; the thesis takes one camera for all photos (5.5.2).
"""

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, count

import numpy as np

from sfm_app.numerical import FAILURES, error_reason
from sfm_app.selfcal.calibrate_pairs import undistort_pairs
from sfm_app.selfcal.consensus import Consensus
from sfm_app.selfcal.groups import CameraGroup, VoteTables, calibrate_cameras
from sfm_app.selfcal.other_cameras import divide_photos, peak_cameras
from sfm_app.selfcal.pairs import (
    ESTIMATE,
    KAPPA,
    LOG_FOCAL,
    calibration_from_parameters,
    claimed_calibration,
    downgrade_to_estimate,
    guess_calibration,
    parameters_from_calibration,
    prepare,
    sides_from_pixels,
)
from sfm_app.selfcal.zero_curves import METHOD
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs, PairId, PhotoPairs
from sfm_app.types.arrays import FloatArray

logger = logging.getLogger("sfm_app")

CalibrateFunction = Callable[[CameraPairs, CalibrationSettings, int], Calibration]


@dataclass(frozen=True, slots=True)
class CalibratedCamera:
    """One camera of the set."""

    name: str
    photos: tuple[int, ...]
    found: Calibration
    family: int = -1
    """Number of the group, where each of its photos has its own camera; else -1."""
    divided: bool = False
    """Whether its group has two cameras."""
    known: bool | None = None
    """Whether its own pairs determine it; None before all pairs were adjusted together."""


def calibrate_photo_set(
    pairs: PhotoPairs, calibrate: CalibrateFunction, options: CalibrationSettings, seed: int, *,
    together: bool, split: bool = True, before: Sequence[CalibratedCamera] = (),
) -> list[CalibratedCamera]:  # fmt: skip
    """Return all cameras, those of most photos first; `together` uses pairs between cameras, `split` divides groups.

    Several cameras `before`, of other inliers of the same pairs, are not divided again.
    """
    again = together and len(before) > 1
    groups: dict[str, list[int]] = {}
    for photo, group in pairs.groups.items():
        groups.setdefault(group, []).append(photo)
    cameras = (
        list(before)
        if again
        else [
            CalibratedCamera(
                name, tuple(members), _calibrate_alone(calibrate, pairs.to_camera_pairs(members), options, seed)
            )
            for name, members in groups.items()
        ]
    )
    if together:
        try:
            cameras = (
                _split_and_calibrate(cameras, pairs, options, seed)
                if split and not again
                else _calibrate_from_all_pairs(cameras, pairs, options)
            )
        except FAILURES as err:
            logger.info("joint calibration of the cameras failed", exc_info=err)
    cameras = [replace(camera, found=_fall_back_to_guess(camera, pairs)) for camera in cameras]
    return sorted(cameras, key=lambda camera: (-len(camera.photos), camera.name))


def _calibrate_alone(
    calibrate: CalibrateFunction, own: CameraPairs, options: CalibrationSettings, seed: int
) -> Calibration:
    try:
        return calibrate(own, options, seed)
    except FAILURES as err:
        logger.info("calibration of a camera failed", exc_info=err)
        return guess_calibration(own.size, f"it failed: {error_reason(err)}", {"pairs": float(len(own.Fs))})


def _split_and_calibrate(
    whole: Sequence[CalibratedCamera], pairs: PhotoPairs, options: CalibrationSettings, seed: int
) -> list[CalibratedCamera]:
    """Divide groups whose photos disagree, and calibrate all."""
    families = _mixed_padded_groups(whole, pairs, seed)
    parts = [
        _split_by_photo(camera, len(whole) + families[camera.name], pairs)
        if camera.name in families
        else _split_group(camera, number, pairs, options, seed)
        for number, camera in enumerate(whole)
    ]
    several = [number for number, camera in enumerate(whole) if len(camera.photos) > 1]
    undivided = [number for number in several if len(parts[number]) < len(whole[number].photos)]
    if 2 * len(undivided) <= len(several):
        for number in undivided:
            parts[number] = _split_group(whole[number], number, pairs, options, seed, mixed=True)
    return _calibrate_from_all_pairs(list(chain.from_iterable(parts)), pairs, options)


def _split_group(
    camera: CalibratedCamera, number: int, pairs: PhotoPairs, options: CalibrationSettings, seed: int, *,
    mixed: bool = False,
) -> list[CalibratedCamera]:  # fmt: skip
    """Return the camera itself, the cameras that its photos are divided among, or one for each photo."""
    calibration = camera.found
    own = undistort_pairs(pairs.to_camera_pairs(camera.photos), calibration)
    side = float(max(own.size))
    ready = prepare(own, unit_px=side, origin_px=(own.size[0] / 2, own.size[1] / 2))
    if len(ready) == 0:
        return [camera]
    starts = peak_cameras(Consensus(ready, options.center_sigma * own.size[0] / side))
    if calibration.identifiable:
        starts.append(np.append(parameters_from_calibration(calibration, side)[:4], 0.0))
    tables = VoteTables(ready.F, np.zeros((len(ready), 2), np.int64), ready.weights)
    photos = [own.photos[ready.indices[k]] for k in tables.indices]
    division = divide_photos(tables, photos, starts, seed, mixed=mixed)
    if division.is_camera_per_photo:
        return _split_by_photo(camera, number, pairs)
    if len(division.cameras) == 1:
        doubt = "the photos may come from several cameras" if division.is_doubtful and calibration.identifiable else ""
        return [replace(camera, found=downgrade_to_estimate(calibration, doubt))]
    return _parts(camera, division.cameras, _confirmed_labels(division.labels, photos), pairs)


def _confirmed_labels(labels: Mapping[int, int], photos: Sequence[PairId]) -> dict[int, int]:
    """Return the labels of photos that share a pair with another of their camera, or are its only photo."""
    count = Counter(labels.values())
    inside = {photo for pair in photos if labels[pair[0]] == labels[pair[1]] for photo in pair}
    return {photo: label for photo, label in labels.items() if photo in inside or count[label] == 1}


def _parts(
    camera: CalibratedCamera, thetas: FloatArray, labels: Mapping[int, int], pairs: PhotoPairs
) -> list[CalibratedCamera]:
    """Return the cameras that a group was divided into; photos without a label form another, unknown camera."""
    names, size = _names(camera, pairs), pairs.sizes[camera.photos[0]]
    parts = []
    for part, theta in enumerate(thetas):
        theta[KAPPA] = camera.found.radial / np.exp(2.0 * theta[LOG_FOCAL])
        calibration = calibration_from_parameters(theta, size, camera.found.method)
        if members := tuple(photo for photo in camera.photos if labels.get(photo) == part):
            parts.append(CalibratedCamera(next(names), members, calibration, divided=True))
    rest = tuple(photo for photo in camera.photos if photo not in labels)
    if rest:
        unknown = guess_calibration(size, "no usable pair assigns these photos to a camera", {})
        parts.append(CalibratedCamera(next(names), rest, unknown, divided=True))
    return parts


def _names(camera: CalibratedCamera, pairs: PhotoPairs) -> Iterator[str]:
    """Return names for the parts of a group; the first keeps the name of the group."""
    taken = set(pairs.groups.values())
    return chain([camera.name], (name for k in count(2) if (name := f"{camera.name} #{k}") not in taken))


def _split_by_photo(camera: CalibratedCamera, family: int, pairs: PhotoPairs) -> list[CalibratedCamera]:
    nothing, names = guess_calibration(pairs.sizes[camera.photos[0]], "", {}), _names(camera, pairs)
    return [CalibratedCamera(next(names), (photo,), nothing, family) for photo in sorted(camera.photos)]


def _mixed_padded_groups(whole: Sequence[CalibratedCamera], pairs: PhotoPairs, seed: int) -> dict[str, int]:
    """Find groups that bars have brought to one size with others and whose photos each have their own camera.

    All groups of one size are tested together: if the photos of the others are not of one camera, neither are its own.
    Returns a number of that size by the name of the group.
    """
    families: dict[str, int] = {}
    for number, size in enumerate(sorted(set(pairs.padded_sizes.values()))):
        groups = [camera for camera in whole if pairs.padded_sizes.get(camera.photos[0]) == size]
        labels = {photo: k for k, camera in enumerate(groups) for photo in camera.photos}
        rows = [k for k, pair in enumerate(pairs.photos) if labels.keys() >= set(pair)]
        if len(groups) == 1 or not rows:
            continue
        to_px = {photo: np.linalg.inv(sides_from_pixels(pairs.sizes[photo])) for photo in labels}
        Fs = [to_px[second].T @ pairs.Fs[k] @ to_px[first] for k in rows for first, second in (pairs.photos[k],)]
        padded = CameraPairs.from_Fs(np.array(Fs), (1, 1), pairs.weights[rows])
        ready = prepare(padded, unit_px=1.0, origin_px=(0.0, 0.0))
        tables = VoteTables(ready.F, np.zeros((len(ready), 2), np.int64), ready.weights)
        photos = [pairs.photos[rows[k]] for k in ready.indices]
        if len(photos) and divide_photos(tables, photos, [], seed, labels).is_camera_per_photo:
            families |= dict.fromkeys((camera.name for camera in groups), number)
    return families


def _calibrate_from_all_pairs(
    cameras: Sequence[CalibratedCamera], pairs: PhotoPairs, options: CalibrationSettings
) -> list[CalibratedCamera]:
    """Return all cameras calibrated jointly from all pairs; a single camera, or cameras without pairs, stay."""
    if len(cameras) <= 1 or not pairs.photos:
        return list(cameras)
    number = {photo: k for k, camera in enumerate(cameras) for photo in camera.photos}
    everything = CameraPairs(pairs.Fs, pairs.weights, (1, 1), pairs.photos, pairs.inliers)
    members = np.array([[number[first], number[second]] for first, second in pairs.photos]).reshape(-1, 2)
    groups = [
        CameraGroup(
            size=pairs.sizes[camera.photos[0]],
            start=camera.found if camera.found.identifiable else None,
            known=camera.found.identifiable and bool(camera.found.evidence) if camera.known is None else camera.known,
            prior=pairs.prior_of(camera.photos),
            family=camera.family,
            divided=camera.divided,
        )
        for camera in cameras
    ]
    calibrations = calibrate_cameras(groups, everything, members, options, METHOD)
    return [
        replace(one, found=found, known=group.known)
        for one, group, found in zip(cameras, groups, calibrations, strict=True)
    ]


def _fall_back_to_guess(camera: CalibratedCamera, pairs: PhotoPairs) -> Calibration:
    """Return the calibration; for a guess, the camera that someone claims, or a focal of 1.2 x the longer side."""
    calibration = camera.found
    if calibration.identifiable or calibration.method == ESTIMATE:
        return calibration
    prior, size = pairs.prior_of(camera.photos), pairs.sizes[camera.photos[0]]
    if prior is not None:
        return claimed_calibration(prior, size, calibration.reason, calibration.evidence)
    return calibration if camera.family >= 0 else guess_calibration(size, calibration.reason, calibration.evidence)
