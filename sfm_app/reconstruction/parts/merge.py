"""One model of all fragments: each photo once, and tracks merged where they hold the same keypoint."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sfm_app.colmap.models.joined_model import PlacedPhotos
from sfm_app.geometry.similarity import Similarity
from sfm_app.reconstruction.parts.joins import Fragment

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

SAME_DEG, SAME_SHIFT = 5.0, 0.25
"""Angle, and shift as a share of the median distance of a photo's points, up to which a fragment has a photo where the
merged model has it; else its points do not count as seen by that photo. Chosen by hand."""


def merge_fragments(fragments: Sequence[Fragment], frames: Mapping[int, Similarity]) -> PlacedPhotos:
    """Return the photos and points of all fragments that have a frame.

    A photo has the pose that the part has found which owns it, else that of the largest fragment with it.

    Args:
        fragments: models of parts.
        frames: from the frame of a fragment into the common one, by its number.
    """
    moved = {number: _move(fragments[number].placed, frame) for number, frame in sorted(frames.items())}
    photos, R, centers, source = _choose_poses(fragments, moved)
    cameras = {
        photo: moved[number].cameras[photo] for photo, number in zip(photos.tolist(), source.tolist(), strict=True)
    }
    tracks = [_sound_observations(model, photos, R, centers) for model in moved.values()]
    X, point, photo, keypoint = _merge_tracks(tracks)
    return PlacedPhotos(photos, R, centers, X, point, photo, keypoint, cameras)


def _move(model: PlacedPhotos, frame: Similarity) -> PlacedPhotos:
    R = np.einsum("nij,kj->nik", model.R, frame.R)
    return PlacedPhotos(
        model.photos, R, frame(model.centers), frame(model.X), model.point, model.photo, model.keypoint, model.cameras
    )


def _choose_poses(
    fragments: Sequence[Fragment], moved: Mapping[int, PlacedPhotos]
) -> tuple[IndexArray, FloatArray, FloatArray, IndexArray]:
    """Return ids of all photos, their rotations and centers, and the fragments that these are from."""
    found: dict[int, tuple[tuple[bool, int, int], int, int]] = {}
    for number, model in moved.items():
        for row, photo in enumerate(model.photos.tolist()):
            rank = photo in fragments[number].own, len(model.photos), -number
            if photo not in found or rank > found[photo][0]:
                found[photo] = rank, number, row
    photos = sorted(found)
    chosen = [found[photo][1:] for photo in photos]
    return (
        np.array(photos, np.int64),
        np.array([moved[number].R[row] for number, row in chosen]).reshape(-1, 3, 3),
        np.array([moved[number].centers[row] for number, row in chosen]).reshape(-1, 3),
        np.array([number for number, _ in chosen], np.int64),
    )


def _sound_observations(
    model: PlacedPhotos, photos: IndexArray, R: FloatArray, centers: FloatArray
) -> tuple[FloatArray, IndexArray, IndexArray, IndexArray]:
    """Return the points, and the observations by photos whose pose in this model is that of the merged one."""
    rows = np.searchsorted(photos, model.photos)
    traces = np.einsum("nij,nij->n", model.R, R[rows])
    angles = np.degrees(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))
    at = np.searchsorted(model.photos, model.photo)
    away = np.linalg.norm(model.X[model.point] - model.centers[at], axis=1)
    usual = float(np.median(away)) if len(away) else 1.0
    shifts = np.linalg.norm(model.centers - centers[rows], axis=1) / max(usual, 1e-300)
    kept = ((angles <= SAME_DEG) & (shifts <= SAME_SHIFT))[at]
    return model.X, model.point[kept], model.photo[kept], model.keypoint[kept]


def _merge_tracks(
    tracks: Sequence[tuple[FloatArray, IndexArray, IndexArray, IndexArray]],
) -> tuple[FloatArray, IndexArray, IndexArray, IndexArray]:
    """Return points (P, 3), and of each observation the point, the photo and the keypoint, in order of points.

    Tracks with a keypoint in common become one; of several keypoints of one photo in it, one stays.

    Args:
        tracks: of each model, the points, and of each observation the row of the point, the photo and the keypoint.
    """
    starts = np.cumsum([0, *(len(X) for X, *_ in tracks)])
    X = np.concatenate([X for X, *_ in tracks] or [np.zeros((0, 3))])
    point = np.concatenate([rows + start for (_, rows, *_), start in zip(tracks, starts, strict=False)])
    photo = np.concatenate([photos for _, _, photos, _ in tracks])
    keypoint = np.concatenate([keypoints for *_, keypoints in tracks])
    _, name = np.unique(photo * (1 << 32) + keypoint, return_inverse=True)
    keys = int(name.max(initial=-1)) + 1
    links = coo_array((np.ones(len(name), np.int8), (point, len(X) + name)), shape=(len(X) + keys,) * 2)
    _, track = connected_components(links, directed=False)
    views = np.bincount(point, minlength=len(X)).astype(np.float64)
    total = np.bincount(track[: len(X)], views)
    sums = np.column_stack([np.bincount(track[: len(X)], views * X[:, k]) for k in range(3)])
    mean = np.asarray(sums / np.maximum(total, 1.0)[:, None], np.float64)
    owner = track[: len(X)][point]
    order = np.lexsort((keypoint, photo, owner))
    owner, photo, keypoint = owner[order], photo[order], keypoint[order]
    first = np.ones(len(owner), bool)
    first[1:] = (owner[1:] != owner[:-1]) | (photo[1:] != photo[:-1])
    owner, photo, keypoint = owner[first], photo[first], keypoint[first]
    long = np.bincount(owner, minlength=len(mean)) >= 2
    kept = long[owner]
    rows = np.cumsum(long) - 1
    return mean[long], rows[owner[kept]], photo[kept], keypoint[kept]
