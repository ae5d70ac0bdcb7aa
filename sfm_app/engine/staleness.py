"""What a stage's result depends on (photos, settings, versions), and why a stage has to run again."""

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from sfm_app.colmap.backend import versions as colmap_versions
from sfm_app.engine.stage import Stage
from sfm_app.hashing import fingerprint
from sfm_app.name_lists import list_names
from sfm_app.runtime.context import CONTROL_POINTS, GIVEN_CAMERAS, RunContext
from sfm_app.runtime.manifest import PROGRAM

PHOTOS_CHANGED = "the photos have changed"
CHANGES_SHOWN = 3
"""Most changes that are named."""


def stage_fingerprint(stage: Stage[object], inputs: Sequence[str], run: RunContext) -> str:
    """Return a hash of everything that a stage's result depends on: its inputs, its settings, the versions.

    Args:
        stage: the stage.
        inputs: fingerprints of its inputs.
        run: has the settings.
    """
    return fingerprint(stage.name, settings_and_versions(stage, run), inputs)


def settings_and_versions(stage: Stage[object], run: RunContext) -> dict[str, Any]:
    """Return the values of a stage's settings, and the versions of the program and its libraries.

    Args:
        stage: names the settings it depends on.
        run: has the settings.
    """
    files = {GIVEN_CAMERAS: run.given.digest, CONTROL_POINTS: run.control_points.digest}
    values = run.settings.model_dump() | files
    return {"settings": {key: nested_value(values, key) for key in stage.settings}, "versions": versions()}


def rerun_reason(stage: Stage[object], inputs: str, run: RunContext) -> str | None:
    """Return why a stage has to run; empty if it never ran, None if it is up to date.

    Args:
        stage: the stage.
        inputs: fingerprint of everything that its result depends on now.
        run: the run.
    """
    record = run.workspace.manifest.record(stage.name)
    if record is None:
        return ""
    if changed := run.workspace.manifest.changed_files(record):
        return f"{changed[0]} is gone or was changed"
    if record.fingerprint == inputs:
        return None
    found = list(_changes(record.made_with, json.loads(json.dumps(settings_and_versions(stage, run)))))
    return list_names(found, CHANGES_SHOWN) if found else PHOTOS_CHANGED


def _changes(before: Any, now: Mapping[str, Any], name: str = "") -> Iterator[str]:
    """Yield the values that have changed, with their dotted names."""
    for key, new in now.items():
        old = before.get(key) if isinstance(before, Mapping) else None
        inner = f"{name}.{key}".removeprefix(".").removeprefix("settings.").removeprefix("versions.")
        if isinstance(new, dict):
            yield from _changes(old, new, inner.removeprefix("settings").removeprefix("versions"))
        elif old != new:
            yield f"{inner} {json.dumps(old)} -> {json.dumps(new)}"


def nested_value(values: Any, key: str) -> Any:
    """Return a value of nested mappings by its dotted name; None where there is none.

    Args:
        values: nested mappings.
        key: dotted name, such as `mesh.faces`.
    """
    for name in key.split("."):
        values = values.get(name) if isinstance(values, Mapping) else None
    return values


def manifest_head(run: RunContext) -> dict[str, Any]:
    """Return the entries of the manifest other than the stages."""
    return {"program": PROGRAM, "versions": versions(), "settings": run.settings.model_dump()}


@cache
def versions() -> dict[str, str]:
    """Return the versions of the program and of the libraries that compute the result."""
    parts = ("sfm-app", "numpy", "numba", "opencv-contrib-python-headless")
    return {name: version(name) for name in parts} | {"open3d": _open3d_version()} | colmap_versions()


def _open3d_version() -> str:
    """Return the version of Open3D, whose wheel without CUDA has a name of its own, and which few systems have."""
    try:
        return version("open3d-cpu")
    except PackageNotFoundError:
        return version("open3d")
