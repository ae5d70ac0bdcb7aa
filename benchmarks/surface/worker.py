"""Run one stage of the program in a process of its own.

    python -m benchmarks.surface.worker PHOTOS OUT FIRST LAST SETTINGS

The memory of the process is then that of the stage. Without FIRST, up-to-date stages are not run again.
"""

import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from subprocess import run as run_process
from typing import Any

from benchmarks.common.memory import peak_mb
from benchmarks.common.processes import environment, module_command

WORKER = "benchmarks.surface.worker"
RESULT = "surface-{stage}.json"
"""File in OUT with the process's report on a stage."""


@dataclass(frozen=True, slots=True)
class StageCost:
    """The cost of a stage, or why it failed."""

    failed: str
    """Why there is no result; empty where there is one."""
    seconds: float | None
    """Seconds of the stage, as in the manifest."""
    peak_mb: int | None


def run_stages(
    photos: Path, out: Path, stages: Sequence[str], settings: Mapping[str, Any], again: Sequence[str] = ()
) -> dict[str, StageCost]:
    """Run the program stage by stage, and stop where one fails.

    Args:
        photos: folder with photos.
        out: output folder.
        stages: each run goes up to this stage, and so includes missing stages before it.
        settings: settings that differ from the defaults.
        again: stages to run again even if they are up to date; of the others, the last report is read.
    """
    found: dict[str, StageCost] = {}
    for stage in stages:
        first, path = stage if stage in again else "", out / RESULT.format(stage=stage)
        before = path.stat().st_mtime if path.exists() else 0.0
        command = module_command(WORKER, str(photos), str(out), first, stage, json.dumps(settings))
        done = run_process(command, capture_output=True, text=True, check=False, env=environment())
        if not path.exists() or (done.returncode and path.stat().st_mtime == before):
            last = done.stderr.strip().splitlines()[-1:] or ["no output on stderr"]
            found[stage] = StageCost(f"{stage}: exit code {done.returncode}: {last[0]}", None, None)
        else:
            found[stage] = StageCost(**json.loads(path.read_text(encoding="utf-8")))
        if found[stage].failed:
            break
    return found


def main() -> None:
    import sfm_app

    photos, out, first, last, text = sys.argv[1:]
    manifest, failed, start = Path(out) / "manifest.json", "", time.time()
    try:
        sfm_app.reconstruct(photos, out, sfm_app.Settings.from_mapping(json.loads(text)), first=first, last=last)
    except sfm_app.SfmError as error:
        failed = f"{last}: {error}"
    # a stage that was up to date keeps the report of its last run
    redone = failed or manifest.stat().st_mtime >= start - 1.0
    path = Path(out) / RESULT.format(stage=last)
    if redone or not path.exists():
        stages = json.loads(manifest.read_text(encoding="utf-8"))["stages"] if manifest.exists() else {}
        said = {
            "failed": failed,
            "seconds": stages.get(last, {}).get("seconds"),
            "peak_mb": peak_mb() if redone else None,
        }
        path.write_text(json.dumps(said), encoding="utf-8")


if __name__ == "__main__":
    main()
