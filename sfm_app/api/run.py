"""A finished run in Python: its products, its scene as arrays, and how a notebook shows it."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.plugins import load_plugins
from sfm_app.progress import Callback, Progress, as_progress
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import open_executor
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.types import Intrinsics, Scene, SceneArrays

PathLike = str | os.PathLike[str]


@dataclass(frozen=True, eq=False)
class RunScene(Scene):
    """The sparse reconstruction of a run: summary, cameras, poses; points and tracks once they are asked for."""

    out: Path = Path()
    """Output folder of the run."""

    @cached_property
    def arrays(self) -> SceneArrays:
        """Poses, cameras, points and tracks in the frame of exported files; InputError where the files are gone."""
        from sfm_app.exports.stored import stored_arrays  # loads COLMAP

        with open_run(self.out, Settings(), None) as run:
            return stored_arrays(run)

    @classmethod
    def from_scene(cls, scene: Scene, out: Path) -> "RunScene":
        """Return a scene with the folder that its arrays are read from.

        Args:
            scene: product of the stage.
            out: output folder of the run.
        """
        return cls(**{field.name: getattr(scene, field.name) for field in fields(Scene)}, out=out)


@dataclass(frozen=True, slots=True, repr=False)
class Run:
    """The results of a finished run."""

    out: Path
    calibration: Intrinsics | None
    """K per camera group as found before bundle adjustment; None when the run stopped earlier."""
    scene: RunScene | None
    """The sparse reconstruction with the refined cameras; None when the run stopped earlier."""
    model_dir: Path | None
    """COLMAP's sparse model."""
    mesh_path: Path | None
    """model.glb; model.ply lies beside it."""
    manifest: dict[str, Any]
    """manifest.json, with the stages up to the one where the run stopped."""
    report_path: Path | None = None
    """report.html; None where `report` is off in the settings."""

    def __repr__(self) -> str:
        placed = len(self.scene.registered) if self.scene else 0
        made = self.mesh_path or self.model_dir
        return f"Run({str(self.out)!r}: {placed} photos placed, {made.name if made else 'no model'})"

    def picture(self) -> NDArray[np.uint8] | None:
        """Return a picture (H, W, 4) RGBA of the model, or of its points; None where no photo has a place."""
        from sfm_app.report.notebook import model_cutout
        from sfm_app.report.page.contents import read_scene

        with open_run(self.out, Settings(), None) as run:
            return model_cutout(read_scene(run))

    def _repr_html_(self) -> str:
        """Return a picture of the model and a table of what was found, for notebooks."""
        from sfm_app.report.notebook import run_html
        from sfm_app.report.page.contents import read_contents

        with open_run(self.out, Settings(), None) as run:
            return run_html(read_contents(run))


@contextmanager
def open_run(out: Path, settings: Settings, progress: Progress | Callback | None) -> Iterator[RunContext]:
    """Provide a run with its workers, which stop when the block ends.

    Args:
        out: output folder.
        settings: of the run.
        progress: display of progress, or a function that is called with every `Step`; None for silence.
    """
    plugins = load_plugins(installed=settings.plugins)
    plugins.estimator(settings.epipolar.estimator)  # unknown names are refused before any work is done
    plugins.calibrator(settings.calibration.calibrator)
    plugins.feature_method(settings.matching.features)
    place, shown = Workspace(out), as_progress(progress)
    with open_executor(settings, place.parcels, shown) as (executor, workers):
        yield RunContext(settings, place, plugins, executor, workers, shown)
