"""Mappers that find the models of a test; pose graph, models and database are real."""

import contextlib
import sqlite3
from dataclasses import replace

import pytest

from sfm_app.colmap.database import open_database, write_match_graph
from sfm_app.mapping.attempt import Attempt, NoModel, PairSupport, explained_pairs
from sfm_app.mapping.hypotheses import ALL, FIRST_LOOK, improve, reconstruct
from sfm_app.mapping.passes import Mapper, Mappers, Outcome
from sfm_app.types import Evidence, PoseGraph

FOCAL = 1280.0
TRUE = [FOCAL, 512.0, 384.0, 0.0]
EMPTY = PoseGraph({}, {}, ())


def hypothesis(name):
    return next(one for one in ALL if one.name == name)


def with_camera(model, params):
    for camera in model.cameras.values():
        camera.params = params
    return model


def without(model, photos):
    for photo in photos:
        model.deregister_frame(model.images[photo].frame_id)
    return model


def focals_in(path):
    with open_database(path) as database:
        return [camera.params[0] for camera in database.read_all_cameras()]


def geometries_in(path):
    with contextlib.closing(sqlite3.connect(path)) as database:
        return database.execute("SELECT * FROM two_view_geometries ORDER BY pair_id").fetchall()


def trials_of(outcome):
    """Name, whether it was accepted, and notes of every trial."""
    return [(trial.name, trial.accepted, *trial.notes) for trial in outcome.trials]


def trial_of(outcome, name):
    """The only trial of a hypothesis."""
    [trial] = [trial for trial in outcome.trials if trial.name == name]
    return trial


def joined(inside, between):
    """What a model of photos 1 to 3 and 4 to 6 explains within and between these."""
    pairs = {(a, b): inside for part in ((1, 2, 3), (4, 5, 6)) for a in part for b in part if a < b}
    return pairs | {(3, 4): PairSupport(40, 30, 0), (2, 5): between, (1, 6): between}


GOOD, AGAINST, FOR = PairSupport(100, 100, 0), PairSupport(5, 60, 55), PairSupport(30, 30, 0)


class Fakes:
    """Mappers with models, rivals and judgments of a test; `seen` has the photos and cameras of each group."""

    def __init__(self, synthetic):
        self.synthetic, self.seen = synthetic, []
        self.mappers = Mappers(map_rival=lambda *_: NoModel("colmap", "no rival"))

    def attempt(self, model, mapper="incremental"):
        explained = explained_pairs(model, self.synthetic.evidence(None), 1.5)
        return Attempt(mapper, model, explained, f"{model.num_reg_images()} photos")

    def __call__(self, *models):
        """Give these models, or attempts, one after the other."""
        left, self.seen = list(models), []

        def attempts(group, run):
            self.seen.append((group.photos, group.evidence.intrinsics))
            model = left.pop(0)
            if model is None:
                return [NoModel("incremental", "nothing")]
            return [model if isinstance(model, Attempt) else self.attempt(model)]

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

        def map_rival(evidence, run):
            calls.append(evidence.intrinsics)
            explained = explained_pairs(model, evidence, 1.5)
            return Attempt("colmap", model, explained, "the rival")

        self.mappers = replace(self.mappers, map_rival=map_rival)
        return calls

    def parts(self, joins, *models, whole=None):
        """Map in parts: these false joins, pass by pass, stop the mapping, then the models follow; or map the whole."""
        seen, left, ready = [], list(joins), list(models)

        def attempts(group, followed, run, *, stop_at_false_joins):
            seen.append((set(group.graph.poses), set(followed.poses), stop_at_false_joins))
            if stop_at_false_joins and left:
                return [], left.pop(0)
            return [self.attempt(ready.pop(0), "parts")], ()

        self.mappers = replace(
            self.mappers,
            part_size=lambda *_: 3,
            map_in_parts=attempts,
            map_group=lambda *_: [whole or pytest.fail("the whole was mapped")],
            judge_places=lambda _: ([], 0),
        )
        return seen

    def evidence(self, intrinsics, matches=None, views=None):
        return Evidence(matches or self.synthetic.matches, views or self.synthetic.views, intrinsics)

    def outcome(self, intrinsics, run, matches=None, views=None, hypotheses=FIRST_LOOK):
        return reconstruct(self.evidence(intrinsics, matches, views), run, self.mappers, hypotheses)

    def best(self, intrinsics, run, *attempts, **others):
        """Return the best outcome so far; its photos are in the database."""
        write_match_graph(run.workspace.database, self.synthetic.matches)
        graph = PoseGraph({}, {}, (tuple(self.synthetic.matches.images),))
        return Outcome(attempts, graph, self.evidence(intrinsics), intrinsics, run, **others)

    def improve(self, best, *hypotheses):
        return improve(best, Mapper(best.run, self.mappers), hypotheses)
