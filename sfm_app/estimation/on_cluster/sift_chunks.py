"""COLMAP's SIFT on a cluster: workers find and match in chunks, this process enters their rows in a fixed order."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from sfm_app.colmap.database import photo_names, unmatched_pairs
from sfm_app.colmap.part_databases import (
    FEATURES,
    MATCHES,
    Part,
    SiftInputs,
    enter_rows,
    exhaustive_pairs,
    find_in_chunk,
    match_chunk,
    photos_without_features,
    write_snapshot,
)
from sfm_app.colmap.processes.worker_process import SiftOption
from sfm_app.numerical import Json
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import ordered_map
from sfm_app.tasks import Task
from sfm_app.types import PairId

MOST_PHOTOS, MOST_PAIRS, SIDE = 8, 64, 8
"""Photos, and pairs, that a worker takes at once, and photos on each side of a square of pairs, whose features are read
together: a process of COLMAP's takes a second to start. Chosen by hand."""
ROUNDS = 2
"""Least number of chunks for each worker, so that none waits long for the last one. Chosen by hand."""

Item = TypeVar("Item")


def find_in_chunks(sift: Mapping[str, SiftOption], names: Sequence[str], run: RunContext) -> dict[str, Json]:
    """Find features of photos on a cluster; those that are in the database stay.

    Args:
        sift: options of COLMAP's SIFT that differ from its defaults.
        names: of the photos.
        run: the run.

    Returns:
        The options in force, for the manifest.

    Raises:
        BackendError: COLMAP failed.
        ClusterError: the cluster is gone.
    """
    wanted = set(names)
    left = [name for name in photos_without_features(run.workspace.database).values() if name in wanted]
    return _do_in_chunks(find_in_chunk, chunks(left, MOST_PHOTOS, run.spread), sift, run)


def match_in_chunks(sift: Mapping[str, SiftOption], pairs: Sequence[PairId] | None, run: RunContext) -> dict[str, Json]:
    """Match pairs of photos on a cluster; pairs that are in the database stay.

    Args:
        sift: as in `find_in_chunks`.
        pairs: ids of photos; None for all.
        run: the run.

    Returns:
        The options in force, for the manifest.

    Raises:
        BackendError: COLMAP failed.
        ClusterError: the cluster is gone.
    """
    database = run.workspace.database
    asked = exhaustive_pairs(sorted(photo_names(database))) if pairs is None else list(pairs)
    left = set(unmatched_pairs(database, [(min(pair), max(pair)) for pair in asked]))
    todo = [pair for pair in asked if (min(pair), max(pair)) in left]
    rank = {photo: place for place, photo in enumerate(sorted({photo for pair in todo for photo in pair}))}
    todo.sort(key=lambda pair: (*sorted(rank[photo] // SIDE for photo in pair), *sorted(pair)))
    return _do_in_chunks(match_chunk, chunks(todo, MOST_PAIRS, run.spread), sift, run)


def chunks(items: Sequence[Item], most: int, workers: int) -> list[Sequence[Item]]:
    """Return items in chunks that keep all workers busy.

    Args:
        items: to cut.
        most: items of a chunk.
        workers: that share the chunks.
    """
    size = max(1, min(most, -(-len(items) // (ROUNDS * max(1, workers)))))
    return [items[first : first + size] for first in range(0, len(items), size)]


def _do_in_chunks(
    work: Callable[[SiftInputs, Sequence[Item]], Part],
    parts: Sequence[Sequence[Item]],
    sift: Mapping[str, SiftOption],
    run: RunContext,
) -> dict[str, Json]:
    """Let workers do chunks, and enter their rows in order."""
    place, tables, label = run.workspace, FEATURES, "features"
    if work is match_chunk:
        tables, label = MATCHES, "matching"
    folder, in_force = place.sift_rows, dict[str, Json]()
    shutil.rmtree(folder, ignore_errors=True)
    if not parts:
        return in_force
    inputs = _write_inputs(folder, sift, run, with_features=tables is MATCHES)
    run.progress.start(label, sum(len(part) for part in parts))
    try:
        for found in ordered_map(run.executor, Task(work, inputs), parts, ahead=run.workers):
            enter_rows(place.database, found.path, tables)
            in_force |= found.in_force
            run.progress.advance(found.count)
    finally:
        run.progress.finish()
        shutil.rmtree(folder, ignore_errors=True)
    return in_force


def _write_inputs(folder: Path, sift: Mapping[str, SiftOption], run: RunContext, *, with_features: bool) -> SiftInputs:
    """Write the snapshots that workers read."""
    place, folder = run.workspace, folder.absolute()
    folder.mkdir(parents=True)
    inputs = SiftInputs(
        folder / "photos.db", folder / "features.db", place.photos.absolute(),
        run.mask_dir.absolute() if run.mask_dir else None, run.settings.matching, dict(sift), folder,
    )  # fmt: skip
    write_snapshot(place.database, inputs.snapshot, (*FEATURES, *MATCHES))
    if with_features:
        write_snapshot(place.database, inputs.features, MATCHES)
    return inputs
