"""Light models with normal maps: how far they are shaded from the fine surface that the maps were baked from.

python -m benchmarks.surface.normal_map DATA --sets fountain-P11 castle-P19 --cache CACHE
python -m benchmarks.surface.normal_map DATA --sets fountain-P11 --cache CACHE --pictures
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.cameras.bars import Bar, upper_bound
from benchmarks.common.command_line import (
    add_pictures,
    add_results,
    add_settings,
    is_wanted,
    merge_assignments,
    new_parser,
)
from benchmarks.common.results import Row, document, table, write
from benchmarks.surface.bars import bar_rows
from benchmarks.surface.lit_model import LitPart, angles_deg, read_lit
from benchmarks.surface.measure import cost
from benchmarks.surface.photos import placed_photo, placed_photos
from benchmarks.surface.pictures import save_page
from benchmarks.surface.sets import dense_stages, surface_set
from benchmarks.surface.worker import run_stages
from sfm_app.files import load_arrays
from sfm_app.geometry.poses import normalize
from sfm_app.geometry.triangles import vertex_normals
from sfm_app.products import read_frame
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import merge_nested
from sfm_app.synthetic.render import cast_rays, ray_caster

FloatArray = NDArray[np.float64]

LIGHT: Mapping[str, Any] = {"mesh": {"faces": 50_000}, "texture": {"normal_map": True}}
"""Settings of a light model for the web."""
STEP = 3
"""Every so many pixels of a photo, along both sides, one is compared. Chosen by hand."""
SAME_PLACE = 0.01
"""Relative difference in depth within which a pixel shows the same place of both surfaces: that of depth maps."""
LAMP = normalize([-1.0, -0.35, -0.45])
"""Direction to the lamp of the pictures, in the camera's frame: from the left, at a low angle."""
AMBIENT, WHITE, NOTHING = 0.12, 235.0, 255.0
CROP = 0.3
"""Share of a photo that pictures leave out on each side. Chosen by hand."""
BARS: Mapping[str, tuple[Bar, ...]] = {"fountain-P11": (upper_bound("mean deg", 8.0),)}
ABOUT = (
    "Runs with at most 50 000 triangles and a normal map; model.glb is read back. In the cameras of the photos, at "
    "every third pixel in both directions, the normal that three.js shades the light model with is compared with the "
    "normal of the refined surface before simplification, interpolated between its vertices. A pixel counts where both "
    "surfaces lie at the same depth within 1 %; elsewhere: pixels that show both, at other depths. mean, median, 95 %: "
    "of the angles over the pixels of all photos; bare: without the map; MikkTSpace: with frames as MikkTSpace "
    "interpolates them. baked: share of the texels of charts that the fine surface determines."
)
COLUMNS = (
    "photos", "placed", "triangles", "fine triangles", "mean deg", "median deg", "95 % deg", "bare mean deg",
    "bare median deg", "bare 95 % deg", "MikkTSpace mean deg", "elsewhere %", "baked %", "kB glb", "seconds together",
    "s of texture",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """A light model and its fine surface, in the frame of the export, prepared for ray casting."""

    parts: Sequence[LitPart]
    light: Any
    first: NDArray[np.int64]
    """(P + 1,) number of the first triangle of each part, and of all triangles."""
    fine: Any
    fine_faces: NDArray[np.int64]
    fine_normals: FloatArray

    @classmethod
    def from_run(cls, out: Path) -> "Pair":
        """Read what a run has left."""
        parts, frame = read_lit((out / "model.glb").read_bytes()), read_frame(Workspace(out)).from_model
        count = np.cumsum([0, *(len(part.vertices) for part in parts)])
        faces = np.concatenate([part.faces + start for part, start in zip(parts, count[:-1], strict=True)])
        stored = load_arrays(Workspace(out).fine_surface)
        vertices, fine_faces = frame(stored["vertices"].astype(np.float64)), stored["faces"].astype(np.int64)
        return cls(
            parts,
            ray_caster(np.concatenate([part.vertices for part in parts]), faces),
            np.cumsum([0, *(len(part.faces) for part in parts)]),
            ray_caster(vertices, fine_faces),
            fine_faces,
            vertex_normals(vertices, fine_faces),
        )

    def light_normals(self, hits: Mapping[str, NDArray[Any]], *, mapped: bool, mikk: bool = False) -> FloatArray:
        """Return (N, 3) the normals that the light model is shaded with at hits of rays, all of them on it."""
        face, shares = _places(hits)
        part_of, found = np.searchsorted(self.first, face, "right") - 1, np.empty((len(face), 3))
        for number, part in enumerate(self.parts):
            own = part_of == number
            if own.any():
                at = face[own] - self.first[number]
                found[own] = part.shading_normals(at, shares[own], mapped=mapped, mikk=mikk)
        return found

    def true_normals(self, hits: Mapping[str, NDArray[Any]]) -> FloatArray:
        """Return (N, 3) the interpolated normals of the fine surface at hits of rays, all of them on it."""
        face, shares = _places(hits)
        return normalize((shares[:, :, None] * self.fine_normals[self.fine_faces[face]]).sum(axis=1))


def _places(hits: Mapping[str, NDArray[Any]]) -> tuple[NDArray[np.int64], FloatArray]:
    """Return the triangles (N,) that rays hit, and barycentric coordinates (N, 3) there."""
    second = hits["primitive_uvs"].astype(np.float64)
    shares = np.concatenate([1.0 - second.sum(axis=1, keepdims=True), second], axis=1)
    return hits["primitive_ids"].astype(np.int64), shares


def _select(hits: Mapping[str, NDArray[Any]], keep: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
    return {name: values[keep] for name, values in hits.items()}


def rays_of_photo(out: Path, name: str) -> tuple[FloatArray, FloatArray]:
    """Return center (3,) and rays (H, W, 3) of a photo in the frame of the export."""
    photo, frame = placed_photo(out, name), read_frame(Workspace(out)).from_model
    return frame(photo.center[None])[0], photo.rays @ frame.R.T


def compare(pair: Pair, out: Path, names: Sequence[str]) -> Row:
    """Return the angles between the shading of the light model and the fine surface, over the pixels of all photos."""
    angles: dict[str, list[FloatArray]] = {"": [], "bare ": [], "MikkTSpace ": []}
    shown = elsewhere = 0
    for name in names:
        center, rays = rays_of_photo(out, name)
        some = rays[STEP // 2 :: STEP, STEP // 2 :: STEP].reshape(-1, 3)
        light, fine = (cast_rays(scene, center, some) for scene in (pair.light, pair.fine))
        both = np.isfinite(light["t_hit"]) & np.isfinite(fine["t_hit"])
        light, fine = _select(light, both), _select(fine, both)
        same = np.abs(light["t_hit"] / fine["t_hit"] - 1.0) <= SAME_PLACE
        shown, elsewhere = shown + len(same), elsewhere + int(np.count_nonzero(~same))
        light, truth = _select(light, same), pair.true_normals(_select(fine, same))
        angles[""].append(angles_deg(pair.light_normals(light, mapped=True), truth))
        angles["bare "].append(angles_deg(pair.light_normals(light, mapped=False), truth))
        angles["MikkTSpace "].append(angles_deg(pair.light_normals(light, mapped=True, mikk=True), truth))
    row: Row = {"elsewhere %": round(100.0 * elsewhere / max(shown, 1), 2)}
    for what, found in angles.items():
        every = np.concatenate(found)
        row |= {
            f"{what}mean deg": round(float(every.mean()), 2),
            f"{what}median deg": round(float(np.median(every)), 2),
        }
        row[f"{what}95 % deg"] = round(float(np.percentile(every, 95)), 2)
    return row


def shaded_page(pair: Pair, out: Path, name: str) -> NDArray[np.uint8]:
    """Return pictures one below the other under a low lamp: the bare light model, with its map, the fine surface."""
    center, rays = rays_of_photo(out, name)
    height, width = (int(CROP * size) for size in rays.shape[:2])
    rays = rays[height : rays.shape[0] - height, width : rays.shape[1] - width]
    image = placed_photos(out)[name]
    frame = read_frame(Workspace(out)).from_model
    lamp = LAMP @ image.cam_from_world().matrix()[:, :3] @ frame.R.T
    light, fine = (cast_rays(scene, center, rays.reshape(-1, 3)) for scene in (pair.light, pair.fine))
    pictures = []
    for hits, find in (
        (light, lambda found: pair.light_normals(found, mapped=False)),
        (light, lambda found: pair.light_normals(found, mapped=True)),
        (fine, pair.true_normals),
    ):
        there = np.isfinite(hits["t_hit"])
        shade = np.full(len(there), NOTHING)
        facing = np.maximum(find(_select(hits, there)) @ lamp, 0.0)
        shade[there] = WHITE * (AMBIENT + (1.0 - AMBIENT) * facing)
        pictures.append(shade.reshape(rays.shape[:2]))
    return np.repeat(np.concatenate(pictures).astype(np.uint8)[..., None], 3, axis=2)


def measure(name: str, cache: Path, args: argparse.Namespace) -> Row:
    """Run the program on a set, and compare its light model with its fine surface."""
    photos, out = surface_set(name, args.data, cache), cache / "normal_map" / name
    settings = merge_nested(LIGHT, args.settings)
    said = run_stages(photos.photos, out, ("scene", *dense_stages()), settings)
    row: Row = {"photos": name, "method": "sfm-app", **cost(said), "of": photos.count}
    if row["failed"]:
        return row
    stages = json.loads((out / "manifest.json").read_text(encoding="utf-8"))["stages"]
    pair, names = Pair.from_run(out), list(placed_photos(out))
    row |= {"placed": len(names), "triangles": int(pair.first[-1]), "fine triangles": len(pair.fine_faces)}
    row |= compare(pair, out, names)
    row["baked %"] = round(100.0 * stages["texture"]["counts"]["normal_map_share"], 1)
    row["kB glb"] = (out / "model.glb").stat().st_size // 1000
    if is_wanted(args.pictures, name):
        save_page(shaded_page(pair, out, names[len(names) // 2]), args.results / f"{args.name}-{name}.png")
    return row


def page(rows: Sequence[Row], drawn: Mapping[str, str]) -> str:
    """Return the page: bars first, then all figures, then the pictures."""
    asked = bar_rows(rows, BARS)
    parts = [f"# Light models with normal maps\n\n{ABOUT}\n"]
    parts += [f"## Asked and measured\n\n{table(asked)}"] if asked else []
    parts.append(f"## Figures\n\n{table(rows, [name for name in COLUMNS if any(name in row for row in rows)])}")
    if drawn:
        parts.append(
            "## Pictures\n\nThe bare light model, the one with its map, and the fine surface, under a low lamp.\n"
        )
    return "\n".join([*parts, *(f"![{name}]({file})" for name, file in drawn.items()), ""])


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("surface.normal_map", __doc__)
    parser.add_argument("data", type=Path, nargs="?", help="folder with NAME/images; rendered scenes need none")
    parser.add_argument("--cache", type=Path, help="keeps rendered photos and the runs, which are used again")
    parser.add_argument("--sets", nargs="+", default=["fountain-P11"], help="rendered scenes and names in DATA")
    add_settings(parser)
    add_results(parser, "surface-normal-map")
    add_pictures(parser, "sets")
    return parser


def main() -> None:
    """Measure all sets, and write the results."""
    args = parser().parse_args()
    args.settings = merge_assignments(args.assignments)
    rows = []
    with tempfile.TemporaryDirectory(prefix="normal-map-") as scratch:
        cache = (args.cache or Path(scratch)).resolve()
        for name in args.sets:
            rows.append(measure(name, cache, args))
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    drawn = [row["photos"] for row in rows if not row["failed"] and is_wanted(args.pictures, row["photos"])]
    text = page(rows, {name: f"{args.name}-{name}.png" for name in drawn})
    options = {"settings": merge_nested(LIGHT, args.settings), "step": STEP}
    write(args.results, args.name, document("surface", ABOUT, options, {"sets": list(args.sets)}, rows), text)
    print(text)


if __name__ == "__main__":
    main()
