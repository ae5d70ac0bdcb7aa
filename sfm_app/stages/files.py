"""files: Model -> model.ply, model.glb."""

from pathlib import Path

from sfm_app.formats.exporters import JPEG_QUALITY
from sfm_app.frame.scale import MetricFrame, move_model
from sfm_app.runtime.context import RunContext
from sfm_app.types import Model

NAME = "model"


def make(model: Model, frame: MetricFrame, run: RunContext) -> tuple[Path, ...]:
    """Write the finished model in every standard format; the last one is the one to open."""
    paths = run.write_model(move_model(model, frame.from_model), NAME)
    if model.texture is not None:
        sizes = [[page.shape[1], page.shape[0]] for page in model.texture.pages]
        run.record(pages_px=sizes, jpeg_quality=JPEG_QUALITY)
    return paths
