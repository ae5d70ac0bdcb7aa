"""Check that our model files open in several viewers and look right. One row per GLB.

    python -m benchmarks.viewers OUT OUT
    python -m benchmarks.viewers OUT OUT --pictures

Runs the Khronos validator and three.js in headless Chromium (benchmarks/viewers, needs Node and `npm install` there),
Open3D and trimesh on the output of finished runs and on a small model with two pages of texture whose colors are
known. With --pictures, a screenshot of each model goes to benchmarks/results/viewers-NAME.png, to be looked at.
"""

import argparse
import json
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from benchmarks.common.command_line import add_pictures, is_wanted, new_parser
from benchmarks.common.results import RESULTS, document, table, write
from sfm_app.colmap.model import sparse_model
from sfm_app.formats import EXPORTERS
from sfm_app.formats.frusta import scene_size
from sfm_app.meshing.ray_casting import load_open3d
from sfm_app.types import Model, PosedPhoto, Surface, Texture

Row = dict[str, Any]

BROWSER = Path(__file__).parent
SAMPLE = "sample"
PAGES = ((200, 90, 60), (40, 90, 200))
"""sRGB colors of the sample's pages."""
ABOUT = """\
Every GLB through the Khronos validator, three.js in headless Chromium, Open3D and trimesh; the surface as its PLY has
it. on screen: share of the picture that the model covers. outward: share of the vertices whose normal looks at a
camera; 1 for a closed surface whose volume is positive. double edges: with more than two triangles; open edges: with
one. off center: distance of the surface's middle (median over its area) from 0, in sizes of the scene. up +- deg:
standard deviation of up, up odds: odds to one against a model on its head or side, both as their evidence has it and
no proof. photos turned: by how many degrees clockwise the program believes that the photos have to be turned; wrong
where people who look at them say otherwise. ok: names what is not as it should be."""
FILES = (
    "file", "MB", "triangles", "points", "pages", "errors", "warnings", "on screen", "three.js", "Open3D", "trimesh",
    "ok",
)  # fmt: skip
SURFACES = (
    "file", "triangles", "not finite", "degenerate", "double edges", "open edges", "outward", "off center", "up by",
    "up +- deg", "up odds", "photos turned", "ok",
)  # fmt: skip

LIMITS = {"outward": 0.95, "off center": 0.2, "up +- deg": 3.0, "up odds": 20.0, "on screen": 0.002}
TURNED_DEG = {"temple16": 270}
"""By run: the clockwise turn that makes its photos upright, judged by eye; photos of other runs are upright."""


@dataclass(frozen=True, slots=True)
class Subject:
    """One GLB, with its PLY, cameras and orientation."""

    name: str
    glb: Path
    ply: Path
    cameras: tuple[PosedPhoto, ...] = ()
    orientation: Mapping[str, Any] | None = None
    run: str = ""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("viewers", __doc__)
    parser.add_argument("runs", nargs="*", type=Path, metavar="OUT", help="output folders of finished runs")
    parser.add_argument("--results", type=Path, default=RESULTS, help="where tables and screenshots go")
    add_pictures(parser, "models, each named like its run")
    return parser


def main() -> int:
    """Check all models, write the results, and return exit code 0 if all are fine, else 1."""
    options = parser().parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        subjects = gather(options.runs, Path(scratch))
        seen = check_in_browser(Path(scratch))
        rows = [check_model(subject, seen[subject.name]) for subject in subjects]
        drawn = [subject for subject in subjects if is_wanted(options.pictures, subject.name)]
        for subject in drawn:
            picture = Image.open(subject.glb.with_suffix(".png")).convert("RGB")
            picture.save(options.results / f"viewers-{subject.name}.png", optimize=True)
    packages = json.loads((BROWSER / "package.json").read_text(encoding="utf-8"))["dependencies"]
    found = document("viewers", ABOUT, {"packages": packages, "limits": LIMITS}, {"browser": seen["browser"]}, rows)
    text = markdown(rows, [subject.name for subject in drawn])
    write(options.results, "viewers", found, text)
    print(text)
    return 0 if all(row["ok"] == "yes" for row in rows) else 1


def gather(runs: Sequence[Path], place: Path) -> list[Subject]:
    """Copy the GLBs of all runs and the sample into one folder under distinct names."""
    files = {**EXPORTERS["glb"].write(sample_model(), SAMPLE), **EXPORTERS["ply"].write(sample_model(), SAMPLE)}
    for name, data in files.items():
        (place / name).write_bytes(data)
    found = [Subject(SAMPLE, place / f"{SAMPLE}.glb", place / f"{SAMPLE}.ply")]
    for run in runs:
        stages = json.loads((run / "manifest.json").read_text(encoding="utf-8"))["stages"]
        cameras, orientation = sparse_model(run / "sparse").cameras, stages["scene"]["counts"]["orientation"]
        for kind, name in (("model", run.name), ("points", f"{run.name}-points")):
            if (run / f"{kind}.glb").exists():
                copy = shutil.copyfile(run / f"{kind}.glb", place / f"{name}.glb")
                found.append(Subject(name, copy, run / f"{kind}.ply", cameras, orientation, run.name))
    return found


def sample_model() -> Model:
    """Make a ball with its upper half on one page of texture and its lower half on another, each of one color."""
    mesh = trimesh.creation.icosphere(subdivisions=4)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces, np.int64)
    corners = vertices[faces]
    page = (corners[:, :, 1].mean(axis=1) < 0).astype(np.int32)
    pages = tuple(np.full((256, 512, 3), color, np.uint8) for color in PAGES)
    uv = (0.5 + 0.48 * corners[:, :, [0, 2]]).astype(np.float32)
    return Model(Surface(vertices, faces, np.full(vertices.shape, 128, np.uint8)), Texture(uv, page, pages))


def check_in_browser(place: Path) -> dict[str, Any]:
    """Return what validator and three.js report on every GLB in a folder; screenshots are written beside them."""
    command = ["node", str(BROWSER / "check.mjs"), str(place)]
    found: dict[str, Any] = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
    return found


def check_model(subject: Subject, seen: Mapping[str, Any]) -> Row:
    """Return the row of one GLB: what the readers find, and its faults."""
    three, validator = seen["three"], seen["validator"]
    readers = {"Open3D": count_in_open3d(subject.glb), "trimesh": count_in_trimesh(subject.glb)}
    surface = surface_figures(subject)
    row: Row = {
        "method": "sfm-app",
        "file": subject.name,
        "MB": round(subject.glb.stat().st_size / 1e6, 2),
        "triangles": three["triangles"],
        "points": three["points"],
        "pages": three["textures"],
        "errors": validator["errors"],
        "warnings": validator["warnings"],
        "on screen": round(three["covered"], 3),
        "three.js": "; ".join(three["said"]) or "silent",
        **{reader: " + ".join(f"{count} {what}" for what, count in got.items()) for reader, got in readers.items()},
        **surface,
    }
    row["ok"] = "; ".join(faults(subject, seen, readers, row)) or "yes"
    return row


def faults(subject: Subject, seen: Mapping[str, Any], readers: Mapping[str, Mapping[str, int]], row: Row) -> list[str]:
    """List the faults of a model."""
    three, validator = seen["three"], seen["validator"]
    triangles = {three["triangles"], validator["triangles"], row.get("surface triangles", 0)}
    triangles |= {got.get("triangles", 0) for got in readers.values()}
    tests = {
        "the validator objects: " + "; ".join(validator["messages"]): validator["errors"] + validator["warnings"],
        "three.js complains": row["three.js"] != "silent",
        "nothing to see": row["on screen"] < LIMITS["on screen"],
        "readers count other triangles": len(triangles) > 1,
        "Open3D misses pages": readers["Open3D"].get("pages", 0) != three["textures"],
        "not finite": row["not finite"] or not three["finite"],
        "degenerate triangles": row.get("degenerate"),
        "not manifold": row.get("double edges"),
        "normals": row.get("outward", 1.0) < LIMITS["outward"],
        "off center": row.get("off center", 0.0) > LIMITS["off center"],
        "vertical not sure": row.get("up +- deg", 0.0) > LIMITS["up +- deg"],
        "up not sure": row.get("up odds", np.inf) < LIMITS["up odds"],
        "on its head or side": row.get("photos turned", 0) != TURNED_DEG.get(subject.run, 0),
        "other colors": subject.name == SAMPLE and not has_page_colors(three["most"]),
    }
    return [what for what, fault in tests.items() if fault]


def has_page_colors(most: Sequence[int]) -> bool:
    """Return whether the two colors that cover most are those of the sample's pages, neither lit nor too dark."""
    colors = sorted((value >> 16, value >> 8 & 255, value & 255) for value in most)
    return bool(np.abs(np.array(colors) - np.array(sorted(PAGES))).max() <= 3)


def count_in_open3d(path: Path) -> dict[str, int]:
    """Count what Open3D finds in a GLB; it does not read points from one."""
    model = load_open3d().io.read_triangle_model(str(path))
    triangles = sum(len(part.mesh.triangles) for part in model.meshes)
    return {"triangles": triangles, "pages": sum(part.albedo_img is not None for part in model.materials)}


def count_in_trimesh(path: Path) -> dict[str, int]:
    """Count what trimesh finds in a GLB."""
    found: dict[str, int] = {}
    for part in trimesh.load_scene(path, process=False).geometry.values():
        what = {"Trimesh": "triangles", "PointCloud": "points"}.get(type(part).__name__, "lines")
        count = (
            len(part.faces) if what == "triangles" else len(part.vertices) if what == "points" else len(part.entities)
        )
        found[what] = found.get(what, 0) + count
    return found


def surface_figures(subject: Subject) -> Row:
    """Measure the surface, as Open3D reads it from the PLY."""
    mesh = load_open3d().io.read_triangle_mesh(str(subject.ply))
    vertices, faces, normals = (np.asarray(part) for part in (mesh.vertices, mesh.triangles, mesh.vertex_normals))
    row: Row = {"not finite": int((~np.isfinite(np.concatenate([vertices, normals]))).any(axis=1).sum())}
    if subject.orientation:
        found = subject.orientation
        row |= {"up by": found["up"], "up +- deg": found["up_deviation_deg"]}
        row |= {"up odds": min(found["up_sign_odds"], found["up_axis_odds"])}
        row |= {"photos turned": found["photos_turned_deg"]}
    if not len(faces):
        return row
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, shared = np.unique(edges, axis=0, return_counts=True)
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    volume = np.sum(np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2])
    closed = bool((shared == 2).all())
    outward = float(volume > 0) if closed else facing_share(vertices, normals, subject.cameras)
    return row | {
        "surface triangles": len(faces),
        "off center": round(center_offset(corners, area) / scene_size(vertices), 3),
        "degenerate": int((area == 0).sum()),
        "double edges": int((shared > 2).sum()),
        "open edges": int((shared == 1).sum()),
        "outward": round(outward, 4),
    }


def center_offset(corners: np.ndarray, area: np.ndarray) -> float:
    """Return the distance from 0 to the middle of the surface, the median of its area along each axis."""
    middle = []
    for values in corners.mean(axis=1).T:
        order = np.argsort(values)
        total = np.cumsum(area[order])
        middle.append(values[order][np.searchsorted(total, total[-1] / 2)])
    return float(np.linalg.norm(middle))


def facing_share(vertices: np.ndarray, normals: np.ndarray, cameras: Sequence[PosedPhoto]) -> float:
    """Return the share of the vertices whose normal faces one of the cameras."""
    looks = np.zeros(len(vertices), bool)
    for camera in cameras:
        looks |= np.sum((camera.center - vertices) * normals, axis=1) > 0
    return float(looks.mean())


def markdown(rows: Sequence[Row], drawn: Sequence[str] = ()) -> str:
    """Return the page, with the pictures that were drawn."""
    files = table(rows, FILES)
    surfaces = table([row for row in rows if row.get("surface triangles")], SURFACES)
    parts = [f"# Model files in viewers\n\n{ABOUT}\n\n## Files\n\n{files}", f"## Surfaces\n\n{surfaces}"]
    if drawn:
        parts.append("".join(f"![{name}](viewers-{name}.png)\n" for name in drawn))
    return "\n".join(parts)
