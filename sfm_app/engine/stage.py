"""A stage, the products of stages, and why a stage has to run again."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Generic, TypeVar, cast

from sfm_app.colmap.backend import versions as colmap_versions
from sfm_app.errors import DamagedProductError, InputError
from sfm_app.files import PROGRAM, fingerprint
from sfm_app.photos.source import Source
from sfm_app.runtime.context import CONTROL_POINTS, GIVEN_CAMERAS, RunContext
from sfm_app.runtime.workspace import Workspace
from sfm_app.wording import list_names

Product = TypeVar("Product")
Product_co = TypeVar("Product_co", covariant=True)


@dataclass(frozen=True, slots=True, eq=False)
class Stage(Generic[Product_co]):
    """One step from photos to mesh."""

    name: str
    takes: tuple["Stage[object]", ...]
    """Stages whose products it needs."""
    settings: tuple[str, ...]
    """Settings, or tables of them, that determine its result."""
    files: tuple[str, ...]
    """Its files and folders in the output folder; nothing else writes them."""
    make: Callable[["Products", RunContext], Product_co]
    load: Callable[["Products", RunContext], Product_co]
    """Reads the product that `make` has written."""
    digest: Callable[[Workspace], str]
    """Hashes the files that `load` reads; checked before reading, because COLMAP hangs on damaged files."""
    grows: bool = False
    """Whether `make` can resume from its product for other photos, see `runtime.context.Earlier`."""

    @property
    def depends_on(self) -> frozenset[str]:
        """Names of all direct and indirect inputs."""
        return frozenset(name for stage in self.takes for name in (stage.name, *stage.depends_on))


class Products:
    """Products by stage; those of skipped stages are loaded on first use."""

    def __init__(self, run: RunContext, source: Source | None = None) -> None:
        self._run, self._source = run, source
        self._known: dict[str, object] = {}

    @property
    def source(self) -> Source:
        """The user's photos or video."""
        if self._source is None:
            raise ValueError("the photos of a finished run are not read again")
        return self._source

    def __getitem__(self, stage: Stage[Product]) -> Product:
        """Return the product of a stage; DamagedProductError if its files have changed, or cannot be read."""
        if stage.name not in self._known:
            with check_undamaged(stage, self._run):
                self._known[stage.name] = stage.load(self, self._run)
        return cast(Product, self._known[stage.name])

    def keep(self, stage: Stage[Product], product: Product) -> None:
        """Keep the new product of a stage."""
        self._known[stage.name] = product


@contextmanager
def check_undamaged(stage: Stage[object], run: RunContext) -> Iterator[None]:
    """Check the files of a stage, and turn errors of reading them in the block into one that names the stage."""
    try:
        record = run.workspace.manifest.record(stage.name)
        if record is None or record.digest != stage.digest(run.workspace):
            raise ValueError(f"the files of stage `{stage.name}` have changed since it wrote them")
        yield
    except InputError:
        raise
    except Exception as err:  # decoders of damaged bytes raise all kinds of errors
        state = f"incomplete: {err.filename} is gone" if isinstance(err, FileNotFoundError) else "damaged"
        message = f"the files of stage `{stage.name}` in {run.workspace.root} are {state}"
        raise DamagedProductError(message, resume_hint(run), stage.name) from err


def resume_hint(run: RunContext) -> str:
    """Return the command that resumes a run."""
    return f"`sfm-app run PHOTOS -o {run.workspace.root}` resumes where it stopped"


PHOTOS_CHANGED = "the photos have changed"


def stage_fingerprint(stage: Stage[object], inputs: Sequence[str], run: RunContext) -> str:
    """Return a hash of everything that determines a stage's result: inputs, settings and versions."""
    return fingerprint(stage.name, settings_and_versions(stage, run), inputs)


def settings_and_versions(stage: Stage[object], run: RunContext) -> dict[str, Any]:
    """Return the values of a stage's settings, and the versions of the program and its libraries."""
    files = {GIVEN_CAMERAS: run.given.digest, CONTROL_POINTS: run.control_points.digest}
    values = run.settings.model_dump() | files
    return {"settings": {key: nested_value(values, key) for key in stage.settings}, "versions": versions()}


def rerun_reason(stage: Stage[object], inputs: str, run: RunContext) -> str | None:
    """Return why a stage with this fingerprint has to run; empty if it never ran, None if it is up to date."""
    record = run.workspace.manifest.record(stage.name)
    if record is None:
        return ""
    if changed := run.workspace.manifest.changed_files(record):
        return f"{changed[0]} is gone or was changed"
    if record.fingerprint == inputs:
        return None
    changes = list(_changes(record.made_with, json.loads(json.dumps(settings_and_versions(stage, run)))))
    return list_names(changes, 3) if changes else PHOTOS_CHANGED


def _changes(before: Any, now: Mapping[str, Any], name: str = "") -> Iterator[str]:
    for key, new in now.items():
        old = before.get(key) if isinstance(before, Mapping) else None
        inner = f"{name}.{key}".removeprefix(".").removeprefix("settings.").removeprefix("versions.")
        if isinstance(new, dict):
            yield from _changes(old, new, inner.removeprefix("settings").removeprefix("versions"))
        elif old != new:
            yield f"{inner} {json.dumps(old)} -> {json.dumps(new)}"


def nested_value(values: Any, key: str) -> Any:
    """Return a value of nested mappings by its dotted name, such as `mesh.faces`; None if there is none."""
    for name in key.split("."):
        values = values.get(name) if isinstance(values, Mapping) else None
    return values


def manifest_head(run: RunContext) -> dict[str, Any]:
    """Return the entries of the manifest other than the stages."""
    return {"program": PROGRAM, "versions": versions(), "settings": run.settings.model_dump()}


@cache
def versions() -> dict[str, str]:
    """Return the versions of the program and of the libraries that compute the result."""
    parts = ("sfm-app", "numpy", "numba", "opencv-contrib-python-headless", "pyproj", "av")
    try:
        open3d = version("open3d-cpu")  # the wheel without CUDA, which few systems have
    except PackageNotFoundError:
        open3d = version("open3d")
    return {name: version(name) for name in parts} | {"open3d": open3d} | colmap_versions()
