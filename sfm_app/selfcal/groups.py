"""Several cameras in one set of photos: one K each, from the pairs within cameras and between them.

Ours, on the constraint of thesis 5.2.4 for two cameras; the thesis leaves several devices to later work (5.8.4). A
camera that its own pairs determine is known. The focals of the others are found together, on a grid, as the choice that
most pairs agree on (max-sum message passing; E = K2'F K1 has two equal singular values for the right two focals), and
then everything is adjusted to the matches at once.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm_app.camera.models import guessed_camera_matrix
from sfm_app.jit import kernel
from sfm_app.selfcal import calibrate_pairs
from sfm_app.selfcal.adjustment import CAMERA, Matches
from sfm_app.selfcal.consensus import CONSENSUS, rejection_reason, uncertainty_reason
from sfm_app.selfcal.pairs import (
    CENTER_U,
    CENTER_V,
    LOG_FOCAL,
    calibration_from_parameters,
    downgrade_to_estimate,
    guess_calibration,
    parameters_from_calibration,
    prepare,
    write_camera,
)
from sfm_app.selfcal.priors import PRIORS, CameraPriors, TiedPriors, claim_rows
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs, CameraPrior
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

LEAST_PAIRS_OF_SEVERAL = 2
"""Pairs that one camera of several needs: two constraints find its focal, two more contradict a wrong one. By
definition of the constraint (thesis 5.2.4)."""


class GROUPS:
    """Focals on a grid, and the verdict on a camera of several. Section 6 of docs/algorithms/zero-curves.md."""

    focals: int = 41
    """Focals on the grid of a camera, 7 % apart. Section 6; by hand."""
    message_rounds: int = 30
    """Most rounds of max-sum message passing; by hand."""
    damping: float = 0.5
    """Share of the previous message that a new one keeps; by hand."""
    fair_share: float = 0.5
    """Share of its votes that every photo must give to a camera split from photos of one size. Chosen on
    `benchmarks.trouble`, seeds 0 to 179 and 1000 to 1020."""
    least_support: float = 0.8
    """Share that all of its photos together must give; two cameras get 0.86 to 0.93. Chosen with it."""


def log_focal_grid(count: int) -> FloatArray:
    """Return (count,) log focals in equal steps, in longer sides."""
    return np.log(np.geomspace(*CONSENSUS.focal_range, count))


class VoteTables:
    """Votes of pairs for any two cameras of their photos; F's are in one unit from the middle of each photo."""

    def __init__(self, Fs: FloatArray, members: IndexArray, weights: FloatArray) -> None:
        ready = prepare(CameraPairs.from_Fs(Fs, (1, 1), weights), unit_px=1.0, origin_px=(0.0, 0.0))
        self.indices = ready.indices
        self.packed_rows, self.members, self.weights = ready.packed_rows, members[ready.indices], ready.weights

    def votes(self, pair: int, first: FloatArray, second: FloatArray, sigma: float) -> FloatArray:
        """Return (A, B) votes w exp(-r / sigma) of a pair for all cameras (A, 5) of view 1 and (B, 5) of view 2."""
        ratios = _ratios(self.packed_rows[pair], first, second)
        return np.asarray(self.weights[pair] * np.exp(-ratios / sigma), np.float64)


@kernel
def _ratios(pair: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Return `consensus.singular_value_ratio` (A, B) for cameras (A, 5) and (B, 5) without distortion."""
    k1, k2, G = np.empty(5), np.empty(5), np.empty((3, 3))
    ratios = np.empty((len(first), len(second)))
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
            ratios[i, j] = np.sqrt(max(square - twice, 0.0) / (square + twice)) if square + twice > 0.0 else 1.0
    return ratios


@kernel
def _minor(x: float, y: float, w: float, k: FloatArray) -> float:
    """Return |adj(K) e|^2."""
    return float((k[1] * (x - k[2] * w)) ** 2 + (k[0] * (y - k[3] * w)) ** 2 + (k[0] * k[1] * w) ** 2)


# The choice of focals: one grid index for every camera.


def consensus_places(own: FloatArray, tables: Iterable[tuple[int, int, FloatArray]]) -> IndexArray:
    """Return `best_places` for votes of pairs: camera i of view 1, camera j of view 2, and a table (G, G) of votes."""
    between: dict[tuple[int, int], FloatArray] = {}
    for i, j, table in tables:
        if i == j:
            own[i] += np.diag(table)
        else:
            key, votes = ((i, j), table) if i < j else ((j, i), table.T)
            between[key] = between.get(key, 0.0) + votes
    return best_places(own, between)


def best_places(own: FloatArray, between: dict[tuple[int, int], FloatArray]) -> IndexArray:
    """Choose a grid index for every camera so that the sum over cameras and over pairs of cameras is large.

    Damped max-sum message passing (Pearl 1988; exact on trees), then coordinate ascent. Ascent also starts from the
    best index of each camera by itself, which messages on loops do not always outdo. `own` (C, G) has the values of
    cameras by themselves, `between` (G, G) those of two cameras i < j.
    """
    ends = np.array(list(between), np.int64).reshape(-1, 2)
    votes = np.array(list(between.values()), np.float64).reshape(-1, *own.shape[1:] * 2)
    tables = np.array([votes, votes.transpose(0, 2, 1)])
    starts = _pass_messages(own, ends, tables, GROUPS.message_rounds, GROUPS.damping), own
    found = [_ascend_coordinates(np.argmax(start, axis=1), own, ends, tables) for start in starts]
    return max(found, key=lambda places: _total_gain(places, own, between))


@kernel
def _pass_messages(own: FloatArray, ends: IndexArray, tables: FloatArray, rounds: int, damping: float) -> FloatArray:
    """Return values (C, G) with messages; `tables` (2, E, G, G) of the cameras `ends` (E, 2), and their transposes."""
    messages, new = np.zeros((2, len(ends), own.shape[1])), np.empty(own.shape[1])
    for turn in range(rounds + 1):
        belief = own.copy()
        for side in range(2):
            for edge in range(len(ends)):
                belief[ends[edge, 1 - side]] += messages[side, edge]
        if turn == rounds:
            break
        for side in range(2):
            for edge in range(len(ends)):
                value = belief[ends[edge, side]] - messages[1 - side, edge]
                new[:] = -np.inf
                for k in range(len(new)):
                    for j in range(len(new)):
                        vote = value[k] + tables[side, edge, k, j]
                        new[j] = vote if vote > new[j] else new[j]
                messages[side, edge] = damping * messages[side, edge] + (1.0 - damping) * (new - np.max(new))
    return belief


def _ascend_coordinates(places: IndexArray, own: FloatArray, ends: IndexArray, tables: FloatArray) -> IndexArray:
    """Give every camera in turn its best index, with the others fixed, until none changes."""
    places = places.astype(np.int64)
    for _ in range(GROUPS.message_rounds):
        before = places.copy()
        for camera in range(len(places)):
            value = own[camera].copy()
            for side in range(2):
                for edge in np.flatnonzero(ends[:, 1 - side] == camera):
                    value += tables[side, edge, places[ends[edge, side]]]
            places[camera] = int(np.argmax(value))
        if np.array_equal(places, before):
            break
    return places


def _total_gain(places: IndexArray, own: FloatArray, between: dict[tuple[int, int], FloatArray]) -> float:
    shared = sum(float(table[places[i], places[j]]) for (i, j), table in between.items())
    return float(np.sum(own[np.arange(len(places)), places])) + shared


@dataclass(frozen=True, slots=True, eq=False)
class CameraGroup:
    """One camera of several."""

    size: tuple[int, int]
    """(width, height) of its photos in pixels."""
    start: Calibration | None = None
    """Calibration from its own pairs or from splitting its group; None for none."""
    known: bool = False
    """Whether its own pairs determine `start`."""
    prior: CameraPrior | None = None
    family: int = -1
    """Number of the folder whose photos have similar cameras, one each; -1 for none."""
    divided: bool = False
    """Whether it was split from photos of one size: then each of its photos must support it."""


def calibrate_cameras(
    cameras: Sequence[CameraGroup], pairs: CameraPairs, members: IndexArray, options: CalibrationSettings, method: str
) -> list[Calibration]:
    """Return one calibration per camera, in their order; `members` (P, 2) are the cameras of both views."""
    unit = float(max(max(camera.size) for camera in cameras))
    rows, Fs, matches = _convert_to_units(cameras, pairs, members, unit)
    members, weights, photos = members[rows], pairs.weights[rows], [pairs.photos[k] for k in rows]
    sides = np.array([max(camera.size) / unit for camera in cameras])
    claims = claim_rows([camera.prior for camera in cameras], [camera.size for camera in cameras], unit)
    families = np.array([camera.family for camera in cameras], np.int64)
    priors = TiedPriors(sides, claims, options.center_sigma, options.lens, families)
    thetas = np.array(
        [
            [PRIORS.usual_log_focal + np.log(side), 0.0, 0.0, 0.0, 0.0]
            if camera.start is None
            else parameters_from_calibration(camera.start, unit)
            for camera, side in zip(cameras, sides, strict=True)
        ]
    )
    unknown = np.array([camera.start is None for camera in cameras])
    if unknown.any():
        thetas = _find_focals(thetas, unknown, VoteTables(Fs, members, weights), priors)
    fit = calibrate_pairs.fit_cameras(matches, Fs, [thetas], priors)
    tables = VoteTables(calibrate_pairs.undistorted_fundamentals(fit), members, weights)
    cov = calibrate_pairs.covariance(fit, sides)
    calibrations = [_judge_camera(k, camera, fit, cov, tables, method) for k, camera in enumerate(cameras)]
    camera_of = dict(zip(photos, members.tolist(), strict=True))
    order = calibrate_pairs.key_pairs(fit, tuple(photos))
    return [
        replace(calibration, key_pairs=tuple(pair for pair in order if camera_of[pair] == [k, k]))
        for k, calibration in enumerate(calibrations)
    ]


def _judge_camera(
    index: int, camera: CameraGroup, fit: calibrate_pairs.Fit, covariances: FloatArray, tables: VoteTables, method: str
) -> Calibration:
    """Return the verdict on one camera of a joint fit with these covariances (5C, 5C)."""
    theta, unit = fit.state.thetas[index], fit.matches.unit_px
    block = slice(CAMERA * index, CAMERA * (index + 1))
    cov = covariances[block, block]
    own = np.flatnonzero((fit.matches.cameras == index).any(axis=1))
    margin, support = _margin(index, fit.state.thetas, tables)
    spread = float(np.sqrt(cov[LOG_FOCAL, LOG_FOCAL]))
    evidence = {
        "pairs": float(len(own)),
        "support": support,
        "lead": margin,
        "log_focal_spread": spread,
        "noise_px": fit.state.sigma * unit,
        "weight": float(np.sum(fit.state.weights[own])),
    }
    uncertain = uncertainty_reason(spread, one_of_many=camera.family >= 0)
    reason = ""
    if len(own) < LEAST_PAIRS_OF_SEVERAL:
        reason = f"{len(own)} usable pairs, {LEAST_PAIRS_OF_SEVERAL} are needed"
    elif not camera.known and margin < CONSENSUS.min_margin:
        reason = "the pairs fit other focals as well or better"
    # a motion that leaves the focal open is the reason only where the deviation is small
    elif (camera.family >= 0 or camera.divided) and not (camera.divided and uncertain):
        reason = calibrate_pairs.critical_motion(fit)
    side = max(camera.size) / unit
    in_sides = np.array([theta[LOG_FOCAL] - np.log(side), theta[CENTER_U] / side, theta[CENTER_V] / side])
    reason = reason or rejection_reason(in_sides, spread, camera.size)
    if reason:
        guess = guess_calibration(camera.size, reason, evidence)
        if camera.family < 0:
            return guess
        # its focal contains the mean of the family: a better start for mapping than the usual one
        low, high = np.array(CONSENSUS.focal_range) * max(camera.size)
        focal_px = float(np.clip(np.exp(theta[LOG_FOCAL]) * unit, low, high))
        return replace(guess, K=guessed_camera_matrix(camera.size, focal_px))
    calibration = downgrade_to_estimate(
        replace(
            calibration_from_parameters(theta, camera.size, method, unit),
            **calibrate_pairs.camera_uncertainty(theta, cov, unit),
            evidence=evidence,
            held=fit.held_names(index),
        ),
        uncertain,
    )
    if calibration.identifiable and camera.divided:
        least = _least_share(index, fit.state.thetas, tables, fit.matches.photos)
        if least < GROUPS.fair_share or support < GROUPS.least_support:
            return downgrade_to_estimate(calibration, "some of its photos do not support it")
    return calibration


def _convert_to_units(
    cameras: Sequence[CameraGroup], pairs: CameraPairs, members: IndexArray, unit: float
) -> tuple[IndexArray, FloatArray, Matches]:
    """Return the rows of the usable pairs, and their F's and inliers in units from the middle of each photo."""
    ready = prepare(pairs, unit_px=unit, origin_px=(0.0, 0.0))
    middles = np.array([camera.size for camera in cameras]) / (2.0 * unit)
    used = members[ready.indices]
    shifts = np.tile(np.eye(3), (len(cameras), 1, 1))
    shifts[:, :2, 2] = middles
    Fs = shifts[used[:, 1]].transpose(0, 2, 1) @ ready.F @ shifts[used[:, 0]]
    inliers = [
        np.asarray(pairs.inliers[k], np.float64) / unit - np.concatenate([middles[i], middles[j]])
        for k, (i, j) in zip(ready.indices, used, strict=True)
    ]
    photos = np.array([pairs.photos[k] for k in ready.indices]).reshape(-1, 2)
    return ready.indices, Fs, Matches(inliers, used, photos, unit, count=len(cameras))


def _find_focals(thetas: FloatArray, unknown: BoolArray, tables: VoteTables, priors: CameraPriors) -> FloatArray:
    trials = np.repeat(thetas[:, None], GROUPS.focals, axis=1)
    trials[unknown, :, LOG_FOCAL] = log_focal_grid(GROUPS.focals) + np.log(priors.sides[unknown])[:, None]
    usual = trials[..., LOG_FOCAL] - np.log(priors.sides)[:, None] - PRIORS.usual_log_focal
    own = -0.5 * (usual / PRIORS.focal_spread) ** 2
    claimed = priors.claims_focal
    mean, deviation = priors.claims[:, claimed, LOG_FOCAL, None]
    own[claimed] += np.exp(-0.5 * ((trials[claimed, :, LOG_FOCAL] - mean) / deviation) ** 2)
    votes = (
        (i, j, tables.votes(pair, trials[i], trials[j], CONSENSUS.sigmas[0]))
        for pair, (i, j) in enumerate(tables.members)
    )
    chosen = thetas.copy()
    chosen[:, LOG_FOCAL] = trials[np.arange(len(thetas)), consensus_places(own, votes), LOG_FOCAL]
    return chosen


def _margin(index: int, thetas: FloatArray, tables: VoteTables) -> tuple[float, float]:
    """Return the margin of a camera's focal over all others, the other cameras fixed, and its share of its votes."""
    offsets = np.concatenate([[0.0], np.linspace(-1.5, 1.5, 61)])
    trials = np.repeat(thetas[None, index], len(offsets), axis=0)
    trials[:, LOG_FOCAL] += offsets
    total, most = np.zeros(len(offsets)), 0.0
    for pair, (i, j) in enumerate(tables.members):
        if index not in (i, j):
            continue
        most += tables.weights[pair]
        if i == j:
            total += np.diag(tables.votes(pair, trials, trials, CONSENSUS.sigmas[-1]))
        elif i == index:
            total += tables.votes(pair, trials, thetas[j][None], CONSENSUS.sigmas[-1])[:, 0]
        else:
            total += tables.votes(pair, thetas[i][None], trials, CONSENSUS.sigmas[-1])[0]
    rivals = total[np.abs(offsets) > np.log(CONSENSUS.rival_ratio)]
    return float(total[0] - np.max(rivals)), float(total[0] / most) if most > 0 else 0.0


def _least_share(index: int, thetas: FloatArray, tables: VoteTables, photos: IndexArray) -> float:
    """Return the smallest share of possible votes that the pairs of one photo of a camera give; 0 without pairs."""
    totals: dict[int, FloatArray] = {}
    for k, (i, j) in enumerate(tables.members):
        votes = float(tables.votes(k, thetas[i][None], thetas[j][None], CONSENSUS.sigmas[0])[0, 0])
        for camera, photo in zip((i, j), photos[tables.indices[k]].tolist(), strict=True):
            if camera == index:
                totals[photo] = totals.get(photo, np.zeros(2)) + np.array([votes, tables.weights[k]])
    return min((float(votes / most) for votes, most in totals.values()), default=0.0)
