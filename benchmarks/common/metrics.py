"""Errors of camera poses and fundamental matrices against the truth."""

import json
from collections.abc import Mapping
from itertools import combinations, permutations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.epipolar import decompose_essential, essential_from_fundamental, sampson_distance
from sfm_app.geometry.poses import umeyama

Pose = NDArray[np.float64]

LOST_DEG = 180.0
"""Error of a pair with a photo that has no pose, and of a pair without F."""
MISPLACED_DEG, MISPLACED_SHARE = 20.0, 0.1
"""Errors of a photo beyond which it is in a wrong place; the second in sizes of the scene."""
CAP_PX = 5.0
"""A fundamental matrix with a larger error has failed; capped errors count it at this value."""


def load_truth(path: Path) -> dict[str, tuple[NDArray[np.float64], Pose]]:
    """Read K and (3, 4) cam_from_world by photo name without suffix."""
    images = json.loads(path.read_text(encoding="utf-8"))["images"]
    return {
        Path(entry["file"]).stem: (np.array(entry["K"]), np.column_stack([np.array(entry["R"]), np.ravel(entry["t"])]))
        for entry in images
    }


def pose_errors_deg(found: Mapping[str, Pose], truth: Mapping[str, Pose]) -> NDArray[np.float64]:
    """Return, per pair of true photos, the larger of the errors of relative rotation and translation direction."""
    errors = []
    for a, b in combinations(sorted(truth), 2):
        if a in found and b in found:
            errors.append(pose_error_deg(relative_pose(found[a], found[b]), relative_pose(truth[a], truth[b])))
        else:
            errors.append(LOST_DEG)
    return np.array(errors)


def fundamental_pose_error_deg(
    F: NDArray[np.float64] | None, cameras: tuple[NDArray[np.float64], NDArray[np.float64]], R: Pose, t: Pose
) -> float:
    """Return the larger of the errors of rotation and translation direction in F, decomposed with the true K1 and K2.

    Of the four poses in F, the best one counts. `LOST_DEG` without F.
    """
    if F is None:
        return LOST_DEG
    poses = decompose_essential(essential_from_fundamental(F, *cameras))
    return min(pose_error_deg(pose, (R, t)) for pose in poses)


def rms_sampson_px(F: NDArray[np.float64] | None, x1: NDArray[np.float64], x2: NDArray[np.float64]) -> float:
    """Return the root mean square Sampson distance of matches to F; inf without F."""
    return float("inf") if F is None else float(np.sqrt(np.mean(sampson_distance(F, x1, x2) ** 2)))


def mean_sampson_px(F: NDArray[np.float64] | None, x1: NDArray[np.float64], x2: NDArray[np.float64]) -> float:
    """Return the mean Sampson distance of matches to F; inf without F."""
    return float("inf") if F is None else float(np.mean(sampson_distance(F, x1, x2)))


def summary_px(errors_px: NDArray[np.float64]) -> dict[str, float | int]:
    """Return the mean of the answers that did not fail, the mean of all with failures at `CAP_PX`, and the failures."""
    good = errors_px <= CAP_PX
    return {
        "mean px": round(float(errors_px[good].mean()), 4) if good.any() else CAP_PX,
        "capped mean px": round(float(np.minimum(errors_px, CAP_PX).mean()), 4),
        "failures": int(np.count_nonzero(~good)),
    }


def area_under_recall(errors_deg: NDArray[np.float64], limit_deg: float) -> float:
    """Compute the area under the curve of recall over error, up to a limit, 0 to 1."""
    errors = np.concatenate([[0.0], np.sort(errors_deg)])
    recall = np.linspace(0.0, 1.0, len(errors))
    count = int(np.searchsorted(errors, limit_deg))
    x, y = np.append(errors[:count], limit_deg), np.append(recall[:count], recall[count - 1])
    return float(np.trapezoid(y, x) / limit_deg)


def focal_error_percent(found: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """Compute e_focal of the thesis: the mean error of fx and fy."""
    return float(50 * (abs(found[0, 0] / truth[0, 0] - 1) + abs(found[1, 1] / truth[1, 1] - 1)))


def center_error_percent(found: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """Compute e_OC of the thesis: the mean error of cx and cy, in percent of the true ones."""
    return float(50 * (abs(found[0, 2] / truth[0, 2] - 1) + abs(found[1, 2] / truth[1, 2] - 1)))


def center_shift_percent(found: NDArray[np.float64], truth: NDArray[np.float64], width: float) -> float:
    """Compute the distance of the optical centers in percent of a width, which is independent of where they lie."""
    return float(100 * np.linalg.norm(found[:2, 2] - truth[:2, 2]) / width)


def position_rms_percent(found: Mapping[str, Pose], truth: Mapping[str, Pose]) -> float | None:
    """Compute the RMS error of the camera centers after a similarity; None with fewer than three.

    In percent of the mean distance of the true places from their mean. Photos without a pose are left out.
    """
    common = sorted(set(found) & set(truth))
    if len(common) < 3:
        return None
    ours, true = (np.array([_position(poses[name]) for name in common]) for poses in (found, truth))
    distances = np.linalg.norm(umeyama(ours, true)(ours) - true, axis=1)
    return float(100 * np.sqrt(np.mean(distances**2)) / np.linalg.norm(true - true.mean(0), axis=1).mean())


def misplaced_photos(found: Mapping[str, Pose], truth: Mapping[str, Pose], scene_size: float) -> list[str]:
    """Return the photos in a wrong place after the similarity of two photos that leaves the smallest errors.

    An error counts up to the limit, so that a few wrong photos do not move the others.
    """
    common = sorted(set(found) & set(truth))
    ours, true = (np.array([_position(poses[name]) for name in common]) for poses in (found, truth))
    R_ours, R_true = (np.array([poses[name][:, :3] for name in common]) for poses in (found, truth))
    smallest, errors = np.inf, np.zeros(len(common))
    for a, b in permutations(range(len(common)), 2):
        scale = np.linalg.norm(true[a] - true[b]) / max(float(np.linalg.norm(ours[a] - ours[b])), 1e-12)
        turn = R_true[a].T @ R_ours[a]
        shifts = np.linalg.norm(scale * (ours - ours[a]) @ turn.T + true[a] - true, axis=1)
        cosines = (np.einsum("nij,nij->n", R_true @ turn, R_ours) - 1) / 2
        angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
        here = np.maximum(shifts / (MISPLACED_SHARE * scene_size), angles / MISPLACED_DEG)
        if (cost := np.minimum(here, 1.0).sum()) < smallest:
            smallest, errors = cost, here
    return [name for name, error in zip(common, errors, strict=True) if error > 1.0]


def _position(pose: Pose) -> NDArray[np.float64]:
    return -pose[:, :3].T @ pose[:, 3]


def pose_error_deg(a: tuple[Pose, Pose], b: tuple[Pose, Pose]) -> float:
    (R, t), (S, u) = a, b
    cosines = ((np.trace(R.T @ S) - 1) / 2, t @ u / (np.linalg.norm(t) * np.linalg.norm(u)))
    return float(max(np.degrees(np.arccos(np.clip(cosines, -1, 1)))))


def relative_pose(a: Pose, b: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    R = b[:, :3] @ a[:, :3].T
    return R, b[:, 3] - R @ a[:, 3]
