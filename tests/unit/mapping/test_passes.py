"""Passes, with mappers that find what the test says; pose graph, models and database are real."""

import contextlib
import sqlite3
from dataclasses import replace

import pytest

from sfm_app.colmap.bundle import adjust
from sfm_app.colmap.database import open_database
from sfm_app.colmap.model import posed_photo_ids
from sfm_app.errors import BackendError
from sfm_app.mapping import passes
from sfm_app.mapping import passes as module
from sfm_app.mapping.attempt import Attempt, NoModel, PairSupport, explained_pairs
from sfm_app.mapping.passes import Mappers, Passes, guessed_intrinsics, learned_intrinsics, reconstruct
from sfm_app.mapping.split_and_merge import split_attempt
from sfm_app.posegraph.graph import LOOKS_ALIKE
from sfm_app.types import LookAlikes, PoseGraph

pytestmark = pytest.mark.slow

FOCAL = 1280.0
TRUE = [FOCAL, 512.0, 384.0, 0.0]


def with_camera(model, params):
    for camera in model.cameras.values():
        camera.params = params
    return model


def without(model, photos):
    for photo in photos:
        model.deregister_frame(model.images[photo].frame_id)
    return model


class Fakes:
    """Mappers with models, rivals and judgments of a test; `seen` has the photos and cameras of each group."""

    def __init__(self, synthetic):
        self.synthetic, self.seen = synthetic, []
        self.mappers = Mappers(map_baseline=lambda *_: NoModel("colmap", "no rival"))

    def explained(self, model):
        return explained_pairs(model, self.synthetic.matches, self.synthetic.views, 1.5)

    def __call__(self, *models):
        """Give these models one after the other."""
        left, self.seen = list(models), []

        def attempts(group, run):
            self.seen.append((group.photos, group.intrinsics))
            model = left.pop(0)
            if model is None:
                return [NoModel("incremental", "nothing")]
            return [Attempt("incremental", model, self.explained(model), f"{model.num_reg_images()} photos")]

        self.mappers = replace(self.mappers, map_group=attempts)
        return self.seen

    def judge(self, *judgments):
        """Judge the places of models so, one after the other."""
        left = list(judgments)
        self.mappers = replace(self.mappers, judge_places=lambda _: left.pop(0))
        return left

    def rival(self, model):
        """Let COLMAP's default pipeline give this model, and count its calls."""
        calls = []

        def map_baseline(matches, views, intrinsics, run):
            calls.append(intrinsics)
            return Attempt("colmap", model, explained_pairs(model, matches, views, 1.5), "the rival")

        self.mappers = replace(self.mappers, map_baseline=map_baseline)
        return calls

    def parts(self, joins, *models):
        """Map in parts: these false joins, pass by pass, stop the mapping, then the models follow."""
        seen, left, ready = [], list(joins), list(models)

        def attempts(group, followed, run, *, stop_at_false_joins):
            seen.append((set(group.graph.poses), set(followed.poses), stop_at_false_joins))
            if stop_at_false_joins and left:
                return [], left.pop(0)
            model = ready.pop(0)
            return [Attempt("parts", model, self.explained(model), f"{model.num_reg_images()} photos")], ()

        self.mappers = replace(
            self.mappers,
            part_size=lambda *_: 3,
            map_in_parts=attempts,
            map_group=lambda *_: [NoModel("incremental", "nothing")],
            judge_places=lambda _: ([], 0),
        )
        return seen

    def outcome(self, intrinsics, run, matches=None, views=None):
        matches, views = matches or self.synthetic.matches, views or self.synthetic.views
        return reconstruct(matches, views, intrinsics, run, self.mappers)


@pytest.fixture
def mapped(synthetic):
    return Fakes(synthetic)


def focals_in(path):
    with open_database(path) as database:
        return [camera.params[0] for camera in database.read_all_cameras()]


def geometries_in(path):
    with contextlib.closing(sqlite3.connect(path)) as database:
        return database.execute("SELECT * FROM two_view_geometries ORDER BY pair_id").fetchall()


def test_photos_are_mapped_again_without_a_false_join(synthetic, run, cameras, mapped):
    true = with_camera(synthetic.copy(), TRUE)
    seen = mapped(with_camera(synthetic.copy(), TRUE), true)
    join = LookAlikes(((1, 4), (2, 4)), 0.9)
    left = mapped.judge(([join], 20), ([], 0))

    found = mapped.outcome(cameras(), run())

    assert len(seen) == 2 and left == []
    assert found.models[0].model is true and found.passes == 1
    assert found.graph.look_alikes == (join,) and not found.graph.poses.keys() & set(join.pairs)
    assert {found.graph.dropped[pair] for pair in join.pairs} == {LOOKS_ALIKE}
    assert len(geometries_in(run().workspace.database)) == 13


@pytest.mark.parametrize(("lost", "non_overlapping"), [([], 15), ([6], 0)])
def test_a_false_join_without_a_better_rival_is_only_named(synthetic, run, cameras, mapped, lost, non_overlapping):
    first = with_camera(synthetic.copy(), TRUE)
    mapped(first, without(with_camera(synthetic.copy(), TRUE), lost))
    join = LookAlikes(((1, 4), (2, 4)), 0.9)
    mapped.judge(([join], 20), ([join], non_overlapping))
    found = mapped.outcome(cameras(), run())
    assert found.models[0].model is first
    assert found.graph.look_alikes == () and found.graph.doubtful == (join,)
    assert found.tried == ("6 photos", f"{6 - len(lost)} photos")
    assert len(geometries_in(run().workspace.database)) == 15


def test_false_joins_are_looked_for_a_few_times_only(synthetic, run, cameras, mapped):
    models = [with_camera(synthetic.copy(), TRUE) for _ in range(4)]
    mapped(*models)
    joins = [LookAlikes((pair,), 0.9) for pair in ((1, 4), (2, 5), (3, 6), (1, 5))]
    mapped.judge(*(([join], count) for join, count in zip(joins, (80, 40, 20, 10), strict=True)))
    found = mapped.outcome(cameras(), run())
    assert found.models[0].model is models[3]
    assert set(found.graph.look_alikes) == set(joins[:3])
    assert found.graph.doubtful == (joins[3],)


def test_parts_with_two_places_in_one_are_mapped_again_before_any_is_joined(synthetic, run, cameras, mapped):
    joins = [(LookAlikes(((1, 4), (2, 4)), 0.9),), (LookAlikes(((3, 6),), 0.8),)]
    model = with_camera(synthetic.copy(), TRUE)
    seen = mapped.parts(joins, model)

    found = mapped.outcome(cameras(), run())

    gone = [set(), {(1, 4), (2, 4)}, {(1, 4), (2, 4), (3, 6)}]
    assert [len(poses) for poses, *_ in seen] == [15, 13, 12]
    assert all(not poses & dropped for (poses, *_), dropped in zip(seen, gone, strict=True))
    assert found.models[0].model is model and len(found.tried) == 1
    assert {pair for join in found.graph.look_alikes for pair in join.pairs} == gone[-1]
    assert len(geometries_in(run().workspace.database)) == 12


def test_false_joins_of_parts_stay_where_nothing_else_holds_the_photos_together(synthetic, run, cameras, mapped):
    join = LookAlikes(((1, 4), (2, 4)), 0.9)
    first = with_camera(synthetic.copy(), TRUE)
    seen = mapped.parts([(join,)], without(with_camera(synthetic.copy(), TRUE), [6]), first)
    found = mapped.outcome(cameras(), run())
    assert [(len(poses), asked) for poses, _, asked in seen] == [(15, True), (13, True), (15, False)]
    assert found.models[0].model is first
    assert found.graph.look_alikes == () and found.graph.doubtful == (join,)
    assert len(geometries_in(run().workspace.database)) == 15


def test_parts_are_asked_a_few_times_only(synthetic, run, cameras, mapped):
    joins = [(LookAlikes((pair,), 0.9),) for pair in ((1, 4), (2, 5), (3, 6), (1, 5))]
    seen = mapped.parts(joins, with_camera(synthetic.copy(), TRUE))
    found = mapped.outcome(cameras(), run())
    assert [asked for *_, asked in seen] == [True, True, True, False]
    assert found.graph.look_alikes == tuple(join for (join,) in joins[:3])


def test_a_camera_that_was_known_and_stayed_is_not_looked_at_twice(synthetic, run, cameras, mapped):
    seen = mapped(with_camera(synthetic.copy(), [FOCAL * 1.009, 512.0, 384.0, 0.01]))
    found = mapped.outcome(cameras(), run())
    assert len(seen) == 1 and found.passes == 1
    assert found.tried == ("6 photos",) and found.cuts == ()
    assert found.graph.groups == ((1, 2, 3, 4, 5, 6),) and seen[0][0] == (1, 2, 3, 4, 5, 6)
    assert focals_in(run().workspace.database) == [FOCAL]


@pytest.mark.parametrize(
    "camera", [{"method": "guess", "identifiable": False}, {"focal": FOCAL * 1.011}, {"focal": FOCAL / 1.011}]
)
def test_a_camera_that_was_a_guess_or_moved_is_mapped_with_again(synthetic, run, cameras, mapped, camera):
    seen = mapped(without(with_camera(synthetic.copy(), TRUE), [6]), with_camera(synthetic.copy(), TRUE))
    found = mapped.outcome(cameras(**camera), run())
    assert found.passes == 2 and found.models[0].photos == 6
    assert len(seen) == 2
    learned = seen[1][1].main
    assert (learned.focal_px, learned.identifiable, learned.method) == (FOCAL, True, "mapping")
    assert found.intrinsics is seen[1][1]
    assert focals_in(run().workspace.database) == [FOCAL]
    assert {pose.kind for pose in found.graph.poses.values()} == {"calibrated"}


def test_a_second_pass_that_explains_less_is_thrown_away_with_all_that_it_wrote(synthetic, run, cameras, mapped):
    guess = cameras(FOCAL * 1.1, method="guess", identifiable=False)
    place = run().workspace
    mapped(without(synthetic.copy(), [4, 5, 6]))
    Passes(run(), mapped.mappers).run_pass(synthetic.matches, synthetic.views, guess)
    first = geometries_in(place.database)

    seen = mapped(with_camera(synthetic.copy(), TRUE), without(with_camera(synthetic.copy(), TRUE), [5, 6]))
    found = mapped.outcome(guess, run())

    assert len(seen) == 2
    assert found.passes == 1 and found.models[0].photos == 6 and found.intrinsics is guess
    assert focals_in(place.database) == [pytest.approx(FOCAL * 1.1)]
    assert geometries_in(place.database) == first
    assert {pose.kind for pose in found.graph.poses.values()} == {"uncalibrated"}


def test_a_second_pass_that_finds_nothing_leaves_the_first(synthetic, run, cameras, mapped):
    mapped(with_camera(synthetic.copy(), TRUE), None)
    found = mapped.outcome(cameras(method="guess", identifiable=False), run())
    assert (found.passes, found.models[0].photos) == (1, 6)


def test_without_a_model_there_is_nothing_to_learn(synthetic, run, cameras, mapped):
    seen = mapped(None, None, None, None)
    found = mapped.outcome(cameras(method="guess", identifiable=False), run())
    assert found.models == () and found.support == 0.0 and found.tried[:2] == ("nothing", "no rival")
    assert len(seen) == 4 and len(found.tried) == 5  # the usual guess, and three others


def test_a_rival_that_explains_more_goes_on(synthetic, run, cameras, mapped):
    mapped(without(with_camera(synthetic.copy(), TRUE), [6]), None)
    asked = mapped.rival(with_camera(synthetic.copy(), TRUE))
    found = mapped.outcome(cameras(), run())
    assert len(asked) == 1 and found.rival_reason == "unregistered photos with matches: 1"
    assert (found.models[0].mapper, found.models[0].photos) == ("colmap", 6)
    assert "the rival" in found.tried and found.reason.startswith("it registers all 6 photos")


def test_later_steps_know_the_pairs_of_a_rival_that_goes_on(synthetic, run, cameras, mapped):
    """Its photos need not be in our pose graph: tracks could not be completed, and COLMAP raised."""
    views = replace(synthetic.views, fits={pair: fit for pair, fit in synthetic.views.fits.items() if 6 not in pair})
    mapped(without(with_camera(synthetic.copy(), TRUE), [5, 6]), None)
    mapped.rival(with_camera(synthetic.copy(), TRUE))
    made = run()
    found = mapped.outcome(cameras(), made, views=views)
    assert found.models[0].photos == 6 and {(k, 6) for k in range(1, 6)} <= found.graph.poses.keys()
    assert len(geometries_in(made.workspace.database)) == 15
    assert posed_photo_ids(adjust(found.models[0].model, made.workspace.database).model) == [1, 2, 3, 4, 5, 6]


def test_a_rival_that_explains_less_is_named_and_left(synthetic, run, cameras, mapped):
    mapped(with_camera(synthetic.copy(), TRUE), None)
    asked = mapped.rival(without(with_camera(synthetic.copy(), TRUE), [5, 6]))
    found = mapped.outcome(cameras(method="guess", identifiable=False), run())
    assert len(asked) == 1 and found.rival_reason == "the pairs do not determine a camera"
    assert (found.models[0].mapper, found.models[0].photos) == ("incremental", 6)
    assert "the rival" in found.tried


def test_good_evidence_needs_no_rival(synthetic, run, cameras, mapped):
    mapped(with_camera(synthetic.copy(), TRUE))
    asked = mapped.rival(synthetic.copy())
    found = mapped.outcome(cameras(), run())
    assert asked == [] and found.rival_reason == "" and found.models[0].photos == 6


def test_where_a_guess_leaves_many_photos_out_other_focals_are_tried(synthetic, run, cameras, mapped):
    few = without(synthetic.copy(), [4, 5, 6])
    seen = mapped(few, few, with_camera(synthetic.copy(), TRUE), None, None)
    found = mapped.outcome(cameras(method="guess", identifiable=False), run())
    focals = [intrinsics.main.focal_px / 1024 for _, intrinsics in seen]
    assert focals[1:4] == pytest.approx([0.6, 2.4, 4.8])
    assert focals[4:] == pytest.approx([FOCAL / 1024])  # what the best of them has found is gone on with
    assert found.models[0].photos == 6
    assert "6 photos (focal 2.4 longer sides)" in found.tried


def test_no_other_focals_are_tried_where_one_is_known(synthetic, run, cameras, mapped):
    seen = mapped(without(synthetic.copy(), [4, 5, 6]), None)
    mapped.outcome(cameras(), run())
    assert all(intrinsics.main.focal_px == pytest.approx(FOCAL, rel=0.01) for _, intrinsics in seen)


def test_a_rival_that_fails_costs_nothing(synthetic, run, cameras, mapped, monkeypatch):
    mapped(with_camera(synthetic.copy(), TRUE), None)

    def fail(*_):
        raise BackendError("COLMAP failed")

    monkeypatch.setattr(passes, "map_with_colmap_defaults", fail)
    mapped.mappers = replace(mapped.mappers, map_baseline=passes.map_baseline)

    found = mapped.outcome(cameras(method="guess", identifiable=False), run())

    assert found.models[0].photos == 6
    assert any("COLMAP's default pipeline: failed" in note for note in found.tried)


def learned(model, synthetic, intrinsics):
    return learned_intrinsics(Attempt("global", model, {}, ""), intrinsics, synthetic.matches)


def worth(model, synthetic, intrinsics, photos=6):
    graph = PoseGraph({}, {}, (tuple(range(1, photos + 1)),))
    found = module.Outcome((Attempt("global", model, {}, ""),), graph, intrinsics, ())
    return module.needs_another_pass(found, intrinsics, synthetic.matches)


def test_two_photos_teach_no_camera(synthetic, cameras):
    guess = cameras(method="guess", identifiable=False)
    assert not worth(without(synthetic.copy(), [3, 4, 5, 6]), synthetic, guess)
    assert worth(without(synthetic.copy(), [4, 5, 6]), synthetic, guess)


def test_photos_of_the_main_group_that_stayed_out_are_worth_another_pass(synthetic, cameras):
    known = cameras(FOCAL)
    assert not worth(with_camera(synthetic.copy(), TRUE), synthetic, known)
    assert worth(without(with_camera(synthetic.copy(), TRUE), [6]), synthetic, known)
    assert not worth(without(with_camera(synthetic.copy(), TRUE), [6]), synthetic, known, photos=5)


def test_what_is_learned_is_focal_center_and_lens(synthetic, cameras):
    guess = cameras(FOCAL * 1.2, method="guess", identifiable=False, reason="an orbit", held=("center",))
    model = with_camera(synthetic.copy(), [1300.0, 500.0, 390.0, -0.07])
    found = learned(model, synthetic, guess).main
    assert found.K.tolist() == [[1300.0, 0, 500.0], [0, 1300.0, 390.0], [0, 0, 1]]
    assert (found.radial, found.reason, found.held) == (-0.07, "", ("center",))


def test_of_given_cameras_nothing_is_learned_where_they_are_kept_and_all_terms_stay(synthetic, cameras):
    terms = (-0.07, 0.02, 0.001, -0.002, 0.0, 0.0, 0.0, 0.0)
    kept = cameras(FOCAL * 1.1, method="kept")
    given = cameras(FOCAL * 1.1, method="given", radial=-0.07, distortion=terms)
    model = with_camera(synthetic.copy(), [1300.0, 500.0, 390.0, -0.01])
    assert learned(model, synthetic, kept).main is kept.main
    found = learned(model, synthetic, given).main
    assert (found.K[0, 0], found.distortion, found.radial) == (1300.0, terms, -0.07)
    told = guessed_intrinsics(given).main, guessed_intrinsics(cameras(method="zero-curves")).main
    assert [camera.method for camera in told] == ["given", "guess"]


def test_a_camera_of_no_photo_in_the_model_stays_what_it_was(synthetic, cameras):
    two = replace(cameras(900.0, method="guess", identifiable=False).main)
    intrinsics = replace(
        cameras(FOCAL * 1.1), cameras={**cameras(FOCAL * 1.1).cameras, "two": two},
        camera_of={synthetic.matches.images[6].name: "two"},
    )  # fmt: skip
    found = learned(without(with_camera(synthetic.copy(), TRUE), [6]), synthetic, intrinsics)
    assert found.cameras["two"] is two
    assert found.cameras["one"].focal_px == FOCAL


def joined(inside, between):
    """What a model of photos 1 to 3 and 4 to 6 explains within and between these."""
    pairs = {(a, b): inside for part in ((1, 2, 3), (4, 5, 6)) for a in part for b in part if a < b}
    return pairs | {(3, 4): PairSupport(40, 30, 0), (2, 5): between, (1, 6): between}


GOOD, AGAINST, FOR = PairSupport(100, 100, 0), PairSupport(5, 60, 55), PairSupport(30, 30, 0)


def test_a_model_whose_join_is_contradicted_gives_its_parts(synthetic):
    attempt = Attempt("global", synthetic.copy(), joined(GOOD, AGAINST), "how")
    first, second = split_attempt(attempt)
    assert [posed_photo_ids(part.model) for part in (first, second)] == [[1, 2, 3], [4, 5, 6]]
    assert set(first.explained) == {(1, 2), (1, 3), (2, 3)} and set(second.explained) == {(4, 5), (4, 6), (5, 6)}
    assert (first.mapper, first.note) == ("global", "how")
    assert attempt.photos == 6  # the model itself is as it was
    assert 90 < first.model.num_points3D() <= 100


def test_a_model_whose_join_holds_stays_as_it_is(synthetic):
    attempt = Attempt("global", synthetic.copy(), joined(GOOD, FOR), "how")
    assert split_attempt(attempt) == [attempt]


def test_lonely_photos_and_lesser_pairs_are_left_out(synthetic):
    pairs = {(1, 2): GOOD, (1, 3): GOOD, (4, 5): GOOD}
    [part] = split_attempt(Attempt("global", synthetic.copy(), pairs, "how"))
    assert posed_photo_ids(part.model) == [1, 2, 3]


def test_the_parts_of_a_cut_model_are_models_of_their_own_and_named(synthetic, run, cameras, mapped, monkeypatch):
    mapped(synthetic.copy())
    monkeypatch.setattr(module, "merge_into_main", lambda models, *_: models)  # what contradicts is made up
    cut = joined(GOOD, AGAINST)
    del cut[5, 6]
    attempts = mapped.mappers.map_group
    mapped.mappers = replace(
        mapped.mappers, map_group=lambda group, run: [replace(found, explained=cut) for found in attempts(group, run)]
    )

    found = mapped.outcome(cameras(), run())

    assert [posed_photo_ids(part.model) for part in found.models] == [[1, 2, 3], [4, 5, 6]]
    assert found.cuts == tuple(
        ", ".join(synthetic.matches.images[key].name for key in part) for part in ((1, 2, 3), (4, 5, 6))
    )
    assert found.support == found.models[0].support == pytest.approx(150)


def only(synthetic, *pairs):
    """Matches and F's of these pairs alone."""
    matches = replace(synthetic.matches, matches={pair: synthetic.matches.matches[pair] for pair in pairs})
    return matches, replace(synthetic.views, fits={pair: synthetic.views.fits[pair] for pair in pairs})


def test_a_group_of_two_photos_is_mapped_when_there_is_no_other(synthetic, run, cameras, mapped):
    seen = mapped(without(synthetic.copy(), [1, 2, 4, 6]))
    found = mapped.outcome(cameras(), run(), *only(synthetic, (3, 5)))
    assert [photos for photos, _ in seen] == [(3, 5)]
    assert posed_photo_ids(found.models[0].model) == [3, 5]


def test_the_model_with_most_photos_is_the_main_one(synthetic, run, cameras, mapped):
    pairs = [(1, 2), (1, 3), (2, 3), (4, 5), (4, 6), (5, 6)]
    mapped(without(synthetic.copy(), [3, 4, 5, 6]), without(synthetic.copy(), [1, 2, 3]))
    found = mapped.outcome(cameras(), run(), *only(synthetic, *pairs))
    assert [posed_photo_ids(attempt.model) for attempt in found.models] == [[4, 5, 6], [1, 2]]
    assert found.tried == ("2 photos", "3 photos", "no rival")


def test_every_group_is_mapped_but_lesser_ones_of_two_photos(synthetic, run, cameras, mapped):
    matches, views = only(synthetic, (1, 2), (3, 4), (3, 5), (4, 5))
    seen = mapped(without(synthetic.copy(), [1, 2, 6]))
    found = mapped.outcome(cameras(), run(), matches, views)
    assert found.graph.groups == ((3, 4, 5), (1, 2))
    assert [photos for photos, _ in seen] == [(3, 4, 5)]
    assert posed_photo_ids(found.models[0].model) == [3, 4, 5]
