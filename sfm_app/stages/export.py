"""files: Model -> model.ply, model.glb."""

from pathlib import Path

from sfm_app.context import RunContext
from sfm_app.formats.pages import JPEG_QUALITY
from sfm_app.types import Model

NAME = "model"


def write_files(model: Model, run: RunContext) -> tuple[Path, ...]:
    """Write the finished model in every standard format; the last one is the one to open."""
    paths = run.write_model(model, NAME)
    if model.texture is not None:
        sizes = [[page.shape[1], page.shape[0]] for page in model.texture.pages]
        run.record(pages_px=sizes, jpeg_quality=JPEG_QUALITY)
    return paths


def load_files(run: RunContext) -> tuple[Path, ...]:
    """Return paths of the files that are there."""
    return run.model_paths(NAME)
