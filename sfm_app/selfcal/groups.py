"""Several cameras in one set of photos."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.camera.models import guessed_camera_matrix
from sfm_app.jit import kernel
from sfm_app.selfcal import consensus
from sfm_app.selfcal.adjustment import CAMERA, Matches
from sfm_app.selfcal.calibrate_pairs import (
    Fit,
    camera_uncertainty,
    covariance,
    critical_motion,
    fit_cameras,
    key_pairs,
    undistorted_fundamentals,
)
from sfm_app.selfcal.consensus import FOCAL_RANGE, MIN_LEAD, RIVAL_RATIO, SIGMAS
from sfm_app.selfcal.pairs import (
    LOG_FOCAL,
    calibration_from_parameters,
    downgrade_to_estimate,
    guess_calibration,
    parameters_from_calibration,
    prepare,
    write_camera,
)
from sfm_app.selfcal.priors import FAMILY_SPREAD, FOCAL_SPREAD, HINT_SPREAD, USUAL_FOCAL, CameraPriors, TiedPriors
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs, PairId
from sfm_app.types.arrays import FloatArray, IndexArray

# One grid index for every camera, so that what the cameras are worth alone and in pairs has a large sum.
#
# Max-sum message passing is Pearl's (1988).

MESSAGE_ROUNDS, DAMPING = 30, 0.5
"""Most rounds of max-sum message passing, and the share of the previous message that a new one keeps. Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""


def best_places(own: FloatArray, between: dict[tuple[int, int], FloatArray]) -> IndexArray:
    """Choose a grid index for every camera so that the sum over cameras and over pairs of cameras is large.

    Damped max-sum message passing (Pearl 1988; exact on trees), then coordinate ascent. Ascent also starts from the
    best index of each camera by itself, which messages on loops do not always outdo.

    Args:
        own, between: (C, G) value of each camera by itself; (G, G) value of two cameras i < j together, by (i, j).
    """
    tables = {(i, j): table for (i, j), table in between.items()} | {(j, i): t.T for (i, j), t in between.items()}
    messages = {edge: np.zeros(own.shape[1]) for edge in tables}
    for _ in range(MESSAGE_ROUNDS):
        belief = own.copy()
        for (_, to), message in messages.items():
            belief[to] += message
        for (source, to), table in tables.items():
            new = np.max((belief[source] - messages[to, source])[:, None] + table, axis=0)
            messages[source, to] = DAMPING * messages[source, to] + (1.0 - DAMPING) * (new - np.max(new))
    belief = own.copy()
    for (_, to), message in messages.items():
        belief[to] += message
    ends = [_ascend_coordinates(np.argmax(start, axis=1), own, tables) for start in (belief, own)]
    return max(ends, key=lambda places: _total_gain(places, own, between))


def _ascend_coordinates(places: IndexArray, own: FloatArray, tables: dict[tuple[int, int], FloatArray]) -> IndexArray:
    """Give every camera in turn its best index, with the others fixed, until none changes."""
    places = places.astype(np.int64)
    for _ in range(MESSAGE_ROUNDS):
        before = places.copy()
        for camera in range(len(places)):
            value = own[camera].copy()
            for (source, to), table in tables.items():
                if to == camera:
                    value += table[places[source]]
            places[camera] = int(np.argmax(value))
        if np.array_equal(places, before):
            break
    return places


def _total_gain(places: IndexArray, own: FloatArray, between: dict[tuple[int, int], FloatArray]) -> float:
    shared = sum(float(table[places[i], places[j]]) for (i, j), table in between.items())
    return float(np.sum(own[np.arange(len(places)), places])) + shared


# Several cameras in one set of photos: one K each, from the pairs within cameras and between them.
#
# Ours, on the constraint of thesis 5.2.4 for two cameras; the thesis leaves several devices to later work (5.8.4).
#
# A camera that its own pairs determine is known. The focals of the others are found together, on a grid, as the
# choice that most pairs agree on (max-sum message passing; E = K2'F K1 has two equal singular values for the right
# two focals), and then everything is adjusted to the matches at once.

FOCALS = 41
"""Focals on the grid of a camera, each 7 % above the one before. docs/algorithms.md, Self-calibration, 6. Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""
FAIR_SHARE, LEAST_SUPPORT, UNSUPPORTED_REASON = 0.5, 0.8, "not all of its photos support it"
"""Shares of their votes that every photo, and all together, must give to a camera split from photos of one size, and
the reason where they do not. Chosen on folders 0 to 179 and 1000 to 1020 of `python -m benchmarks.trouble`: two cameras
get 0.86 to 0.93 (0.57 and 0.69 with a moving object), those of a zoom and those over 5 % off 0.44 to 0.76."""
LEAST_PAIRS = 2
"""Pairs that a camera needs: two constraints find its focal, two more contradict a wrong one. Counted: by definition of
the constraint (thesis 5.2.4)."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraGroup:
    """One camera of several."""

    size: tuple[int, int]
    """(width, height) of its photos in pixels."""
    start: Calibration | None = None
    """Calibration from its own pairs or from splitting its group; None where there is none."""
    known: bool = False
    """Whether its own pairs determine `start`."""
    hint_px: float = np.nan
    """Claimed focal; NaN for none."""
    family: int = -1
    """Number of the folder whose photos have similar cameras, one each; -1 for none."""
    divided: bool = False
    """Whether it was split from photos of one size: then each of its photos must support it."""

    @property
    def is_whole(self) -> bool:
        """Whether it was calibrated from all of its own pairs and no others."""
        return self.family < 0 and not self.divided


def calibrate_cameras(
    cameras: Sequence[CameraGroup], pairs: CameraPairs, members: IndexArray, options: CalibrationSettings, method: str
) -> list[Calibration]:
    """Return one calibration per camera, in their order; each is identifiable or a guess with the reason.

    Args:
        cameras: sizes and prior knowledge.
        pairs: all pairs, within and between cameras, with inliers; the size is not used.
        members: (P, 2) number of the camera that took view 1, view 2.
        options: prior on the center, and whether to look for a lens.
        method: name that goes into the answers.
    """
    unit = float(max(max(camera.size) for camera in cameras))
    kept, Fs, matches = _convert_to_units(cameras, pairs, members, unit)
    members = members[kept]
    sides = np.array([max(camera.size) / unit for camera in cameras])
    hints = np.array([camera.hint_px for camera in cameras]) / unit
    families = np.array([camera.family for camera in cameras], np.int64)
    priors = TiedPriors(sides, hints, options.center_sigma, options.lens, families)
    weights = pairs.weights[kept]
    thetas = np.array([_initial_parameters(camera, side, unit) for camera, side in zip(cameras, sides, strict=True)])
    unknown = np.array([camera.start is None for camera in cameras])
    if unknown.any():
        thetas = _find_focals(thetas, unknown, VoteTables(Fs, members, weights), priors)
    fit = fit_cameras(matches, Fs, [thetas], priors)
    cov = covariance(fit, sides)
    straight = VoteTables(undistorted_fundamentals(fit), members, weights)
    best = key_pairs(fit, tuple(pairs.photos[k] for k in kept))
    of = {pairs.photos[k]: (int(first), int(second)) for k, (first, second) in zip(kept, members, strict=True)}
    shares = _least_shares(fit.state.thetas, straight, [pairs.photos[k] for k in kept])
    motion = critical_motion(fit)
    found = [
        replace(
            _judge_camera(k, camera, fit, cov, straight, unit, method, "" if camera.is_whole else motion),
            key_pairs=tuple(pair for pair in best if of[pair] == (k, k)),
        )
        for k, camera in enumerate(cameras)
    ]
    return [
        _downgrade_if_unsupported(one, shares.get(k, 0.0)) if one.identifiable and camera.divided else one
        for k, (one, camera) in enumerate(zip(found, cameras, strict=True))
    ]


def _downgrade_if_unsupported(found: Calibration, least: float) -> Calibration:
    """Return the calibration, as an estimate where all photos or the worst (`least`) give it too few votes."""
    doubtful = least < FAIR_SHARE or found.evidence["support"] < LEAST_SUPPORT
    return downgrade_to_estimate(found, UNSUPPORTED_REASON if doubtful else "")


class VoteTables:
    """Votes of pairs for any two cameras of their photos.

    Args:
        Fs: (P, 3, 3) in one unit from the middle of each photo.
        members: (P, 2) cameras.
        weights: (P,).
    """

    def __init__(self, Fs: FloatArray, members: IndexArray, weights: FloatArray) -> None:
        ones = CameraPairs.from_Fs(Fs, (1, 1), weights)
        ready = prepare(ones, unit_px=1.0, origin_px=(0.0, 0.0))
        self.kept = ready.kept
        self.packed_rows, self.members, self.weights = ready.packed_rows, members[ready.kept], ready.weights

    def votes(self, pair: int, first: FloatArray, second: FloatArray, sigma: float) -> FloatArray:
        """Return (A, B) w exp(-r / sigma) for all pairs of cameras.

        Args:
            pair: row of the pair.
            first: (A, 5) cameras of view 1.
            second: (B, 5) cameras of view 2.
            sigma: width of a vote, in units of r, > 0.
        """
        return np.asarray(
            self.weights[pair] * np.exp(-_ratios(self.packed_rows[pair], first, second) / sigma), np.float64
        )


def _least_shares(thetas: FloatArray, tables: VoteTables, photos: Sequence[PairId]) -> dict[int, float]:
    """Return by camera the smallest share of possible votes that the pairs of one of its photos give."""
    got: dict[tuple[int, int], float] = {}
    most: dict[tuple[int, int], float] = {}
    for k, (i, j) in enumerate(tables.members):
        pair = photos[tables.kept[k]]
        votes = float(tables.votes(k, thetas[i][None], thetas[j][None], SIGMAS[0])[0, 0])
        for key in ((int(i), pair[0]), (int(j), pair[1])):
            got[key] = got.get(key, 0.0) + votes
            most[key] = most.get(key, 0.0) + float(tables.weights[k])
    least: dict[int, float] = {}
    for (camera, _), share in ((key, got[key] / most[key]) for key in got):
        least[camera] = min(share, least.get(camera, 1.0))
    return least


def _convert_to_units(
    cameras: Sequence[CameraGroup], pairs: CameraPairs, members: IndexArray, unit: float
) -> tuple[IndexArray, FloatArray, Matches]:
    """Return the usable pairs, and their F's and inliers in units from the middle of each photo."""
    ready = prepare(pairs, unit_px=unit, origin_px=(0.0, 0.0))
    middles = np.array([camera.size for camera in cameras]) / (2.0 * unit)
    used = members[ready.kept]
    moves = np.tile(np.eye(3), (len(cameras), 1, 1))
    moves[:, :2, 2] = middles
    Fs = moves[used[:, 1]].transpose(0, 2, 1) @ ready.F @ moves[used[:, 0]]
    inliers = [
        np.asarray(pairs.inliers[k], np.float64) / unit - np.concatenate([middles[i], middles[j]])
        for k, (i, j) in zip(ready.kept, used, strict=True)
    ]
    photos = np.array([pairs.photos[k] for k in ready.kept]).reshape(-1, 2)
    return ready.kept, Fs, Matches(inliers, used, photos, unit, count=len(cameras))


def _initial_parameters(camera: CameraGroup, side: float, unit: float) -> FloatArray:
    if camera.start is not None:
        return parameters_from_calibration(camera.start, unit)
    return np.array([USUAL_FOCAL + np.log(side), 0.0, 0.0, 0.0, 0.0])


def _find_focals(
    thetas: FloatArray, unknown: NDArray[np.bool_], tables: VoteTables, priors: CameraPriors
) -> FloatArray:
    """Return the cameras with the unknown focals on which most pairs agree."""
    grid = np.log(np.geomspace(*FOCAL_RANGE, FOCALS))
    trials = np.repeat(thetas[:, None], FOCALS, axis=1)
    trials[unknown, :, LOG_FOCAL] = grid + np.log(priors.sides[unknown])[:, None]
    own = -0.5 * ((trials[..., LOG_FOCAL] - np.log(priors.sides)[:, None] - USUAL_FOCAL) / FOCAL_SPREAD) ** 2
    hinted = np.isfinite(priors.hints)
    off = (trials[hinted, :, LOG_FOCAL] - np.log(priors.hints[hinted])[:, None]) / HINT_SPREAD
    own[hinted] += np.exp(-0.5 * off**2)
    between: dict[tuple[int, int], FloatArray] = {}
    for pair, (i, j) in enumerate(tables.members):
        table = tables.votes(pair, trials[i], trials[j], SIGMAS[0])
        if i == j:
            own[i] += np.diag(table)
        else:
            key, table = ((i, j), table) if i < j else ((j, i), table.T)
            between[key] = between.get(key, 0.0) + table
    places = best_places(own, between)
    chosen = thetas.copy()
    chosen[:, LOG_FOCAL] = trials[np.arange(len(thetas)), places, LOG_FOCAL]
    return chosen


def _judge_camera(
    index: int, camera: CameraGroup, fit: Fit, cov: FloatArray, straight: VoteTables, unit: float, method: str,
    motion: str,
) -> Calibration:  # fmt: skip
    """Return the calibration of one camera, or a guess and why; `motion` names a motion that leaves all focals open."""
    theta = fit.state.thetas[index]
    block = cov[CAMERA * index : CAMERA * (index + 1), CAMERA * index : CAMERA * (index + 1)]
    mine = np.flatnonzero((fit.matches.cameras == index).any(axis=1))
    lead, support = _lead(index, fit.state.thetas, straight)
    side = max(camera.size) / unit
    in_sides = theta - np.array([np.log(side), 0.0, 0.0, 0.0, 0.0])
    in_sides[1:3] /= side
    spread = float(np.sqrt(block[LOG_FOCAL, LOG_FOCAL]))
    evidence = {
        "pairs": float(len(mine)),
        "support": support,
        "lead": lead,
        "log_focal_spread": spread,
        "noise_px": fit.state.sigma * unit,
        "weight": float(np.sum(fit.state.weights[mine])),
    }
    half = (0.5 * camera.size[0] / max(camera.size), 0.5 * camera.size[1] / max(camera.size))
    reason = ""
    if len(mine) < LEAST_PAIRS:
        reason = f"{len(mine)} usable pairs, {LEAST_PAIRS} are needed"
    elif not camera.known and lead < MIN_LEAD:
        reason = "the pairs fit other focals as well or better"
    vague = consensus.vagueness(spread, one_of_many=camera.family >= 0)
    # a motion that leaves the focal open is the reason only where the deviation is small
    reason = reason or (not (camera.divided and vague) and motion) or consensus.objection(in_sides, spread, half)
    if reason and camera.family >= 0:
        # it contains the mean of the family: a better start for mapping than the usual focal
        return replace(
            guess_calibration(camera.size, reason, evidence), K=_family_camera_matrix(theta, camera.size, unit)
        )
    if reason:
        return guess_calibration(camera.size, reason, evidence)
    found = calibration_from_parameters(theta, camera.size, method, unit)
    uncertainty = camera_uncertainty(theta, block, unit)
    found = replace(found, **uncertainty._asdict(), evidence=evidence, held=fit.held_names(index))
    return downgrade_to_estimate(found, vague)


def _family_camera_matrix(theta: FloatArray, size: tuple[int, int], unit: float) -> FloatArray:
    """Return the usual camera matrix with the most likely focal, though uncertain."""
    side = max(size)
    low, high = np.array(FOCAL_RANGE) * side
    return guessed_camera_matrix(size, float(np.clip(np.exp(theta[LOG_FOCAL]) * unit, low, high)))


def _lead(index: int, thetas: FloatArray, tables: VoteTables) -> tuple[float, float]:
    """Return votes by which a camera's focal leads all others, the other cameras fixed, and its share of its votes."""
    offsets = np.concatenate([[0.0], np.linspace(-1.5, 1.5, 61)])
    trials = np.repeat(thetas[None, index], len(offsets), axis=0)
    trials[:, LOG_FOCAL] += offsets
    total, most = np.zeros(len(offsets)), 0.0
    for pair, (i, j) in enumerate(tables.members):
        if index not in (i, j):
            continue
        most += tables.weights[pair]
        if i == j:
            total += np.diag(tables.votes(pair, trials, trials, SIGMAS[-1]))
        elif i == index:
            total += tables.votes(pair, trials, thetas[j][None], SIGMAS[-1])[:, 0]
        else:
            total += tables.votes(pair, thetas[i][None], trials, SIGMAS[-1])[0]
    rivals = total[np.abs(offsets) > np.log(RIVAL_RATIO)]
    return float(total[0] - np.max(rivals)), float(total[0] / most) if most > 0 else 0.0


@kernel
def _ratios(pair: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Return (A, B) r = (s1 - s2) / (s1 + s2) of E = K2'F K1, for cameras (A, 5) and (B, 5), without distortion.

    As `constraints.singular_value_ratio`, with two cameras.
    """
    k1, k2, G = np.empty(5), np.empty(5), np.empty((3, 3))
    found = np.empty((len(first), len(second)))
    for i in range(len(first)):
        write_camera(first[i], k1)
        for row in range(3):
            a, b, c = pair[3 * row], pair[3 * row + 1], pair[3 * row + 2]
            G[row, 0], G[row, 1], G[row, 2] = a * k1[0], b * k1[1], a * k1[2] + b * k1[3] + c
        n1 = _minor(pair[9], pair[10], pair[11], k1)
        for j in range(len(second)):
            write_camera(second[j], k2)
            square = 0.0
            for column in range(3):
                p, q = G[0, column], G[1, column]
                square += (k2[0] * p) ** 2 + (k2[1] * q) ** 2 + (k2[2] * p + k2[3] * q + G[2, column]) ** 2
            twice = 2.0 * pair[15] * np.sqrt(n1 * _minor(pair[12], pair[13], pair[14], k2))
            found[i, j] = np.sqrt(max(square - twice, 0.0) / (square + twice)) if square + twice > 0.0 else 1.0
    return found


@kernel
def _minor(x: float, y: float, w: float, k: FloatArray) -> float:
    """Return |adj(K) e|^2."""
    return float((k[1] * (x - k[2] * w)) ** 2 + (k[0] * (y - k[3] * w)) ** 2 + (k[0] * k[1] * w) ** 2)


# Votes of pairs for the focals of their two photos, on a common grid.
#
# Ours: the consensus of thesis 5.8.4 on the focals alone.

SIGMA = 0.05
"""Width of the votes, in units of r: neighbors on the grid of focals, 7 % apart, still vote for each other. Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""
MOST_PAIRS = 1500
"""Most pairs that vote, evenly chosen: tables of all focals of both photos take 13 kB a pair. Chosen by hand; halved
and doubled by `benchmarks.sensitivity`."""


def subsample_pairs(count: int) -> IndexArray:
    """Return the indices of the pairs that vote, evenly chosen out of `count`."""
    return np.linspace(0, count - 1, min(count, MOST_PAIRS)).astype(np.int64)


class FocalGrid:
    """Votes of pairs for the focals of their two photos.

    Args:
        tables: undistorted pairs.
        rows: (P,) indices of the pairs that vote.
        theta: (5,) camera with the center and aspect of all photos.
        members: (P, 2) photos, counted from 0.
    """

    def __init__(self, tables: VoteTables, rows: IndexArray, theta: FloatArray, members: IndexArray) -> None:
        self.votes, self.members = _tabulate_votes(tables, rows, theta), members
        self.grid = np.log(np.geomspace(*FOCAL_RANGE, FOCALS))

    def places(self, cameras: IndexArray, rows: IndexArray) -> IndexArray:
        """Return (C,) grid indices of the focals on which the given pairs agree.

        Args:
            cameras: camera of each photo, counted from 0.
            rows: the pairs that vote.
        """
        one = np.einsum("pgg->g", self.votes[rows]) - 0.5 * ((self.grid - USUAL_FOCAL) / FOCAL_SPREAD) ** 2
        priors = -0.5 * ((self.grid - self.grid[np.argmax(one)]) / FAMILY_SPREAD) ** 2
        if np.max(cameras) == 0:
            return np.array([np.argmax(one)])
        own = np.tile(priors, (int(np.max(cameras)) + 1, 1))
        between: dict[tuple[int, int], FloatArray] = {}
        for row in rows:
            i, j = (int(cameras[photo]) for photo in self.members[row])
            table = self.votes[row]
            if i == j:
                own[i] += np.diag(table)
            else:
                key, table = ((i, j), table) if i < j else ((j, i), table.T)
                between[key] = between.get(key, 0.0) + table
        return best_places(own, between)

    def pair_votes(self, places: IndexArray) -> FloatArray:
        """Return (P,) votes of the pairs if photo k has the focal at `places[k]`."""
        first, second = places[self.members].T
        return np.asarray(self.votes[np.arange(len(self.votes)), first, second], np.float64)

    def fitted_votes(self, cameras: IndexArray) -> float:
        """Return the sum of the votes for the focals on which all pairs agree."""
        return float(np.sum(self.pair_votes(self.places(cameras, np.arange(len(self.votes)))[cameras])))

    def held_out_votes(self, cameras: IndexArray, fold: IndexArray) -> FloatArray:
        """Return (P,) votes of every pair for the focals on which the pairs of the other folds agree.

        Args:
            cameras: camera of each photo, counted from 0.
            fold: (P,) number of the fold of each pair.
        """
        found = np.zeros(len(self.votes))
        for number in np.unique(fold):
            out = fold == number
            found[out] = self.pair_votes(self.places(cameras, np.flatnonzero(~out))[cameras])[out]
        return found


def _tabulate_votes(tables: VoteTables, rows: IndexArray, theta: FloatArray) -> FloatArray:
    trials = np.repeat(theta[None], FOCALS, axis=0)
    trials[:, LOG_FOCAL] = np.log(np.geomspace(*FOCAL_RANGE, FOCALS))
    trials[:, -1] = 0.0
    return np.array([tables.votes(int(row), trials, trials, SIGMA) for row in rows])
