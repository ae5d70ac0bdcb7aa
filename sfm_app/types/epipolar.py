"""Fundamental matrices of pairs of photos."""

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.numerical import json_text
from sfm_app.types.calibration import Calibration
from sfm_app.types.matches import PairId


@dataclass(frozen=True, slots=True, eq=False)
class EpipolarFit:
    """A fundamental matrix with its evidence."""

    F: NDArray[np.float64]
    """(3, 3), rank 2, Frobenius norm 1; x2' F x1 = 0 in pixels, or of bearing vectors where a lens is known before (see
    `ViewGraph.lenses`)."""
    inliers: NDArray[np.bool_]
    """(N,) per match: within the threshold of the returned F."""
    priors: NDArray[np.float64]
    """(N,) in [0, 1] per match: its validity according to the estimator; p(v_i) of the thesis, largest value 1."""
    trials: int
    """Number of minimal samples drawn."""
    rms_px: float
    """Root mean square Sampson distance of the inliers."""
    degeneracy: str = ""
    """Why F is not determined by these matches ("collinear", "planar", "rotation"); empty when it is."""

    @property
    def inlier_count(self) -> int:
        """Number of matches that agree with F."""
        return int(np.count_nonzero(self.inliers))


@dataclass(frozen=True, slots=True)
class Rejected:
    """A pair without a usable epipolar geometry, and why. Falsy, so that ``if fit:`` reads well."""

    reason: str

    def __bool__(self) -> bool:
        return False


@dataclass(frozen=True, slots=True)
class ViewGraph:
    """One epipolar geometry, or the reason for its absence, for every matched pair."""

    fits: Mapping[PairId, EpipolarFit]
    rejected: Mapping[PairId, Rejected]
    lenses: Mapping[str, Calibration] = field(default_factory=dict)
    """Cameras with a wide lens, by camera group: the curves of epipolar lines show them before there is any F. The F of
    their pairs are of bearing vectors."""

    @property
    def reasons(self) -> dict[str, int]:
        """How often each reason of rejection occurred, most frequent first."""
        return dict(Counter(r.reason for r in self.rejected.values()).most_common())

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return plain arrays for an .npz file; the matches of all pairs are concatenated."""
        fits = list(self.fits.values())
        return {
            "pairs": np.array(list(self.fits), np.uint32).reshape(-1, 2),
            "F": np.array([fit.F for fit in fits]).reshape(-1, 3, 3),
            "match_counts": np.array([len(fit.inliers) for fit in fits], np.int64),
            "inliers": np.concatenate([fit.inliers for fit in fits] or [np.zeros(0, bool)]),
            "priors": np.concatenate([fit.priors for fit in fits] or [np.zeros(0)]),
            "trials": np.array([fit.trials for fit in fits], np.int64),
            "rms_px": np.array([fit.rms_px for fit in fits], np.float64),
            "degeneracy": np.array([fit.degeneracy for fit in fits], np.str_),
            "rejected_pairs": np.array(list(self.rejected), np.uint32).reshape(-1, 2),
            "rejected_reasons": np.array([rejected.reason for rejected in self.rejected.values()], np.str_),
            "lens_groups": np.array(list(self.lenses), np.str_),
            "lenses": np.array([json_text(lens.to_dict()) for lens in self.lenses.values()], np.str_),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> "ViewGraph":
        """Rebuild from `to_arrays`."""
        cuts = np.cumsum(arrays["match_counts"])
        columns = (
            arrays["F"],
            np.split(arrays["inliers"], cuts)[:-1],
            np.split(arrays["priors"], cuts)[:-1],
            arrays["trials"].tolist(),
            arrays["rms_px"].tolist(),
            arrays["degeneracy"].tolist(),
        )
        fits = {_pair(row): EpipolarFit(*values) for row, *values in zip(arrays["pairs"], *columns, strict=True)}
        rejected = zip(arrays["rejected_pairs"], arrays["rejected_reasons"].tolist(), strict=True)
        lenses = {
            group: Calibration.from_dict(json.loads(text))
            for group, text in zip(arrays["lens_groups"].tolist(), arrays["lenses"].tolist(), strict=True)
        }
        return cls(fits, {_pair(row): Rejected(reason) for row, reason in rejected}, lenses)


def _pair(row: NDArray[np.uint32]) -> PairId:
    return int(row[0]), int(row[1])
