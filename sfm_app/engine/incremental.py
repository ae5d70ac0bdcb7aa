"""Photos that come and go: the files of a finished run are set aside for the stages that resume from them.

The files move to OUT/.earlier, with their own manifest, before the first stage that takes the photos runs again. They
stay there until all stages that could resume are finished, so that a killed run starts again at the same point.
"""

import json
import logging
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import takewhile

from sfm_app.engine.stage import Stage, settings_and_versions
from sfm_app.files import fingerprint
from sfm_app.operating_system import move
from sfm_app.runtime.context import Earlier, RunContext, split_names
from sfm_app.runtime.workspace import StageRecord

logger = logging.getLogger("sfm_app")


def set_aside(stages: Sequence[Stage[object]], run: RunContext) -> None:
    """Move the files of finished stages aside, unless those of a more complete run are there already."""
    manifest, place = run.workspace.manifest, run.workspace.earlier
    growing = [stage.name for stage in stages if stage.grows]
    finished = list(takewhile(lambda name: manifest.record(name) is not None, growing))
    if not finished or len(place.manifest.read().get("stages", {})) > len(finished):
        return
    shutil.rmtree(place.root, ignore_errors=True)
    place.root.mkdir()
    whole = manifest.read()
    place.manifest.write(whole | {"stages": {name: whole["stages"][name] for name in finished}})
    manifest.forget(tuple(stage.name for stage in stages))


def find_earlier(
    stages: Sequence[Stage[object]], photos: Mapping[str, str], first: str, run: RunContext
) -> Earlier | None:
    """Return the earlier run to resume from; if its files are not usable, remove them and return None."""
    place = run.workspace.earlier
    if not place.root.is_dir():
        return None
    _move_files(stages, run)
    growing = (stage for stage in _stages_before(first, stages) if stage.grows)
    usable = list(takewhile(lambda stage: _is_usable(stage, run), growing))
    if not usable:
        forget_earlier(run)
        return None
    records = [record for stage in usable if (record := place.manifest.record(stage.name)) is not None]
    made_from = fingerprint([record.fingerprint for record in records])
    return Earlier(place, tuple(stage.name for stage in usable), made_from, *split_names(records[0].photos, photos))


def forget_earlier(run: RunContext, *, if_finished: bool = False) -> None:
    """Remove the files set aside; with `if_finished` only when this run has finished all their stages."""
    here, there = (place.manifest.read().get("stages", {}) for place in (run.workspace, run.workspace.earlier))
    if not if_finished or here.keys() >= there.keys():
        shutil.rmtree(run.workspace.earlier.root, ignore_errors=True)


def _stages_before(first: str, stages: Sequence[Stage[object]]) -> Sequence[Stage[object]]:
    """Return the stages before `first`: all for an empty name, none for the photos stage."""
    names = [stage.name for stage in stages]
    return stages if not first else stages[: names.index(first)] if first in names else ()


def _move_files(stages: Sequence[Stage[object]], run: RunContext) -> None:
    """Move the files of the stages set aside, unless they have moved already."""
    place, here = run.workspace.earlier, run.workspace
    listed = place.manifest.read().get("stages", {})
    for stage in stages:
        if stage.name in listed and here.manifest.record(stage.name) is None:
            for name in stage.files:
                if not (place.root / name).exists():
                    with suppress(FileNotFoundError):
                        move(here.root / name, place.root / name)


def _is_usable(stage: Stage[object], run: RunContext) -> bool:
    """Return whether a stage set aside had the same settings and versions, and its files are undamaged."""
    place = run.workspace.earlier
    record: StageRecord | None = place.manifest.record(stage.name)
    made_with = json.loads(json.dumps(settings_and_versions(stage, run)))
    if record is None or record.made_with != made_with or place.manifest.changed_files(record):
        return False
    try:
        return record.digest == stage.digest(place)
    except Exception as err:  # decoders of damaged bytes raise all kinds of errors
        logger.info("cannot read the earlier files of stage `%s`", stage.name, exc_info=err)
        return False
