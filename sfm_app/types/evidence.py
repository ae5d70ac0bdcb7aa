"""Fundamental matrices, cameras and relative poses of pairs of photos."""

import json
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfm_app.numerical import json_text
from sfm_app.types.arrays import BoolArray, FloatArray
from sfm_app.types.camera import Calibration, Intrinsics
from sfm_app.types.photos import CameraPrior, MatchGraph, PairId, join_priors


@dataclass(frozen=True, slots=True, eq=False)
class EpipolarGeometry:
    """The matrix of a pair with its evidence: an `EpipolarFit` or a `RayFit`."""

    matrix: FloatArray
    """(3, 3), rank 2, Frobenius norm 1."""
    inliers: BoolArray
    """(N,) per match: within the threshold of the matrix."""
    priors: FloatArray
    """(N,) in [0, 1] per match: its validity according to the estimator; p(v_i) of the thesis, largest value 1."""
    trials: int
    rms_px: float
    """Root mean square Sampson distance of the inliers."""
    degeneracy: str = ""
    """Why the matches do not determine it ("collinear", "planar", "rotation"); empty when they do."""

    @property
    def inlier_count(self) -> int:
        """Number of matches that agree with the matrix."""
        return int(np.count_nonzero(self.inliers))


class EpipolarFit(EpipolarGeometry):
    """A fundamental matrix with its evidence."""

    __slots__ = ()

    @property
    def F(self) -> FloatArray:
        """(3, 3), rank 2, Frobenius norm 1; x2' F x1 = 0 in pixels."""
        return self.matrix


class RayFit(EpipolarGeometry):
    """An essential matrix of known lenses with its evidence, where one is wide and F does not exist."""

    __slots__ = ()

    @property
    def E(self) -> FloatArray:
        """(3, 3), Frobenius norm 1; q' E p = 0 for bearing vectors p of view 1 and q of view 2."""
        return self.matrix


@dataclass(frozen=True, slots=True)
class Rejected:
    """The reason why a result is missing or unusable. Falsy, so that ``if fit:`` reads well."""

    reason: str

    def __bool__(self) -> bool:
        return False


@dataclass(frozen=True, slots=True)
class ViewGraph:
    """One epipolar geometry, or the reason for its absence, for every matched pair."""

    fits: Mapping[PairId, EpipolarGeometry]
    rejected: Mapping[PairId, Rejected]
    lenses: Mapping[str, Calibration] = field(default_factory=dict)
    """Cameras with a wide lens, by camera group, estimated from curved epipolar lines; their pairs have a `RayFit`."""

    @property
    def results(self) -> dict[PairId, EpipolarGeometry | Rejected]:
        """The fit of every pair, or the reason for its absence."""
        return {**self.fits, **self.rejected}

    @property
    def reasons(self) -> dict[str, int]:
        """How often each reason of rejection occurred, most frequent first."""
        return dict(Counter(r.reason for r in self.rejected.values()).most_common())

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return plain arrays for an .npz file; the matches of all pairs are concatenated."""
        fits = list(self.fits.values())
        return {
            "pairs": np.array(list(self.fits), np.uint32).reshape(-1, 2),
            "matrices": np.array([fit.matrix for fit in fits]).reshape(-1, 3, 3),
            "of_rays": np.array([isinstance(fit, RayFit) for fit in fits], np.bool_),
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
            arrays["matrices"],
            np.split(arrays["inliers"], cuts)[:-1],
            np.split(arrays["priors"], cuts)[:-1],
            arrays["trials"].tolist(),
            arrays["rms_px"].tolist(),
            arrays["degeneracy"].tolist(),
        )
        kinds = [RayFit if of_rays else EpipolarFit for of_rays in arrays["of_rays"]]
        rows = zip(kinds, arrays["pairs"], *columns, strict=True)
        fits = {_pair(row): kind(*values) for kind, row, *values in rows}
        rejected = zip(arrays["rejected_pairs"], arrays["rejected_reasons"].tolist(), strict=True)
        lenses = {
            group: Calibration.from_dict(json.loads(text))
            for group, text in zip(arrays["lens_groups"].tolist(), arrays["lenses"].tolist(), strict=True)
        }
        return cls(fits, {_pair(row): Rejected(reason) for row, reason in rejected}, lenses)


def _pair(row: NDArray[np.uint32]) -> PairId:
    return int(row[0]), int(row[1])


@dataclass(frozen=True, slots=True, eq=False)
class CameraPairs:
    """Fundamental matrices of pairs with the same camera, and data of each; `selfcal.pairs.prepare` checks them."""

    Fs: FloatArray
    """(P, 3, 3) in pixels, x2' F x1 = 0, any scale."""
    weights: FloatArray
    """(P,) >= 0, weight of each F."""
    size: tuple[int, int]
    """(width, height) of the photos in pixels."""
    photos: tuple[PairId, ...] = ()
    """Per pair the ids of its two photos; empty where they are unknown."""
    inliers: tuple[FloatArray, ...] = ()
    """Per pair (N, 4) x1, y1, x2, y2 in pixels: the matches behind F; empty where only the Fs are known."""
    prior: CameraPrior | None = None

    @classmethod
    def from_Fs(cls, Fs: ArrayLike, size: tuple[int, int], weights: ArrayLike | None = None) -> "CameraPairs":
        """Make pairs from matrices (P, 3, 3) in pixels, x2' F x1 = 0, of any scale; without weights, all are equal."""
        matrices = np.asarray(Fs, np.float64)
        return cls(matrices, np.ones(len(matrices)) if weights is None else np.asarray(weights, np.float64), size)


@dataclass(frozen=True, slots=True, eq=False)
class PhotoPairs:
    """All pairs of a set of photos, which may be of several cameras."""

    Fs: FloatArray
    """(P, 3, 3) in pixels, x2' F x1 = 0, any scale."""
    weights: FloatArray
    """(P,) >= 0, weight of each F."""
    photos: tuple[PairId, ...]
    inliers: tuple[FloatArray, ...]
    """Per pair (N, 4) x1, y1, x2, y2 in pixels."""
    sizes: Mapping[int, tuple[int, int]]
    """(width, height) in pixels by photo."""
    groups: Mapping[int, str]
    """By photo the group that is assumed to share one camera."""
    priors: Mapping[int, CameraPrior] = field(default_factory=dict)
    """Claim about the camera by photo, where there is one."""
    padded_sizes: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    """By photo with bars the size including the bars; `sizes` then has that of the picture inside them. Photos that
    bars bring to one size may each be of another camera."""

    def with_origins(self, corners: Mapping[int, tuple[int, int]]) -> "PhotoPairs":
        """Return the pairs with pixels counted from new origins (left, top) by photo; the sizes stay the same."""
        if not corners:
            return self
        at = np.array([[corners.get(photo, (0, 0)) for photo in pair] for pair in self.photos]).reshape(-1, 2, 2)
        moves = np.tile(np.eye(3), (len(at), 2, 1, 1))
        moves[:, :, :2, 2] = at
        Fs = moves[:, 1].transpose(0, 2, 1) @ self.Fs @ moves[:, 0]
        inliers = tuple(x - corner.reshape(4) for x, corner in zip(self.inliers, at, strict=True))
        priors = {photo: prior.move(*corners.get(photo, (0, 0))) for photo, prior in self.priors.items()}
        return replace(self, Fs=Fs, inliers=inliers, priors=priors)

    def prior_of(self, members: Collection[int]) -> CameraPrior | None:
        """Return the claim about the camera of some photos; None without any."""
        return join_priors([self.priors[photo] for photo in sorted(members) if photo in self.priors])

    def to_camera_pairs(self, members: Collection[int]) -> CameraPairs:
        """Return the pairs whose photos are both members; all members have one size."""
        ids = set(members)
        rows = [k for k, pair in enumerate(self.photos) if ids.issuperset(pair)]
        return CameraPairs(
            Fs=self.Fs[rows].reshape(-1, 3, 3),
            weights=self.weights[rows],
            size=self.sizes[min(ids)],
            photos=tuple(self.photos[k] for k in rows),
            inliers=tuple(self.inliers[k] for k in rows),
            prior=self.prior_of(ids),
        )


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """Pose of view 2 from view 1, with its evidence."""

    R: FloatArray
    """(3, 3) rotation."""
    t: FloatArray
    """(3,) direction of the translation, length 1."""
    inliers: BoolArray
    """(M,) per match of the pair: within the threshold of this pose."""
    angle_deg: float
    """Median triangulation angle of the inliers before both cameras."""
    in_front: float
    """Share of the inliers before both cameras, 0 to 1."""
    kind: str = "calibrated"
    """"calibrated", "uncalibrated" (a camera is a guess: the inliers are those of F), "planar" (all inliers on one
    plane), "rotation" (they show no parallax, so that t means nothing)."""
    guided: bool = False
    """Whether the poses of other pairs guided the estimate."""

    @property
    def inlier_count(self) -> int:
        """Number of matches that agree with the pose."""
        return int(np.count_nonzero(self.inliers))


@dataclass(frozen=True, slots=True)
class LookAlikes:
    """Pairs of photos with matches between equal things in two places."""

    pairs: tuple[PairId, ...]
    missing: float
    """Share of the overlap expected of one place that these pairs lack, 0 to 1."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraph:
    """Pairs whose relative poses agree with each other, and the reasons that exclude the others."""

    poses: Mapping[PairId, RelativePose]
    dropped: Mapping[PairId, str]
    """Pairs with an epipolar geometry, excluded for a reason."""
    groups: tuple[tuple[int, ...], ...]
    """Connected photos, the largest group first."""
    look_alikes: tuple[LookAlikes, ...] = ()
    """Look-alikes that were separated; their pairs are among the dropped ones."""
    doubtful: tuple[LookAlikes, ...] = ()
    """Loops or look-alikes: pairs that the photos between them do not confirm."""

    def connected_photos(self, photo: int) -> tuple[int, ...]:
        """Return the group of a photo; empty without one."""
        return next((group for group in self.groups if photo in group), ())


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What mapping starts from: matches, their epipolar geometry, and cameras."""

    matches: MatchGraph
    views: ViewGraph
    intrinsics: Intrinsics

    def camera_name(self, photo: int) -> str:
        """Return the name of the camera that took a photo."""
        return self.intrinsics.camera_name(self.matches.images[photo])

    def camera(self, photo: int) -> Calibration:
        """Return the camera that took a photo."""
        return self.intrinsics.camera(self.matches.images[photo])

    def without(self, pairs: Collection[PairId]) -> "Evidence":
        """Leave out pairs, which are then evidence neither for a model nor against it."""
        if not pairs:
            return self
        rows = {pair: rows for pair, rows in self.matches.matches.items() if pair not in pairs}
        fits = {pair: fit for pair, fit in self.views.fits.items() if pair not in pairs}
        return replace(self, matches=replace(self.matches, matches=rows), views=replace(self.views, fits=fits))
