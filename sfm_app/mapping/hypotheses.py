"""Hypotheses about the photos that may explain more than the first pass, and the loop that tries them.

A hypothesis has a reason to be tried, and maps other evidence: without false joins, with other cameras, with more
features. The loop keeps an outcome that explains more.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.database import write_match_graph
from sfm_app.colmap.joined_model import with_cameras_of
from sfm_app.colmap.model import cameras_by_photo, posed_photo_ids
from sfm_app.errors import BackendError
from sfm_app.mapping.attempt import (
    MAPPING,
    Attempt,
    NoModel,
    are_many_unregistered,
    choice_reason,
    doubt,
    explained_pairs,
    judge_model,
    support,
)
from sfm_app.mapping.feature_retry import find_finer_evidence, finer_methods, lost_photos
from sfm_app.mapping.look_alikes import OVERLAPS, with_false_joins
from sfm_app.mapping.passes import MAPPERS, Mapper, Mappers, Outcome, Trial, guessed_intrinsics
from sfm_app.mapping.splits import split_attempt
from sfm_app.runtime.context import RunContext
from sfm_app.settings import FIRST_TRIAL, HYPOTHESES, HypothesisName
from sfm_app.types import Calibration, Evidence, Intrinsics


class OPTIONS:
    """When other hypotheses are tried, and accepted."""

    other_focals: tuple[float, ...] = (0.6, 2.4, 4.8)
    """Guesses of the focal besides the usual one, in longer sides: steps of a factor of two. Chosen by hand."""
    focal_tolerance: float = 0.01
    """Relative change of a focal in mapping above which another pass is worth it. Chosen by hand."""
    min_unregistered_share: float = 0.25
    """Share of unregistered photos above which other focals are tried. Chosen by hand."""
    max_photos_for_focals: int = 60
    """Photos above which no other focals are tried. Chosen by hand."""
    min_photos: int = 5
    """With fewer photos, a camera per photo fits almost anything. Chosen by hand."""
    max_photos: int = 100
    """Photos above which their focals are not compared: it costs more than it promises. Chosen by hand."""
    max_remaining_share: float = 0.5
    """Share of the contradictions that may remain with more cameras. Chosen on `benchmarks.trouble`."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """Something that may explain the photos better."""

    name: HypothesisName
    """In the manifest, and in the setting that switches it off."""
    reason: Callable[[Outcome, Mapper], str]
    """Why it is worth trying, given the best outcome; empty where it is not."""
    outcomes: Callable[[Outcome, Mapper], Iterator[Outcome]]
    """Maps the evidence that it changes."""
    repeats: int = 1
    """Most times that it is tried, as long as it is accepted."""


def reconstruct(
    evidence: Evidence, run: RunContext, mappers: Mappers = MAPPERS, hypotheses: Iterable[Hypothesis] | None = None
) -> Outcome:
    """Return models of all connected groups of photos; none where no pair grows into a model."""
    with translate_errors("entering photos"):
        write_match_graph(run.workspace.database, evidence.matches)
    mapper, start = Mapper(run, mappers), time.monotonic()
    first = mapper.map(evidence)
    seconds = time.monotonic() - start
    trial = Trial.of(FIRST_TRIAL, "", NoModel(), first, accepted=True, seconds=seconds, notes=first.notes)
    first = replace(first, trials=(trial, *within(FIRST_TRIAL, first)))
    best = improve(first, mapper, ALL if hypotheses is None else hypotheses)
    return with_doubtful_joins(best, mapper)


def with_doubtful_joins(best: Outcome, mapper: Mapper) -> Outcome:
    """Name the pairs that merge two places of its models, and without which its photos fall apart."""
    joins = mapper.judge_places(best.models)[0]
    doubtful = tuple(dict.fromkeys((*best.graph.doubtful, *joins)))  # finer features may have named them
    return replace(best, graph=replace(best.graph, doubtful=doubtful))


def improve(best: Outcome, mapper: Mapper, hypotheses: Iterable[Hypothesis]) -> Outcome:
    """Try hypotheses in turn, each as long as it is accepted; return the outcome that explains most."""
    options = mapper.run.settings.scene
    for hypothesis in hypotheses:
        if not options.tries(hypothesis.name):
            continue
        for _ in range(hypothesis.repeats):
            reason = hypothesis.reason(best, mapper)
            if not reason:
                break
            if sum(trial.seconds for trial in best.trials if trial.is_hypothesis) >= options.hypotheses_s:
                failure = f"no time was left, of {options.hypotheses_s:g} s"
                late = Trial.of(hypothesis.name, reason, best, best, accepted=False)
                best = replace(best, trials=(*best.trials, replace(late, failure=failure)))
                break
            best, accepted = _try(hypothesis, reason, best, mapper)
            if not accepted:
                break
    return best


def _try(hypothesis: Hypothesis, reason: str, best: Outcome, mapper: Mapper) -> tuple[Outcome, bool]:
    """Return the best outcome with or without a hypothesis, and whether the hypothesis was accepted."""
    mapper.run.progress.say(f"{reason}; trying {HYPOTHESES[hypothesis.name]}")
    first, trials, failure, start = best, list(best.trials), "", time.monotonic()
    try:
        for other in hypothesis.outcomes(best, mapper):
            accepted = is_better(other, best, mapper)
            trials += within(hypothesis.name, other)
            seconds, notes = time.monotonic() - start, other.notes
            trial = Trial.of(hypothesis.name, reason, best, other, accepted=accepted, seconds=seconds, notes=notes)
            trials.append(trial)
            best, start = other if accepted else best, time.monotonic()
    except BackendError as err:  # the best outcome is not lost with it; errors of ours are not hidden
        failure = str(err)
    if failure or len(trials) == len(first.trials):
        seconds = time.monotonic() - start
        trial = Trial.of(hypothesis.name, reason, best, best, accepted=False, seconds=seconds)
        trials.append(replace(trial, failure=failure))
    mapper.write(best)
    return replace(best, trials=tuple(trials)), best is not first


def within(name: str, outcome: Outcome) -> list[Trial]:
    """Return the trials of an outcome as parts of the trial with a name."""
    return [replace(trial, name=f"{name}: {trial.name}") for trial in outcome.trials]


def is_better(other: Outcome, best: Outcome, mapper: Mapper) -> bool:
    """Return whether an outcome replaces the best one: the judge of all hypotheses.

    The one that explains more wins, unless it merges two places that the other one separates: look-alikes explain more,
    and are wrong.
    """
    explains_more = _explains_more(other, best, mapper)
    winner, loser = (other, best) if explains_more else (best, other)
    return explains_more is not _separates_places(loser, winner, mapper)


def _explains_more(other: Outcome, best: Outcome, mapper: Mapper) -> bool:
    """Return whether a main model explains more on the same evidence.

    Of models that explain about equally much, the one with more photos, then the one with fewer cameras wins. More
    cameras must place more photos or remove contradictions, unless a shared camera clearly does not fit.
    """
    if other.main is None or best.main is None:
        return best.main is None and other.main is not None
    fewer, more = (best, other) if other.cameras > best.cameras else (other, best)
    if more.cameras > fewer.cameras and more.photos >= fewer.photos and _divided(fewer, mapper):
        return more is other
    most = OPTIONS.max_remaining_share * best.main.contradicted_share
    if other.cameras > best.cameras and other.photos <= best.photos and other.main.contradicted_share > most:
        return False  # with a camera of its own, a photo fits more than it should
    ours, theirs = best.support, other.support
    if other.evidence.matches is not best.evidence.matches:
        ours = _support_of(best.main, other)
        theirs = _support_of(other.main, other)
    if abs(theirs - ours) > MAPPING.equal_tolerance * max(theirs, ours):
        return theirs > ours
    return (other.photos, -other.cameras, theirs) > (best.photos, -best.cameras, ours)


def _support_of(model: Attempt, outcome: Outcome) -> float:
    max_error_px = outcome.run.settings.epipolar.max_error_px
    return support(explained_pairs(model.model, outcome.evidence, max_error_px))


def _separates_places(other: Outcome, best: Outcome, mapper: Mapper) -> bool:
    """Return whether most photos of a model with two merged places stay, and half of its missing overlaps at most."""
    joins, missing = mapper.judge_places(best.models)
    if not joins or other.photos < MAPPING.enough_share * best.photos:
        return False
    return 2 * mapper.judge_places(other.models)[1] <= missing


# Two different places merged in one model: the pairs that hold them together are left out.


def _false_joins_reason(best: Outcome, mapper: Mapper) -> str:
    return "two different places are merged in the model" if mapper.judge_places(best.models)[0] else ""


def _without_false_joins(best: Outcome, mapper: Mapper) -> Iterator[Outcome]:
    marked = replace(best, graph=with_false_joins(best.graph, mapper.judge_places(best.models)[0]))
    yield mapper.map(marked.trusted).with_earlier(marked)


# A rival where the evidence for our model is weak.


def _rival_reason(best: Outcome, _: Mapper) -> str:
    if best.main is None:
        return "no photo is registered"
    connected, share = len(photos_with_geometry(best.trusted)), best.main.contradicted_share
    # with known cameras, what moves contradicts a model, and a rival with guessed ones follows that
    known = all(best.evidence.camera(photo).identifiable for photo in best.evidence.matches.images)
    if best.photos >= MAPPING.enough_share * connected and (known or share <= MAPPING.max_contradicted_share):
        return ""  # a rival costs more than the doubt that remains is worth
    return doubt(best.main, connected, best.trusted)


def photos_with_geometry(evidence: Evidence) -> set[int]:
    """Return the photos of pairs whose geometry is not degenerate."""
    return {photo for pair, fit in evidence.views.fits.items() if not fit.degeneracy for photo in pair}


def _map_rival(best: Outcome, mapper: Mapper) -> Iterator[Outcome]:
    rival = mapper.mappers.map_rival(best.trusted, mapper.run)
    if isinstance(rival, NoModel):
        yield replace(best, models=(), notes=(rival.note,), reason="", trials=())
        return
    parts = split_attempt(rival, mapper.run)
    taken = {photo for part in parts for photo in posed_photo_ids(part.model)}
    others = [model for model in best.models if taken.isdisjoint(posed_photo_ids(model.model))]
    models = tuple(sorted((*parts, *others), key=lambda attempt: (-attempt.photos, -attempt.support)))
    both = [attempt for attempt in (best.main, rival) if attempt is not None]
    reason = choice_reason(rival, both)
    graph = mapper.with_poses_of(models, best)
    yield replace(best, models=models, graph=graph, notes=(rival.note,), reason=reason, trials=())


# Other focals, where a wrong guess may be why photos that match others are unregistered.


def _focal_reason(best: Outcome, _: Mapper) -> str:
    evidence = best.evidence
    known = any(camera.is_estimated or camera.is_claimed for camera in evidence.intrinsics.cameras.values())
    connected = len(photos_with_geometry(best.trusted))
    if known or connected > OPTIONS.max_photos_for_focals:
        return ""
    is_doubtful = connected - best.photos > OPTIONS.min_unregistered_share * connected
    return "many photos are unregistered and the focal length is a guess" if is_doubtful else ""


def _with_other_focals(best: Outcome, mapper: Mapper) -> Iterator[Outcome]:
    for focal in OPTIONS.other_focals:
        guess = guessed_intrinsics(best.evidence.intrinsics, focal)
        yield mapper.map(replace(best.trusted, intrinsics=guess)).with_earlier(best)


# Other cameras, for a zoom or several devices. Photos of one size share a camera until their pairs contradict that.
# Pairs of a camera that moves forward, round one point or along a plane never do. The photos of a model do: they show
# focal lengths of their own.


def _shared_camera_reason(best: Outcome, mapper: Mapper) -> str:
    """Return why photos of one size may have other cameras: their focals differ in the model, or it lacks many."""
    if best.main is None or mapper.run.settings.photos.cameras != "auto":
        return ""
    enough = len(photos_with_geometry(best.trusted)) >= OPTIONS.min_photos
    is_doubtful = enough and _each(best) and _focal_reason(best, mapper)
    return "a shared camera does not fit" if _divided(best, mapper) or is_doubtful else ""


def _divided(best: Outcome, mapper: Mapper) -> dict[int, int]:
    """Return a number of the camera of each photo whose shared camera clearly does not fit.

    Cameras that somebody has stated stay. In large models, this costs more than it promises.
    """
    if best.main is None or not OPTIONS.min_photos <= best.photos <= OPTIONS.max_photos:
        return {}
    shared, numbers = best.evidence.camera, mapper.find_cameras(best.main.model)
    return {one: numbers[one] for one in numbers if not (shared(one).is_given or shared(one).is_claimed)}


def _each(best: Outcome) -> dict[int, int]:
    """Return a number of the camera of each photo that shares one."""
    photos, name_of = best.evidence.matches.images, best.evidence.camera_name
    sharing = Counter(map(name_of, photos))
    return {photo: photo for photo in photos if sharing[name_of(photo)] > 1}


def _with_other_cameras(best: Outcome, mapper: Mapper) -> Iterator[Outcome]:
    divided = _divided(best, mapper)
    if best.main is None or not divided:
        yield mapper.map(replace(best.trusted, intrinsics=_regroup(best, _each(best)))).with_earlier(best)
        return
    # the model knows their focals better than pairs would know their poses from these
    other = replace(best, evidence=replace(best.evidence, intrinsics=_regroup(best, divided)), trials=())
    mapper.write(other)
    with translate_errors("giving photos other cameras"):
        model = with_cameras_of(other.run.workspace.database, best.main.model)
    how = f"with {other.cameras} instead of {best.cameras} camera{'s' if best.cameras > 1 else ''}"
    attempt = judge_model(other.trusted, best.main.mapper, how, model, mapper.run)
    if isinstance(attempt, Attempt):
        yield replace(other, models=(attempt, *best.models[1:]), notes=(attempt.note,))


def _regroup(best: Outcome, numbers: Mapping[int, int]) -> Intrinsics:
    """Give photos cameras by number, as guesses that begin where mapping ended."""
    evidence, shared = best.evidence, best.evidence.intrinsics
    learned = {} if best.main is None else cameras_by_photo(best.main.model)
    K_of = {evidence.camera_name(photo): K for photo, (K, *_) in learned.items()}
    cameras, camera_of, names = dict(shared.cameras), dict(shared.camera_of), dict[int, str]()
    for photo in sorted(numbers, key=lambda photo: evidence.matches.images[photo].name):
        number, name = numbers[photo], evidence.camera_name(photo)
        if number not in names:
            free = (other for k in count(2) if (other := f"{name} #{k}") not in cameras)
            names[number] = name if name not in names.values() else next(free)
            camera, reason = shared.cameras[name], "photos of its size may be of other cameras"
            size, lens = (camera.width, camera.height), (camera.projection, camera.distortion)
            cameras[names[number]] = Calibration(K_of.get(name, camera.K), *size, "guess", False, reason, *lens)
        camera_of[evidence.matches.images[photo].name] = names[number]
    return replace(shared, cameras=cameras, camera_of=camera_of)


# The cameras of the model, which correct the relative poses.


def _learning_reason(best: Outcome, _: Mapper) -> str:
    """Return why the cameras of the model may help: they differ from those of its pass, or main photos are missing."""
    if best.main is None:
        return ""
    evidence, placed = best.evidence, posed_photo_ids(best.main.model)
    if len(placed) < MAPPING.min_photos:
        return ""
    learned = learned_intrinsics(best).cameras
    before = evidence.intrinsics.cameras
    for name in set(map(evidence.camera_name, placed)):
        change = abs(float(np.log(learned[name].focal_px / before[name].focal_px)))
        if not before[name].is_estimated or change > OPTIONS.focal_tolerance:
            return "mapping has changed a focal length"
    anywhere = {photo for model in best.models for photo in posed_photo_ids(model.model)}
    group = set(best.graph.connected_photos(placed[0]))
    lost = len(group - anywhere)
    return f"unregistered photos with matches: {lost}" if are_many_unregistered(lost, len(group)) else ""


def _with_learned_cameras(best: Outcome, mapper: Mapper) -> Iterator[Outcome]:
    yield mapper.map(replace(best.trusted, intrinsics=learned_intrinsics(best))).with_earlier(best)


def learned_intrinsics(best: Outcome) -> Intrinsics:
    """Replace the cameras of the photos of the main model by its own."""
    intrinsics = best.evidence.intrinsics
    if best.main is None:
        return intrinsics
    with translate_errors("reading cameras"):
        learned = cameras_by_photo(best.main.model)
    cameras = dict(intrinsics.cameras)
    for photo, (K, distortion) in learned.items():
        name = best.evidence.camera_name(photo)
        earlier = intrinsics.cameras[name]
        if earlier.is_kept:
            continue
        # mapping holds a lens with all terms as it was given
        lens = earlier if earlier.has_more_terms else replace(earlier, distortion=distortion)
        cameras[name] = replace(lens, K=K, identifiable=True, reason="", method="mapping")
    return replace(intrinsics, cameras=cameras)


# Finer features, and those of an installed plug-in, for photos that are unregistered.


def _lost_reason(best: Outcome, mapper: Mapper) -> str:
    lost = len(lost_photos(best)) if finer_methods(mapper.run) else 0
    return "" if lost == 0 else "1 photo is unregistered" if lost == 1 else f"{lost} photos are unregistered"


def _with_finer_features(best: Outcome, mapper: Mapper) -> Iterator[Outcome]:
    """Map with the features of each method in turn, not with all together, until no photo is lost."""
    for method in finer_methods(mapper.run):
        finer = find_finer_evidence(best, method, mapper.run)
        if finer is not None:
            other = reconstruct(*finer, mapper.mappers, FIRST_LOOK)
            yield other
            if not lost_photos(other):
                return


RIVAL = Hypothesis("colmap-defaults", _rival_reason, _map_rival)
FIRST_LOOK = (
    Hypothesis("false-joins", _false_joins_reason, _without_false_joins, repeats=OVERLAPS.max_passes),
    Hypothesis("other-focals", _focal_reason, _with_other_focals),
    Hypothesis("other-cameras", _shared_camera_reason, _with_other_cameras, repeats=OVERLAPS.max_passes),
    Hypothesis("learned-cameras", _learning_reason, _with_learned_cameras),
    RIVAL,
)
FINER_FEATURES = Hypothesis("finer-features", _lost_reason, _with_finer_features)
ALL = (*FIRST_LOOK, FINER_FEATURES)
"""In the order of their costs: cheap ones first."""
