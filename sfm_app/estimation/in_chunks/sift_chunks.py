"""COLMAP's SIFT in chunks, on a cluster or in processes of this machine; this process enters their rows in order.

COLMAP's matcher loses matches now and then where several threads of a process match: of 1540 pairs of small photos, one
or two pairs differ in half of the runs. So each process has one thread.
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from threading import Lock
from typing import TypeVar

from sfm_app.colmap.database import photo_names, unmatched_pairs
from sfm_app.colmap.part_databases import (
    FEATURES,
    MATCHES,
    Part,
    SiftInputs,
    count_features,
    enter_rows,
    exhaustive_pairs,
    find_in_chunk,
    match_chunk,
    match_chunk_apart,
    photos_without_features,
    write_snapshot,
)
from sfm_app.colmap.processes.worker_process import ProcessGroup, SiftOption
from sfm_app.estimation.in_chunks.pair_chunks import cut_pairs
from sfm_app.numerical import Json
from sfm_app.progress import Progress, SilentProgress
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import ordered_map
from sfm_app.tasks import Task
from sfm_app.types import PairId

MOST_PHOTOS = 8
"""Photos whose features a worker finds at once: a process of COLMAP's takes a second to start. Chosen by hand."""
CHUNK_S, FEATURE_S = 30.0, 1.1e-5
"""Seconds that a chunk of pairs should take, and those of a pair for each feature of its photos. An index of a photo's
descriptors costs as much as 1.5 pairs, and each chunk makes its own. Measured on castle-P19 and kitchen1000."""
LEAST_PAIRS, MOST_PAIRS = 64, 4096
"""Pairs of a chunk. Chosen by hand."""

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
    parts = chunks(left, MOST_PHOTOS, run.spread)
    return _do_in_chunks(partial(Task, find_in_chunk), parts, FEATURES, sift, run)


def match_in_chunks(sift: Mapping[str, SiftOption], pairs: Sequence[PairId] | None, run: RunContext) -> dict[str, Json]:
    """Match pairs of photos on a cluster, or in processes of this machine; pairs that are in the database stay.

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
    parts = _chunks_of_pairs(todo, count_features(database), run.spread or run.workers)
    if run.spread:
        return _do_in_chunks(partial(Task, match_chunk), parts, MATCHES, sift, run)
    group, counter = ProcessGroup(), _PairCounter(run.progress)
    try:
        return _do_in_chunks(
            lambda inputs: partial(match_chunk_apart, inputs, group, counter), parts, MATCHES, sift, run
        )
    finally:
        group.stop()


class _PairCounter(SilentProgress):
    """Counts the pairs of several processes on one bar."""

    def __init__(self, progress: Progress) -> None:
        self._progress, self._lock = progress, Lock()

    def advance(self, steps: int = 1) -> None:
        with self._lock:
            self._progress.advance(steps)


def _chunks_of_pairs(pairs: Sequence[PairId], features: Sequence[int], workers: int) -> list[list[PairId]]:
    """Return pairs in chunks of few photos each."""
    pair_s = FEATURE_S * max(sum(features) / max(len(features), 1), 1.0)
    return cut_pairs(pairs, chunk_size(len(pairs), min(max(int(CHUNK_S / pair_s), LEAST_PAIRS), MOST_PAIRS), workers))


def chunks(items: Sequence[Item], most: int, workers: int) -> list[Sequence[Item]]:
    """Return items in chunks of about the same size, as many for each worker.

    Args:
        items: to cut.
        most: items of a chunk.
        workers: that share the chunks.
    """
    size = chunk_size(len(items), most, workers)
    return [items[first : first + size] for first in range(0, len(items), size)]


def chunk_size(count: int, most: int, workers: int) -> int:
    """Return the items of each chunk, so that workers get as many chunks.

    Args:
        count: items to cut.
        most: items of a chunk.
        workers: that share the chunks.
    """
    rounds = -(-count // (most * max(1, workers)))
    return max(1, -(-count // max(1, rounds * workers)))


def _do_in_chunks(
    prepare: Callable[[SiftInputs], Callable[[Sequence[Item]], Part]],
    parts: Sequence[Sequence[Item]],
    tables: tuple[str, str],
    sift: Mapping[str, SiftOption],
    run: RunContext,
) -> dict[str, Json]:
    """Let workers do chunks, and enter their rows in order."""
    place, label = run.workspace, "matching" if tables is MATCHES else "features"
    folder, in_force = place.sift_rows, dict[str, Json]()
    shutil.rmtree(folder, ignore_errors=True)
    if not parts:
        return in_force
    inputs = _write_inputs(folder, sift, run, with_features=tables is MATCHES)
    run.progress.start(label, sum(len(part) for part in parts))
    try:
        for found in ordered_map(run.executor, prepare(inputs), parts, ahead=run.workers):
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
