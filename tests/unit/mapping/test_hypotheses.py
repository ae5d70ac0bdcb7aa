"""Hypotheses and the loop that tries them; mappers find the models of a test, models and database are real."""

from dataclasses import replace
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.bundle import adjust, solve
from sfm_app.colmap.database import open_database
from sfm_app.colmap.model import posed_images, posed_photo_ids
from sfm_app.errors import BackendError, ClusterError, ConfigError, NumericalError
from sfm_app.mapping.attempt import Attempt, PairSupport
from sfm_app.mapping.hypotheses import ALL, OPTIONS, is_better, learned_intrinsics
from sfm_app.mapping.passes import Mapper, Mappers, Outcome
from sfm_app.posegraph.graph import LOOKS_ALIKE
from sfm_app.settings import HYPOTHESES, HypothesisName, Settings
from sfm_app.types import Evidence, Intrinsics, LookAlikes, MatchedImage, MatchGraph, PoseGraph, ViewGraph
from tests.unit.mapping.fakes import (
    AGAINST,
    EMPTY,
    FOCAL,
    GOOD,
    TRUE,
    Fakes,
    focals_in,
    geometries_in,
    hypothesis,
    joined,
    trial_of,
    trials_of,
    with_camera,
    without,
)

pytestmark = pytest.mark.slow

RIVAL = "colmap-defaults"
GUESS = {"method": "guess", "identifiable": False}
MIDDLE = np.array([512.0, 384.0])


# The loop.


def test_trials_tell_what_was_tried_and_what_it_gained(synthetic, run, cameras, mapped):
    mapped(without(with_camera(synthetic.copy(), TRUE), [6]), with_camera(synthetic.copy(), TRUE))

    found = mapped.outcome(cameras(**GUESS), run())

    first, learned = found.trials
    assert (first.name, first.accepted, first.photos, first.notes) == ("first-pass", True, (0, 5), ("5 photos",))
    assert (learned.name, learned.accepted, learned.photos) == ("learned-cameras", True, (5, 6))
    assert learned.reason == "mapping has changed a focal length"
    assert first.support[0] == 0.0 < first.support[1] == learned.support[0] < learned.support[1] == found.support
    assert all(trial.failure == "" and 0.0 <= trial.seconds < 600.0 for trial in found.trials)


def test_the_display_says_why_and_what_is_tried(synthetic, run, cameras, mapped):
    mapped(without(with_camera(synthetic.copy(), TRUE), [6]), None)
    lines, context = [], run()
    context.progress = SimpleNamespace(say=lines.append)
    mapped.outcome(cameras(), context)
    assert lines[0] == "unregistered photos with matches: 1; trying mapping again with the cameras of the model"


def test_a_hypothesis_that_is_switched_off_is_not_tried(synthetic, run, cameras, mapped):
    few = without(synthetic.copy(), [4, 5, 6])
    seen = mapped(few)
    asked = mapped.rival(with_camera(synthetic.copy(), TRUE))
    off = ["colmap-defaults", "other-focals", "other-cameras", "learned-cameras"]
    found = mapped.outcome(cameras(**GUESS), run(without=off))
    assert len(seen) == 1 and asked == [] and found.main.model is few
    assert trials_of(found) == [("first-pass", True, "3 photos")]


def test_what_no_time_is_left_for_is_named(synthetic, run, cameras, mapped):
    few = without(with_camera(synthetic.copy(), TRUE), [6])
    seen = mapped(few)
    found = mapped.outcome(cameras(), run(hypotheses_s=0))
    assert len(seen) == 1 and found.main.model is few
    assert [(trial.name, trial.failure) for trial in found.trials[1:3]] == [
        ("learned-cameras", "no time was left, of 0 s"),
        ("colmap-defaults", "no time was left, of 0 s"),
    ]
    assert not any(trial.accepted for trial in found.trials[1:])


@pytest.fixture
def fails():
    """Makes a hypothesis that maps nothing, and raises."""

    def make(error):
        def raise_error(*_):
            raise error
            yield

        return replace(hypothesis("other-focals"), reason=lambda *_: "a doubt", outcomes=raise_error)

    return make


def test_a_hypothesis_that_fails_costs_nothing_and_is_named(synthetic, run, cameras, mapped, fails):
    model = with_camera(synthetic.copy(), TRUE)
    mapped(model)
    found = mapped.outcome(cameras(), run(), hypotheses=[fails(BackendError("the disk is full"))])
    assert found.main.model is model
    trial = found.trials[-1]
    assert (trial.name, trial.accepted, trial.photos, trial.notes) == ("other-focals", False, (6, 6), ())
    assert trial.failure == trial.to_dict()["failure"] == "the disk is full"


@pytest.mark.parametrize("error", [ClusterError("the scheduler is gone"), NumericalError("a bug")])
def test_a_lost_cluster_and_a_bug_of_ours_are_not_hidden(synthetic, run, cameras, mapped, fails, error):
    mapped(with_camera(synthetic.copy(), TRUE))
    with pytest.raises(type(error), match=str(error)):
        mapped.outcome(cameras(), run(), hypotheses=[fails(error)])


def test_every_hypothesis_can_be_switched_off():
    assert {one.name for one in ALL} < set(get_args(HypothesisName)) == HYPOTHESES.keys()
    for names in ("false-joins", "false-joins, finer-features", ["false-joins"]):
        assert Settings.from_mapping({"scene": {"without": names}}).scene.without[0] == "false-joins"
    with pytest.raises(ConfigError, match="finer-features"):
        Settings.from_mapping({"scene": {"without": "nonsense"}})


# False joins.


def test_photos_are_mapped_again_without_a_false_join(synthetic, run, cameras, mapped):
    true = with_camera(synthetic.copy(), TRUE)
    seen = mapped(with_camera(synthetic.copy(), TRUE), true)
    join = LookAlikes(((1, 4), (2, 4)), 0.9)
    left = mapped.judge(([join], 20), ([], 0))

    found = mapped.outcome(cameras(), run())

    assert len(seen) == 2 and left == []
    assert found.main.model is true
    assert found.graph.look_alikes == (join,) and not found.graph.poses.keys() & set(join.pairs)
    assert {found.graph.dropped[pair] for pair in join.pairs} == {LOOKS_ALIKE}
    assert len(geometries_in(run().workspace.database)) == 13
    assert found.evidence.matches.matches.keys() == synthetic.matches.matches.keys()
    assert found.graph.doubtful == () and trials_of(found)[1:] == [("false-joins", True, "6 photos")]


@pytest.mark.parametrize(("lost", "non_overlapping"), [([], 15), ([6], 0)])
def test_a_false_join_without_a_better_rival_is_only_named(synthetic, run, cameras, mapped, lost, non_overlapping):
    first = with_camera(synthetic.copy(), TRUE)
    mapped(first, without(with_camera(synthetic.copy(), TRUE), lost))
    join = LookAlikes(((1, 4), (2, 4)), 0.9)
    mapped.judge(([join], 20), ([join], non_overlapping))
    found = mapped.outcome(cameras(), run())
    assert found.main.model is first
    assert found.graph.look_alikes == () and found.graph.doubtful == (join,)
    assert trials_of(found) == [("first-pass", True, "6 photos"), ("false-joins", False, f"{6 - len(lost)} photos")]
    assert len(geometries_in(run().workspace.database)) == 15


def test_false_joins_are_looked_for_a_few_times_only(synthetic, run, cameras, mapped):
    models = [with_camera(synthetic.copy(), TRUE) for _ in range(4)]
    mapped(*models)
    joins = [LookAlikes((pair,), 0.9) for pair in ((1, 4), (2, 5), (3, 6), (1, 5))]
    mapped.judge(*(([join], count) for join, count in zip(joins, (80, 40, 20, 10), strict=True)))
    found = mapped.outcome(cameras(), run())
    assert found.main.model is models[3]
    assert set(found.graph.look_alikes) == set(joins[:3])
    assert found.graph.doubtful == (joins[3],)


def test_a_later_hypothesis_leaves_out_the_look_alikes_of_earlier_ones(synthetic, run, cameras, mapped):
    last = with_camera(synthetic.copy(), TRUE)
    mapped(*(without(with_camera(synthetic.copy(), TRUE), [6]) for _ in range(2)), last)
    join, other = LookAlikes(((1, 4), (2, 4)), 0.9), LookAlikes(((3, 5),), 0.8)
    mapped.judge(([join], 20), ([], 0), ([other], 12))

    found = mapped.outcome(cameras(), run())

    assert found.main.model is last and found.trials[-1].name == "learned-cameras"
    assert found.graph.look_alikes == (join,) and not found.graph.poses.keys() & set(join.pairs)
    assert len(geometries_in(run().workspace.database)) == 13
    assert found.graph.doubtful == (other,)  # the last model is judged, too


# A rival.


def test_a_rival_that_explains_more_goes_on(synthetic, run, cameras, mapped):
    mapped(without(with_camera(synthetic.copy(), TRUE), [6]), None)
    asked = mapped.rival(with_camera(synthetic.copy(), TRUE))
    found = mapped.outcome(cameras(), run())
    assert len(asked) == 1 and trial_of(found, RIVAL).reason == "unregistered photos with matches: 1"
    assert (found.main.mapper, found.photos) == ("colmap", 6)
    assert trial_of(found, RIVAL).accepted and trial_of(found, RIVAL).notes == ("the rival",)
    assert "with 6 photos, the second best" in found.reason


def test_later_steps_know_the_pairs_of_a_rival_that_goes_on(synthetic, run, cameras, mapped):
    """Its photos need not be in our pose graph: tracks could not be completed, and COLMAP raised."""
    views = replace(synthetic.views, fits={pair: fit for pair, fit in synthetic.views.fits.items() if 6 not in pair})
    mapped(without(with_camera(synthetic.copy(), TRUE), [5, 6]), None)
    mapped.rival(with_camera(synthetic.copy(), TRUE))
    made = run()
    found = mapped.outcome(cameras(), made, views=views)
    assert found.photos == 6 and {(k, 6) for k in range(1, 6)} <= found.graph.poses.keys()
    assert len(geometries_in(made.workspace.database)) == 15
    assert posed_photo_ids(adjust(found.main.model, made.workspace.database).model) == [1, 2, 3, 4, 5, 6]


def test_a_rival_that_explains_less_is_named_and_left(synthetic, run, cameras, mapped):
    mapped(without(with_camera(synthetic.copy(), TRUE), [6]), None)
    asked = mapped.rival(without(with_camera(synthetic.copy(), TRUE), [5, 6]))
    found = mapped.outcome(cameras(**GUESS), run())
    assert len(asked) == 1 and (found.main.mapper, found.photos) == ("incremental", 5)
    assert not trial_of(found, RIVAL).accepted and trial_of(found, RIVAL).photos == (5, 4)


def test_a_rival_of_other_photos_does_not_win_by_our_own_model(synthetic, run, cameras, mapped):
    first = without(with_camera(synthetic.copy(), TRUE), [5, 6])
    mapped(first, None)
    mapped.rival(without(with_camera(synthetic.copy(), TRUE), [1, 2, 3, 4]))
    found = mapped.outcome(cameras(), run())
    assert found.models[0].model is first and len(found.models) == 1
    assert not trial_of(found, RIVAL).accepted


def test_a_rival_is_cut_and_its_largest_part_compared(synthetic, run, cameras, mapped):
    rival = Attempt("colmap", synthetic.copy(), joined(GOOD, AGAINST), "the rival")
    mapped.mappers = replace(mapped.mappers, map_rival=lambda *_: rival)
    more, less = ({(1, 2): GOOD, (2, 3): GOOD, (3, 4): GOOD}, {(1, 2): GOOD, (2, 3): GOOD})
    for explained, cut in ((more, False), (less, True)):
        ours = Attempt("incremental", without(synthetic.copy(), [5, 6]), explained, "")
        found = mapped.improve(mapped.best(cameras(**GUESS), run(), ours), hypothesis("colmap-defaults"))
        assert trials_of(found) == [("colmap-defaults", cut, "the rival")]
        parts = [posed_photo_ids(model.model) for model in found.models]
        assert parts == ([[1, 2, 3], [4, 5, 6]] if cut else [[1, 2, 3, 4]])


def test_good_evidence_needs_no_rival(synthetic, run, cameras, mapped):
    mapped(with_camera(synthetic.copy(), TRUE))
    asked = mapped.rival(synthetic.copy())
    found = mapped.outcome(cameras(), run())
    assert asked == [] and trials_of(found) == [("first-pass", True, "6 photos")] and found.photos == 6


def test_known_cameras_need_no_rival_where_matches_contradict_the_model(synthetic, run, cameras, mapped):
    """What moves contradicts a model, and a rival with guessed cameras follows it."""
    ours = Attempt("incremental", synthetic.copy(), joined(AGAINST, AGAINST), "")
    reasons = [hypothesis(RIVAL).reason(mapped.best(one, run(), ours), None) for one in (cameras(), cameras(**GUESS))]
    assert reasons[0] == "" and "contradict the model" in reasons[1]


def test_a_rival_that_fails_costs_nothing(synthetic, run, cameras, mapped):
    mapped(without(with_camera(synthetic.copy(), TRUE), [6]), None)
    mapped.mappers = replace(mapped.mappers, map_rival=Mappers().map_rival)

    found = mapped.outcome(cameras(**GUESS), run())  # COLMAP finds no folder of photos

    assert found.photos == 5 and not trial_of(found, RIVAL).accepted
    assert trial_of(found, RIVAL).notes[0].startswith("COLMAP's default pipeline: failed")


# Other focals.


def test_where_a_guess_leaves_many_photos_out_other_focals_are_tried(synthetic, run, cameras, mapped):
    few = without(synthetic.copy(), [4, 5, 6])
    seen = mapped(few, few, with_camera(synthetic.copy(), TRUE), None, None)
    found = mapped.outcome(cameras(**GUESS), run())
    focals = [intrinsics.main.focal_px / 1024 for _, intrinsics in seen]
    assert focals[1:4] == pytest.approx([0.6, 2.4, 4.8])
    assert focals[4:] == pytest.approx([FOCAL / 1024])  # what the best of them has found is gone on with
    assert found.photos == 6
    assert trials_of(found)[1:4] == [
        ("other-focals", False, "3 photos"), ("other-focals", True, "6 photos"), ("other-focals", False, "nothing"),
    ]  # fmt: skip


def test_no_other_focals_are_tried_where_one_is_known(synthetic, run, cameras, mapped):
    seen = mapped(without(synthetic.copy(), [4, 5, 6]), None)
    mapped.outcome(cameras(), run())
    assert all(intrinsics.main.focal_px == pytest.approx(FOCAL, rel=0.01) for _, intrinsics in seen)


def test_without_a_model_there_is_nothing_to_learn(synthetic, run, cameras, mapped):
    seen = mapped(None, None, None, None)
    found = mapped.outcome(cameras(**GUESS), run())
    assert found.models == () and found.support == 0.0
    assert trials_of(found)[0] == ("first-pass", True, "nothing") and not trial_of(found, RIVAL).accepted
    assert len(seen) == 4 and len(found.trials) == 5  # the usual guess, and three others


# A camera per photo.


def attempt(model, contradicted, matches=100, inliers=100):
    return Attempt("incremental", model, {(1, 2): PairSupport(matches, inliers, contradicted)}, "")


class FakeModel:
    """A model of photos 1, 2, ... with these focals."""

    def __init__(self, *focals):
        self.cameras = {
            k: pycolmap.Camera(model="SIMPLE_RADIAL", width=1024, height=768, params=[focal, 512.0, 384.0, 0.0])
            for k, focal in enumerate(focals, start=1)
        }
        self.images = {k: SimpleNamespace(image_id=k, camera_id=k, has_pose=True) for k in self.cameras}

    def num_reg_images(self):
        return len(self.images)


def photos(number):
    return FakeModel(*[FOCAL] * number)


def best_of(*attempts, number=0, views=None, intrinsics=None):
    images = {k: MatchedImage(k, f"{k}.jpg", "one", 1024, 768) for k in range(1, number + 1)}
    evidence = Evidence(MatchGraph(images, {}, {}), views or ViewGraph({}, {}), intrinsics)
    return Outcome(attempts, EMPTY, evidence, intrinsics, None)


def chain(number):
    fit = SimpleNamespace(degeneracy="")
    return ViewGraph({(k, k + 1): fit for k in range(1, number)}, {})


OTHER_CAMERAS = hypothesis("other-cameras")
DOUBTED = replace(OTHER_CAMERAS, reason=lambda *_: "a doubt")


APART = {1: 0, 6: 1}
"""Photos with the numbers of their cameras."""


def is_asked(best, apart=(), **settings):
    mappers = Mappers(find_cameras=lambda _: dict(apart))
    return bool(OTHER_CAMERAS.reason(best, Mapper(SimpleNamespace(settings=Settings.from_mapping(settings)), mappers)))


@pytest.mark.parametrize(
    ("placed", "number", "asked"),
    [(4, 6, True), (5, 6, False), (2, OPTIONS.min_photos - 1, False), (4, OPTIONS.max_photos_for_focals + 1, False)],
)
def test_it_is_asked_where_one_guess_places_few_photos_that_nobody_grouped(cameras, placed, number, asked):
    best = best_of(attempt(photos(placed), 0), number=number, views=chain(number), intrinsics=cameras(**GUESS))
    assert is_asked(best) is asked
    assert not is_asked(best, photos={"cameras": "single"})
    (guess,) = best.evidence.intrinsics.cameras.values()
    each = {f"{k}.jpg": f"one #{k}" for k in range(1, number + 1)}
    alone = Intrinsics(dict.fromkeys(each.values(), guess), each)
    assert not is_asked(replace(best, evidence=replace(best.evidence, intrinsics=alone)))


@pytest.mark.parametrize(("number", "asked"), [(OPTIONS.min_photos - 1, False), (6, True), (101, False)])
def test_it_is_asked_where_focals_differ(cameras, number, asked):
    best = best_of(attempt(photos(number), 0), number=number, intrinsics=cameras(**GUESS))
    assert is_asked(best, APART) is asked and not is_asked(best)
    assert not is_asked(best, APART, photos={"cameras": "single"})


def test_without_a_model_it_is_not_asked(cameras):
    assert not is_asked(best_of(number=6, views=chain(6), intrinsics=cameras(**GUESS)))


def test_a_camera_that_pairs_determine_is_not_divided(cameras):
    known = best_of(attempt(photos(4), 2), number=6, views=chain(6), intrinsics=cameras())
    assert not is_asked(known)
    known = best_of(attempt(photos(6), 2), number=6, views=chain(6), intrinsics=cameras())
    assert is_asked(known, APART)  # unless it does not fit


@pytest.mark.parametrize("method", ["given", "kept", "claim"])
def test_a_camera_that_somebody_stated_is_not_divided_by_focals(cameras, method):
    stated = best_of(attempt(photos(6), 0), number=6, views=chain(6), intrinsics=cameras(method=method))
    assert not is_asked(stated, APART)


def test_every_photo_gets_a_guess_of_its_own_that_begins_where_mapping_ended(synthetic, run, cameras, mapped):
    model = with_camera(synthetic.copy(), [1111.0, 512.0, 384.0, 0.01])
    seen = mapped(None)

    mapped.improve(mapped.best(cameras(700.0, **GUESS), run(), attempt(model, 2)), DOUBTED)

    ((_, found),) = seen
    images = sorted(synthetic.matches.images.values(), key=lambda image: image.name)
    assert [found.camera_name(image) for image in images] == ["one", *(f"one #{k}" for k in range(2, 7))]
    assert sorted(found.cameras) == sorted(found.camera_of.values())
    assert all(
        camera.focal_px == pytest.approx(1111.0) and not camera.is_estimated for camera in found.cameras.values()
    )


@pytest.fixture
def judged(cameras):
    """Whether the judge prefers a model to one of 6 photos; `places` are the judgments of the places of both."""

    def make(other, best=None, places=(), apart=(), **intrinsics):
        judgments = dict(zip(("other", "best"), places, strict=False))
        outcomes = [
            best_of(*models, number=9, intrinsics=cameras(**GUESS))
            for models in (other, [attempt(photos(6), 0, 1000, 1000)] if best is None else best)
        ]
        outcomes[0] = replace(outcomes[0], evidence=replace(outcomes[1].evidence, **intrinsics))
        names = dict(zip((one.models for one in outcomes), ("other", "best"), strict=True))
        divided = {one.models[0].model: dict(apart) for one in outcomes[1:] if one.models}
        mapper = SimpleNamespace(
            judge_places=lambda models: judgments.get(names[models], ([], 0)),
            find_cameras=lambda model: divided.get(model, {}),
        )
        return is_better(*outcomes, mapper)

    return make


def test_the_judge_prefers_what_explains_more(judged):
    assert judged([attempt(photos(5), 0, 2000)]) and not judged([attempt(photos(7), 0, 500)])
    assert not judged([attempt(photos(6), 50, 1030)])  # contradictions count against it
    assert judged([attempt(photos(2), 0, 1)], best=[])
    assert not judged([]) and not judged([], best=[])


def test_of_models_that_explain_equally_much_the_judge_prefers_more_photos_then_fewer_cameras(judged, cameras):
    equal = [attempt(photos(6), 0, 1001)]
    each = SimpleNamespace(camera_name=lambda image: image.name)
    assert judged([attempt(photos(7), 0, 999)]) and not judged([attempt(photos(5), 0, 1001)])
    assert judged(equal) and not judged([attempt(photos(6), 0, 999)]) and not judged(equal, intrinsics=each)
    assert judged([attempt(photos(6), 0, 5000)], intrinsics=each)
    contradicted = [attempt(photos(6), 10)]
    for remaining, better in ((5, True), (6, False)):  # more cameras must remove contradictions, or place more
        assert judged([attempt(photos(6), remaining, 500)], contradicted, intrinsics=each) is better
        assert judged([attempt(photos(7), remaining, 500)], contradicted, intrinsics=each)


def test_the_judge_prefers_more_cameras_where_one_clearly_does_not_fit(judged):
    each = SimpleNamespace(camera_name=lambda image: image.name)
    assert judged([attempt(photos(6), 0, 999)], apart=APART, intrinsics=each)
    assert not judged([attempt(photos(6), 0, 999)], intrinsics=each)
    assert not judged([attempt(photos(5), 0, 999)], apart=APART, intrinsics=each)  # but no photo may go


def test_the_judge_prefers_places_apart(judged):
    join = LookAlikes(((1, 4),), 0.9)
    folded, fewer = [attempt(photos(6), 0, 5000)], [attempt(photos(6), 0, 500)]
    assert judged(fewer, places=(([], 10), ([join], 20))) and not judged(folded, places=(([join], 20), ([], 10)))
    assert not judged(fewer, places=(([join], 11), ([join], 20)))  # too few of the missing overlaps go
    assert not judged([attempt(photos(5), 0, 500)], places=(([], 0), ([join], 20)))  # too many photos go


@pytest.fixture
def two_zooms(synthetic):
    """The synthetic photos, of which 4 to 6 show everything larger, and the best model with one focal."""

    def make(factor):
        def enlarge(x):
            return MIDDLE + factor * (x - MIDDLE)

        matches, model = synthetic.matches, synthetic.copy()
        keypoints = {photo: enlarge(x) if photo > 3 else x for photo, x in matches.keypoints.items()}
        for photo in (4, 5, 6):
            for keypoint in model.images[photo].points2D:
                keypoint.xy = enlarge(keypoint.xy)
        solve(model, [1])
        return replace(synthetic, model=model, matches=replace(matches, keypoints=keypoints))

    return make


@pytest.mark.parametrize("factor", [1.1, 0.8])
def test_photos_with_two_focals_get_theirs_whatever_pairs_say(two_zooms, run, cameras, factor):
    zoomed = two_zooms(factor)
    fakes, bent = Fakes(zoomed), (0.001, 0.0, 0.0, 0.0)

    found = fakes.improve(fakes.best(cameras(distortion=bent), run(), fakes.attempt(zoomed.model)), OTHER_CAMERAS)

    assert trials_of(found) == [("other-cameras", True, "with 2 instead of 1 camera: 6 photos")]
    focals = [found.main.model.cameras[image.camera_id].params[0] for image in posed_images(found.main.model)]
    assert np.allclose(focals, FOCAL * np.repeat([1, factor], 3), rtol=0.02)
    assert cameras_in(run().workspace.database) == found.cameras == 2
    assert [found.evidence.camera_name(photo) for photo in (1, 4)] == ["one", "one #2"]
    assert [one.distortion for one in found.evidence.intrinsics.cameras.values()] == [bent, bent]


def test_photos_whose_focals_differ_as_by_focusing_keep_their_camera(two_zooms, run, cameras):
    fakes = Fakes(two_zooms(1.01))
    best = fakes.best(cameras(), run(), fakes.attempt(fakes.synthetic.model))
    assert fakes.improve(best, OTHER_CAMERAS) is best


@pytest.fixture
def zoom(synthetic, mapped):
    """Mapping, where one camera for all photos leaves matches that a camera for each explains, or does not."""

    def make(*, right):
        asked = []

        def attempts(group, run):
            names = {group.evidence.camera_name(photo) for photo in group.evidence.matches.images}
            asked.append(len(names))
            found = mapped.attempt(synthetic.copy())
            if (len(names) > 1) is not right:
                found = replace(
                    found,
                    explained={
                        pair: replace(one, matches=one.matches - 10, contradicted=10)
                        for pair, one in found.explained.items()
                    },
                )
            return [replace(found, note=f"{len(names)} cameras")]

        mapped.mappers = replace(mapped.mappers, map_group=attempts)
        return asked

    return make


def cameras_in(path):
    with open_database(path) as database:
        return len(database.read_all_cameras())


def test_photos_of_a_zoom_are_mapped_with_a_camera_each(run, cameras, mapped, zoom):
    asked = zoom(right=True)
    found = mapped.outcome(cameras(**GUESS), run(), hypotheses=[replace(DOUBTED, repeats=1)])
    assert asked == [1, 6]
    assert len(found.evidence.intrinsics.cameras) == 6 and cameras_in(run().workspace.database) == 6
    assert trials_of(found)[1:] == [("other-cameras", True, "6 cameras")]


def test_photos_of_one_camera_keep_it_and_so_does_the_database(run, cameras, mapped, zoom):
    asked, guess = zoom(right=False), cameras(**GUESS)
    found = mapped.outcome(guess, run(), hypotheses=[DOUBTED])
    assert asked == [1, 6] and trials_of(found)[-1][:2] == ("other-cameras", False)
    assert found.evidence.intrinsics is guess and cameras_in(run().workspace.database) == 1


# The cameras of the model.


def test_a_camera_that_was_known_and_stayed_is_not_looked_at_twice(synthetic, run, cameras, mapped):
    seen = mapped(with_camera(synthetic.copy(), [FOCAL * 1.009, 512.0, 384.0, 0.01]))
    found = mapped.outcome(cameras(), run())
    assert len(seen) == 1 and trials_of(found) == [("first-pass", True, "6 photos")]


@pytest.mark.parametrize("camera", [GUESS, {"focal": FOCAL * 1.011}, {"focal": FOCAL / 1.011}])
def test_a_camera_that_was_a_guess_or_moved_is_mapped_with_again(synthetic, run, cameras, mapped, camera):
    seen = mapped(without(with_camera(synthetic.copy(), TRUE), [6]), with_camera(synthetic.copy(), TRUE))
    known = cameras(**camera)
    found = mapped.outcome(known, run())
    assert trials_of(found)[-1] == ("learned-cameras", True, "6 photos") and found.photos == 6
    assert len(seen) == 2
    learned = seen[1][1].main
    assert (learned.focal_px, learned.identifiable, learned.method) == (FOCAL, True, "mapping")
    assert found.evidence.intrinsics is seen[1][1] and found.calibrated is known
    assert focals_in(run().workspace.database) == [FOCAL]
    assert {pose.kind for pose in found.graph.poses.values()} == {"calibrated"}


def test_a_second_pass_that_explains_less_is_thrown_away_with_all_that_it_wrote(synthetic, run, cameras, mapped):
    guess = cameras(FOCAL * 1.1, **GUESS)
    place = run().workspace
    mapped(without(synthetic.copy(), [4, 5, 6]))
    Mapper(run(), mapped.mappers).map(mapped.evidence(guess))
    first = geometries_in(place.database)

    seen = mapped(with_camera(synthetic.copy(), TRUE), without(with_camera(synthetic.copy(), TRUE), [5, 6]))
    found = mapped.outcome(guess, run())

    assert len(seen) == 2
    assert trials_of(found)[-1] == ("learned-cameras", False, "4 photos")
    assert found.photos == 6 and found.evidence.intrinsics is guess
    assert focals_in(place.database) == [pytest.approx(FOCAL * 1.1)]
    assert geometries_in(place.database) == first
    assert {pose.kind for pose in found.graph.poses.values()} == {"uncalibrated"}


def test_a_second_pass_that_finds_nothing_leaves_the_first(synthetic, run, cameras, mapped):
    mapped(with_camera(synthetic.copy(), TRUE), None)
    found = mapped.outcome(cameras(**GUESS), run())
    assert found.photos == 6 and trials_of(found)[-1] == ("learned-cameras", False, "nothing")


@pytest.fixture
def mapped_as(synthetic):
    """Makes the outcome of a pass with these cameras that found a model."""

    def make(model, intrinsics, photos=6):
        graph = PoseGraph({}, {}, (tuple(range(1, photos + 1)),))
        models = (Attempt("global", model, {}, ""),)
        return Outcome(models, graph, synthetic.evidence(intrinsics), intrinsics, None)

    return make


def worth(outcome):
    return bool(hypothesis("learned-cameras").reason(outcome, None))


def test_two_photos_teach_no_camera(synthetic, cameras, mapped_as):
    guess = cameras(**GUESS)
    assert not worth(mapped_as(without(synthetic.copy(), [3, 4, 5, 6]), guess))
    assert worth(mapped_as(without(synthetic.copy(), [4, 5, 6]), guess))


def test_photos_of_the_main_group_that_stayed_out_are_worth_another_pass(synthetic, cameras, mapped_as):
    known = cameras(FOCAL)
    assert not worth(mapped_as(with_camera(synthetic.copy(), TRUE), known))
    assert worth(mapped_as(without(with_camera(synthetic.copy(), TRUE), [6]), known))
    assert not worth(mapped_as(without(with_camera(synthetic.copy(), TRUE), [6]), known, photos=5))


def test_what_is_learned_is_focal_center_and_lens(synthetic, cameras, mapped_as):
    guess = cameras(FOCAL * 1.2, reason="an orbit", held=("center",), **GUESS)
    model = with_camera(synthetic.copy(), [1300.0, 500.0, 390.0, -0.07])
    found = learned_intrinsics(mapped_as(model, guess)).main
    assert found.K.tolist() == [[1300.0, 0, 500.0], [0, 1300.0, 390.0], [0, 0, 1]]
    assert (found.radial, found.reason, found.held) == (-0.07, "", ("center",))


def test_of_given_cameras_nothing_is_learned_where_they_are_kept_and_all_terms_stay(synthetic, cameras, mapped_as):
    terms = (-0.07, 0.02, 0.001, -0.002, 0.0, 0.0, 0.0, 0.0)
    kept = cameras(FOCAL * 1.1, method="kept")
    given = cameras(FOCAL * 1.1, method="given", distortion=terms)
    model = with_camera(synthetic.copy(), [1300.0, 500.0, 390.0, -0.01])
    assert learned_intrinsics(mapped_as(model, kept)).main is kept.main
    found = learned_intrinsics(mapped_as(model, given)).main
    assert (found.K[0, 0], found.distortion, found.radial) == (1300.0, terms, -0.07)


def test_a_camera_of_no_photo_in_the_model_stays_what_it_was(synthetic, cameras, mapped_as):
    two = cameras(900.0, **GUESS).main
    intrinsics = replace(
        cameras(FOCAL * 1.1), cameras={**cameras(FOCAL * 1.1).cameras, "two": two},
        camera_of={synthetic.matches.images[6].name: "two"},
    )  # fmt: skip
    found = learned_intrinsics(mapped_as(without(with_camera(synthetic.copy(), TRUE), [6]), intrinsics))
    assert found.cameras["two"] is two
    assert found.cameras["one"].focal_px == FOCAL
