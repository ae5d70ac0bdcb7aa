"""Camera poses against the truth."""

import json
from collections.abc import Mapping
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Pose = NDArray[np.float64]

LOST_DEG = 180.0
"""Error of a pair with a photo that has no pose."""


def load_truth(path: Path) -> dict[str, tuple[NDArray[np.float64], Pose]]:
    """K and (3, 4) cam_from_world by photo name without suffix."""
    images = json.loads(path.read_text(encoding="utf-8"))["images"]
    return {
        Path(entry["file"]).stem: (np.array(entry["K"]), np.column_stack([np.array(entry["R"]), np.ravel(entry["t"])]))
        for entry in images
    }


def pose_errors_deg(found: Mapping[str, Pose], truth: Mapping[str, Pose]) -> NDArray[np.float64]:
    """Per pair of true photos: the larger of the errors of relative rotation and of translation direction."""
    errors = []
    for a, b in combinations(sorted(truth), 2):
        if a in found and b in found:
            (R, t), (S, u) = _relative(found[a], found[b]), _relative(truth[a], truth[b])
            cosines = ((np.trace(R.T @ S) - 1) / 2, t @ u / (np.linalg.norm(t) * np.linalg.norm(u)))
            errors.append(max(np.degrees(np.arccos(np.clip(cosines, -1, 1)))))
        else:
            errors.append(LOST_DEG)
    return np.array(errors)


def area_under_recall(errors_deg: NDArray[np.float64], limit_deg: float) -> float:
    """Area under the curve of recall over error, up to a limit, 0 to 1."""
    errors = np.concatenate([[0.0], np.sort(errors_deg)])
    recall = np.linspace(0.0, 1.0, len(errors))
    count = int(np.searchsorted(errors, limit_deg))
    x, y = np.append(errors[:count], limit_deg), np.append(recall[:count], recall[count - 1])
    return float(np.trapezoid(y, x) / limit_deg)


def focal_error_percent(found: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """e_focal of the thesis: mean error of fx and fy."""
    return float(50 * (abs(found[0, 0] / truth[0, 0] - 1) + abs(found[1, 1] / truth[1, 1] - 1)))


def _relative(a: Pose, b: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    R = b[:, :3] @ a[:, :3].T
    return R, b[:, 3] - R @ a[:, 3]
