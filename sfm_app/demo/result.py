"""How close a demo came, in figures and in lines of text."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sfm_app.api import Run
from sfm_app.report.words import duration_text
from sfm_app.synthetic.cameras import camera_center
from sfm_app.synthetic.compare import (
    center_error_percent,
    focal_error_percent,
    surface_accuracy,
    surface_coverage,
    surface_error,
)
from sfm_app.synthetic.photo_folder import Truth
from sfm_app.types import Model, Scene


@dataclass(frozen=True, slots=True)
class DemoResult:
    """How close the reconstruction of the demo scene came."""

    photos: int
    registered: int
    true_K: list[list[float]]
    found_K: list[list[float]]
    """From the photos alone, before bundle adjustment."""
    refined_K: list[list[float]]
    focal_error_percent: float
    refined_focal_error_percent: float
    center_error_percent: float
    refined_center_error_percent: float
    surface_error_percent: float
    """Median distance of the mesh to the true surface, in percent of the scene's size."""
    surface_accuracy_percent: float
    """Share of the mesh within 0.5 % of the scene's size of the true surface."""
    surface_coverage_percent: float
    """Share of what the photos see that the mesh covers within 1 % of the scene's size."""
    triangles: int
    pages_px: list[list[int]]
    """Width and height of each page of texture."""
    seconds_rendering: float
    seconds_reconstruction: float
    files: list[str]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)


def evaluate(run: Run, scene: Scene, model: Model, truth: Truth, seconds: tuple[float, float], out: Path) -> DemoResult:
    """Measure how close the reconstruction came to the ground truth.

    Args:
        run: the finished run.
        scene: its cameras and poses.
        model: its surface and texture.
        truth: the rendered scene.
        seconds: spent on rendering, and on the reconstruction.
        out: output folder.
    """
    refined = next(iter(scene.cameras.values())).K
    found = run.calibration.K if run.calibration else refined
    centers = {name: camera_center(pose) for name, pose in scene.cam_from_world.items()}
    surface, pages = model.surface, model.texture.pages if model.texture else ()
    reports = [run.report_path] if run.report_path is not None else []
    found_surface = surface.vertices, surface.faces, centers, truth
    return DemoResult(
        photos=len(truth.cam_from_world),
        registered=len(scene.registered),
        true_K=truth.K.tolist(),
        found_K=found.tolist(),
        refined_K=refined.tolist(),
        focal_error_percent=round(focal_error_percent(found, truth), 3),
        refined_focal_error_percent=round(focal_error_percent(refined, truth), 3),
        center_error_percent=round(center_error_percent(found, truth), 3),
        refined_center_error_percent=round(center_error_percent(refined, truth), 3),
        surface_error_percent=round(100 * surface_error(*found_surface), 3),
        surface_accuracy_percent=round(100 * surface_accuracy(*found_surface), 1),
        surface_coverage_percent=round(100 * surface_coverage(*found_surface), 1),
        triangles=len(surface.faces),
        pages_px=[[page.shape[1], page.shape[0]] for page in pages],
        seconds_rendering=round(seconds[0], 1),
        seconds_reconstruction=round(seconds[1], 1),
        files=[str(path) for path in (*reports, *sorted(run.out.glob("model.*")), out / "model.png")],
    )


def demo_lines(result: DemoResult) -> list[str]:
    """Return the result as lines of text."""
    placed = "all" if result.registered == result.photos else f"{result.registered} of"
    seconds = result.seconds_reconstruction, result.seconds_rendering
    shown = [path for path in result.files if path.endswith((".html", ".glb"))]
    return [
        f"camera      true   {k_text(result.true_K)}",
        f"            found  {k_text(result.refined_K)}   {result.refined_focal_error_percent:.2g} % off",
        f"mesh        of {placed} {result.photos} photos, {result.triangles:,} triangles: "
        f"{result.surface_accuracy_percent} % within 0.5 % of the scene's size "
        f"of the truth, {result.surface_coverage_percent} % of what the photos see",
        f"took        {duration_text(seconds[0])}, and {duration_text(seconds[1])} to render the photos",
        *(f"{'' if number else 'open':12}{path}" for number, path in enumerate(shown)),
    ]


def k_text(K: list[list[float]]) -> str:
    """Return a camera matrix in one line."""
    return f"fx {K[0][0]:7.2f}  fy {K[1][1]:7.2f}  cx {K[0][2]:7.2f}  cy {K[1][2]:7.2f}"
