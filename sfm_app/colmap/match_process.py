"""COLMAP's matching of some pairs on one thread; see `part_databases.match_chunk_apart`."""

from pathlib import Path

from sfm_app.colmap.features import SiftInputs, match_chunk
from sfm_app.colmap.worker_process import MatchTask, ProgressReporter, report, serve
from sfm_app.settings import MatchSettings


def work(task: MatchTask) -> None:
    """Match the pairs, and report where their rows are."""
    folder, options = Path(task["folder"]), MatchSettings.model_validate(task["options"])
    inputs = SiftInputs(
        Path(task["snapshot"]),
        Path(task["features"]),
        Path(task["photos"]),
        None,
        options,
        task["sift"],
        folder,
        folder,
    )
    part = match_chunk(inputs, [(int(a), int(b)) for a, b in task["pairs"]], ProgressReporter())
    report(path=str(part.path), in_force=dict(part.in_force))


if __name__ == "__main__":
    serve(work)
