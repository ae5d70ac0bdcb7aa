"""Map one part of a group, as a separate process; see `part_mapping.map_part`."""

import json
import tempfile
from dataclasses import asdict
from functools import cache
from os.path import relpath
from pathlib import Path

from sfm_app.colmap.backend import check_written, translate_errors
from sfm_app.colmap.database import write_calibrations, write_match_graph, write_pose_graph
from sfm_app.colmap.model import posed_photo_ids, submodel
from sfm_app.files import replace_atomically
from sfm_app.mapping.attempt import MAPPING, Attempt, best_attempt, map_group
from sfm_app.mapping.look_alikes import judge_places
from sfm_app.mapping.part_mapping import INPUTS, RESULT, read_inputs
from sfm_app.mapping.splits import sound_parts
from sfm_app.plugins import load_plugins
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import make_executor
from sfm_app.runtime.workspace import SubWorkspace, Workspace
from sfm_app.types import PoseGraph


def work(photos: Path, folder: Path) -> None:
    """Map the part in a folder, and write its models and notes beside its inputs."""
    inputs = read_inputs(folder / INPUTS)
    judge = cache(lambda attempt: judge_places([attempt])[0])
    enough = MAPPING.enough_share * len(inputs.part.photos)
    # a worker that was cut off from a cluster may still be at the same part
    with tempfile.TemporaryDirectory(dir=folder, prefix="mapping-") as own, make_executor(1) as executor:
        place = SubWorkspace(Workspace(photos.parent), relpath(own, photos.parent))
        part, graph = inputs.part, inputs.part.graph
        poses = {pair: pose for pair, pose in graph.poses.items() if pair in inputs.mapped}
        with translate_errors("entering the photos of a part"):
            write_match_graph(place.database, part.evidence.matches)
            write_calibrations(place.database, part.evidence.matches, part.evidence.intrinsics)
            write_pose_graph(place.database, part.evidence.matches, PoseGraph(poses, {}, graph.groups))
        run = RunContext(inputs.settings, place, load_plugins(installed=False), executor, workers=1)
        attempts = map_group(
            inputs.part, run, lambda one: inputs.stop_at_false_joins and one.photos >= enough and bool(judge(one))
        )
    if (folder / RESULT).exists():
        return
    best = best_attempt(attempts)
    result = {
        "models": [] if best is None else _write_models(best, folder),
        "mapper": "" if best is None else best.mapper,
        "tried": [one.note for one in attempts],
        "false_joins": [] if best is None else [asdict(join) for join in judge(best)],
    }
    with replace_atomically(folder / RESULT) as path:
        path.write_text(json.dumps(result), encoding="utf-8", newline="\n")


def _write_models(best: Attempt, folder: Path) -> list[str]:
    parts = sound_parts(best.explained, posed_photo_ids(best.model))
    pieces = [photos for photos in parts if len(photos) >= 3]  # nothing determines the scale of two photos
    names = []
    for number, photos in enumerate(pieces):
        names.append(f"model-{number}")
        target = folder / names[-1]
        target.mkdir(exist_ok=True)
        with translate_errors("writing the model of a part"):
            submodel(best.model, photos).write(target)
            check_written(*target.iterdir())
    return names
