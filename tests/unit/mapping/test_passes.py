"""One pass over all photos, with mappers that find the models of a test."""

from dataclasses import replace

import pytest

from sfm_app.colmap.model import posed_photo_ids
from sfm_app.mapping.attempt import Attempt, NoModel
from sfm_app.mapping.passes import Mapper, guessed_intrinsics
from sfm_app.mapping.splits import split_attempt
from sfm_app.types import LookAlikes
from tests.unit.mapping.fakes import (
    AGAINST,
    FOCAL,
    FOR,
    GOOD,
    TRUE,
    focals_in,
    geometries_in,
    joined,
    with_camera,
    without,
)

pytestmark = pytest.mark.slow


def test_parts_with_two_places_in_one_are_mapped_again_before_any_is_joined(synthetic, run, cameras, mapped):
    joins = [(LookAlikes(((1, 4), (2, 4)), 0.9),), (LookAlikes(((3, 6),), 0.8),)]
    model = with_camera(synthetic.copy(), TRUE)
    seen = mapped.parts(joins, model)

    found = mapped.outcome(cameras(), run())

    gone = [set(), {(1, 4), (2, 4)}, {(1, 4), (2, 4), (3, 6)}]
    assert [len(poses) for poses, *_ in seen] == [15, 13, 12]
    assert all(not poses & dropped for (poses, *_), dropped in zip(seen, gone, strict=True))
    assert found.main.model is model and found.notes == ("6 photos",)
    assert {pair for join in found.graph.look_alikes for pair in join.pairs} == gone[-1]
    assert len(geometries_in(run().workspace.database)) == 12


def test_the_evidence_of_an_outcome_has_the_matches_of_look_alikes_too(synthetic, run, cameras, mapped):
    join = LookAlikes(((1, 4), (2, 4)), 0.9)
    mapped.parts([(join,)], with_camera(synthetic.copy(), TRUE))
    found = mapped.outcome(cameras(), run())
    assert found.evidence.matches.matches.keys() == synthetic.matches.matches.keys()
    assert found.trusted.views.fits.keys() == synthetic.views.fits.keys() - set(join.pairs)


def test_false_joins_of_parts_stay_where_nothing_else_holds_the_photos_together(synthetic, run, cameras, mapped):
    join = LookAlikes(((1, 4), (2, 4)), 0.9)
    first = with_camera(synthetic.copy(), TRUE)
    few = without(with_camera(synthetic.copy(), TRUE), [6])
    seen = mapped.parts([(join,)], few, first, whole=NoModel("incremental", "nothing"))
    found = mapped.outcome(cameras(), run())
    assert [(len(poses), asked) for poses, _, asked in seen] == [(15, True), (13, True), (15, False)]
    assert found.main.model is first
    assert found.graph.look_alikes == () and found.graph.doubtful == (join,)
    assert len(geometries_in(run().workspace.database)) == 15


def test_parts_are_asked_a_few_times_only(synthetic, run, cameras, mapped):
    joins = [(LookAlikes((pair,), 0.9),) for pair in ((1, 4), (2, 5), (3, 6), (1, 5))]
    seen = mapped.parts(joins, with_camera(synthetic.copy(), TRUE))
    found = mapped.outcome(cameras(), run())
    assert [asked for *_, asked in seen] == [True, True, True, False]
    assert found.graph.look_alikes == tuple(join for (join,) in joins[:3])


@pytest.mark.parametrize(("lost", "mapper"), [([], "parts"), ([5, 6], "incremental")])
def test_the_whole_is_mapped_where_parts_do_not_explain_it(synthetic, run, cameras, mapped, lost, mapper):
    whole = mapped.attempt(with_camera(synthetic.copy(), TRUE))
    mapped.parts([], without(with_camera(synthetic.copy(), TRUE), lost), whole=whole)
    found = Mapper(run(), mapped.mappers).map(mapped.evidence(cameras()))
    assert found.main.mapper == mapper and found.photos == 6
    assert len(found.notes) == (2 if lost else 1)


def test_a_pass_writes_the_cameras_and_poses_that_it_maps_with(synthetic, run, cameras, mapped):
    seen = mapped(with_camera(synthetic.copy(), [FOCAL * 1.009, 512.0, 384.0, 0.01]))
    found = mapped.outcome(cameras(), run())
    assert len(seen) == 1 and found.notes == ("6 photos",) and found.cuts == ()
    assert found.graph.groups == ((1, 2, 3, 4, 5, 6),) and seen[0][0] == (1, 2, 3, 4, 5, 6)
    assert focals_in(run().workspace.database) == [FOCAL]


def test_the_usual_guess_replaces_no_given_camera(cameras):
    told = guessed_intrinsics(cameras(method="given")).main, guessed_intrinsics(cameras(method="zero-curves")).main
    assert [camera.method for camera in told] == ["given", "guess"]


def test_a_model_whose_join_is_contradicted_gives_its_parts(synthetic, run):
    attempt = Attempt("global", synthetic.copy(), joined(GOOD, AGAINST), "how")
    first, second = split_attempt(attempt, run())
    assert [posed_photo_ids(part.model) for part in (first, second)] == [[1, 2, 3], [4, 5, 6]]
    assert set(first.explained) == {(1, 2), (1, 3), (2, 3)} and set(second.explained) == {(4, 5), (4, 6), (5, 6)}
    assert (first.mapper, first.note) == ("global", "how")
    assert attempt.photos == 6  # the model itself is as it was
    assert split_attempt(attempt, run(without=["splits"])) == [attempt]
    assert 90 < first.model.num_points3D() <= 100


def test_a_model_whose_join_holds_stays_as_it_is(synthetic, run):
    attempt = Attempt("global", synthetic.copy(), joined(GOOD, FOR), "how")
    assert split_attempt(attempt, run()) == [attempt]


def test_lonely_photos_and_lesser_pairs_are_left_out(synthetic, run):
    pairs = {(1, 2): GOOD, (1, 3): GOOD, (4, 5): GOOD}
    [part] = split_attempt(Attempt("global", synthetic.copy(), pairs, "how"), run())
    assert posed_photo_ids(part.model) == [1, 2, 3]


def test_the_parts_of_a_cut_model_are_models_of_their_own_and_named(synthetic, run, cameras, mapped):
    cut = joined(GOOD, AGAINST)
    del cut[5, 6]
    mapped(replace(mapped.attempt(synthetic.copy()), explained=cut))

    found = Mapper(run(), mapped.mappers).map(mapped.evidence(cameras()))

    assert [posed_photo_ids(part.model) for part in found.models] == [[1, 2, 3], [4, 5, 6]]
    assert found.cuts == tuple(", ".join(synthetic.matches.names(part)) for part in ((1, 2, 3), (4, 5, 6)))
    assert found.support == found.models[0].support == pytest.approx(150)
    [trial] = found.trials
    assert (trial.name, trial.accepted, trial.photos) == ("splits", True, (6, 3))
    assert trial.support[1] == found.support


@pytest.mark.parametrize("lost", [[], [5, 6]])
def test_the_global_mapper_is_a_trial_where_it_followed_another_one(synthetic, run, cameras, mapped, lost):
    first = replace(mapped.attempt(without(synthetic.copy(), [6])), mapper="incremental")
    own = replace(mapped.attempt(without(synthetic.copy(), lost)), reason="photo 6 is unregistered", seconds=2.5)
    mappers = replace(mapped.mappers, map_group=lambda *_: [first, own])
    [trial] = Mapper(run(), mappers).map(mapped.evidence(cameras())).trials
    assert (trial.name, trial.reason, trial.seconds) == ("global-mapper", "photo 6 is unregistered", 2.5)
    assert (trial.accepted, trial.photos) == (not lost, (5, 6 - len(lost)))


def only(synthetic, *pairs):
    """Matches and F's of these pairs alone."""
    matches = replace(synthetic.matches, matches={pair: synthetic.matches.matches[pair] for pair in pairs})
    return matches, replace(synthetic.views, fits={pair: synthetic.views.fits[pair] for pair in pairs})


def test_a_group_of_two_photos_is_mapped_when_there_is_no_other(synthetic, run, cameras, mapped):
    seen = mapped(without(synthetic.copy(), [1, 2, 4, 6]))
    found = mapped.outcome(cameras(), run(), *only(synthetic, (3, 5)))
    assert [photos for photos, _ in seen] == [(3, 5)]
    assert posed_photo_ids(found.main.model) == [3, 5]


def test_the_model_with_most_photos_is_the_main_one(synthetic, run, cameras, mapped):
    pairs = [(1, 2), (1, 3), (2, 3), (4, 5), (4, 6), (5, 6)]
    mapped(without(synthetic.copy(), [3, 4, 5, 6]), without(synthetic.copy(), [1, 2, 3]))
    found = mapped.outcome(cameras(), run(), *only(synthetic, *pairs))
    assert [posed_photo_ids(attempt.model) for attempt in found.models] == [[4, 5, 6], [1, 2]]
    assert found.notes == ("2 photos", "3 photos")


def test_every_group_is_mapped_but_lesser_ones_of_two_photos(synthetic, run, cameras, mapped):
    matches, views = only(synthetic, (1, 2), (3, 4), (3, 5), (4, 5))
    seen = mapped(without(synthetic.copy(), [1, 2, 6]))
    found = mapped.outcome(cameras(), run(), matches, views)
    assert found.graph.groups == ((3, 4, 5), (1, 2))
    assert [photos for photos, _ in seen] == [(3, 4, 5)]
    assert posed_photo_ids(found.main.model) == [3, 4, 5]
