"""Outlines of finished models as an eye sees them: borders, holes, fringes at depth edges, speckles, silhouettes.

python -m benchmarks.surface.outlines OUT OUT
python -m benchmarks.surface.outlines CACHE/surface/* --truth CACHE/rendered
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from benchmarks.common.command_line import add_results, new_parser
from benchmarks.common.results import Row, document, table, write
from benchmarks.surface.photos import LEAST_PIXELS, PlacedPhoto, placed_photo, placed_photos
from benchmarks.surface.rendered.truth import sights_of
from sfm_app.products import read_frame, read_texture
from sfm_app.runtime.workspace import Workspace
from sfm_app.synthetic.cameras import Camera, pixel_rays
from sfm_app.synthetic.compare import align_centers
from sfm_app.synthetic.photo_folder import TRUTH_FILE, Truth, load_truth
from sfm_app.synthetic.render import PreparedModel, cast_rays, ray_caster, render_rays
from sfm_app.types import Surface
from sfm_app.types.scene import camera_center
from sfm_app.types.surface import Model

Mask = NDArray[np.bool_]
FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

WIDEST = 1600
"""Width in pixels that wider photos are reduced to, so that limits in pixels mean the same for all cameras."""
SEEN_BY, RIM = 3, 0.03
"""Least number of photos that see a place whose surface is required, and the share of the width at the rim of a photo
where it may end: a surface ends where photos end."""
HIDDEN = 5e-3
"""Share of its distance by which a border may lie behind the first surface on its ray, and still be seen."""
HOLE_PX = 2.0
"""Least side of the square of a hole's area in some photo: a smaller one is not seen."""
JUMP = 0.01
"""Change of the depth from pixel to pixel at a depth edge: a plane has it where it is seen at 4 degrees."""
THING = 0.03
"""The same at the silhouette of a thing before another: the gravel of a path has jumps of 1 %."""
BAND_PX = 3
"""Distance from a depth edge up to which pixels belong to it."""
GAP_PX = 8
"""Half the width of a gap that the model surrounds: it closes with it. Wider ones may show the sky."""
FRINGE, SPECKLE = 10.0, 20.0
"""Difference from the photo, in gray levels, of a fringe at a depth edge, and of a speckle anywhere: there, the grain
of stone alone is off by 10."""
AROUND_PX = 31
"""Width of the window whose median difference excuses sheen: a speckle fills a thirtieth of it."""
SPECKLE_PX = (4, 29)
"""Sizes of speckles in pixels: smaller ones are noise, larger ones wrong parts."""
NEAR_PX = 1.0
"""Distance from a true silhouette at which one is right."""
STEP = 4
"""Distance in pixels of the places that decide what other photos see."""
ABOUT = (
    "Finished models, rendered into the cameras of their photos with four rays a pixel, at 1600 pixels of width or "
    "less. borders: length of the model's borders that three photos see (in the photo, not hidden, not at its rim), as "
    "far as each photo sees them, in photo widths, mean over the photos; holes: closed ones of at least 2 pixels "
    "around nothing; largest hole: square root of its area in the photo that sees it largest. At depth edges: of the "
    "pixels within 3 px of a depth edge or outline of the model, which the model covers or surrounds; open: without "
    "surface, in gaps of at most 16 px; off: more than 10 gray levels from all nine pixels of the photo around, after "
    "a gain and an offset. wrong anywhere: share of pixels that are open or off by more than 20. speckles: patches of "
    "4 to 29 of them, once the median difference of 31 pixels around is taken out, per million pixels of the model. "
    "Silhouettes: the outlines of model and truth, and where their depth jumps by 3 %, in the true camera, once the "
    "mesh is moved onto the truth by the camera centers, near surfaces that three photos see; right: within 1 px of "
    "each other."
)


@dataclass(frozen=True, slots=True, eq=False)
class Borders:
    """Edges that one triangle alone has."""

    ends: FloatArray
    """(E, 2, 3) in the order of the triangle, which lies on their left seen from outside."""
    loop: IndexArray
    """(E,) number of the loop that an edge belongs to."""


def find_borders(surface: Surface) -> Borders:
    """Find the borders of a surface; vertices at the same place are one."""
    places, own = np.unique(surface.vertices.astype(np.float32), axis=0, return_inverse=True)
    edges = own.ravel()[surface.faces][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = edges[edges[:, 0] != edges[:, 1]]
    key = edges.min(axis=1) * len(places) + edges.max(axis=1)
    _, same, count = np.unique(key, return_inverse=True, return_counts=True)
    edges = edges[count[same] == 1]
    links = coo_array((np.ones(len(edges)), edges.T), shape=(len(places), len(places)))
    return Borders(places[edges].astype(np.float64), connected_components(links)[1][edges[:, 0]].astype(np.int64))


def border_scores(model: PreparedModel, photos: Sequence[PlacedPhoto]) -> Row:
    """Return length of borders, and number and size of holes, as far as `SEEN_BY` photos see them."""
    borders = find_borders(model.model.surface)
    _, loop, size = np.unique(borders.loop, return_inverse=True, return_counts=True)
    seen, widths = np.zeros((len(photos), len(loop)), bool), np.zeros((len(photos), len(loop)))
    hole = np.zeros((len(photos), len(size)))
    for k, photo in enumerate(photos):
        ends, inside = _project(photo, borders.ends.reshape(-1, 3))
        ends, inside = ends.reshape(-1, 2, 2), inside.reshape(-1, 2)
        ways = borders.ends.mean(axis=1) - photo.center
        seen[k] = inside.all(axis=1) & (cast_rays(model.rays, photo.center, ways)["t_hit"] > 1.0 - HIDDEN)
        widths[k] = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / photo.camera.width
        # y grows downward: nothing lies on the left of a loop that turns right, so it is a hole
        turn = ends[:, 0, 0] * ends[:, 1, 1] - ends[:, 0, 1] * ends[:, 1, 0]
        area = 0.5 * np.bincount(loop, turn, len(size))
        shown = 2 * np.bincount(loop, seen[k], len(size)) > size
        hole[k] = np.where(shown & np.isfinite(area), np.sqrt(np.maximum(area, 0.0)), 0.0)
    often = seen.sum(axis=0) >= SEEN_BY
    largest = hole.max(axis=0, initial=0.0)
    holes = (largest >= HOLE_PX) & (2 * np.bincount(loop, often, len(size)) > size)
    return {
        "borders, widths": round(float((np.where(seen, widths, 0.0) * often).sum() / max(len(photos), 1)), 3),
        "holes": int(holes.sum()),
        "largest hole px": round(float(largest[holes].max(initial=0.0)), 1),
        "border edges": len(loop),
    }


def _project(photo: PlacedPhoto, points: FloatArray) -> tuple[FloatArray, Mask]:
    """Return the pixels (N, 2) of points (N, 3), nan behind the camera, and whether they lie in the photo."""
    R, t = photo.cam_from_world[:, :3], photo.cam_from_world[:, 3]
    pixels = np.asarray(photo.camera.img_from_cam(points @ R.T + t), np.float64).reshape(-1, 2)
    rim = RIM * photo.camera.width
    size = np.array([photo.camera.width, photo.camera.height])
    return pixels, np.asarray(((pixels > rim) & (pixels < size - rim)).all(axis=1))


def picture_scores(model: PreparedModel, photos: Sequence[PlacedPhoto]) -> Row:
    """Return the shares of open and of wrong pixels at depth edges, and the number of speckles."""
    edge = empty = off = area = wrong = speckles = 0
    for photo in photos:
        colors, covered = render_smoothly(model, photo)
        errors, local = color_errors(colors, covered, photo.pixels)
        surrounded = _closed(covered)
        judged = _grown(depth_edges(cast_depth(model.rays, photo.center, photo.rays)), BAND_PX) & surrounded
        edge += int(judged.sum())
        empty += int((judged & ~covered).sum())
        off += int((judged & (errors > FRINGE)).sum())
        area += int(surrounded.sum())
        wrong += int(((errors > SPECKLE) | (surrounded & ~covered)).sum())
        bad = (local > SPECKLE) | (surrounded & ~covered)
        sizes = cv2.connectedComponentsWithStats(bad.astype(np.uint8), connectivity=8)[2][1:, cv2.CC_STAT_AREA]
        speckles += int(((sizes >= SPECKLE_PX[0]) & (sizes <= SPECKLE_PX[1])).sum())
    return {
        "open %": _percent(empty, edge),
        "off %": _percent(off, edge),
        "open or off %": _percent(empty + off, edge),
        "speckles per MP": round(1e6 * speckles / max(area, 1), 1),
        "wrong anywhere %": _percent(wrong, area),
    }


def render_smoothly(model: PreparedModel, photo: PlacedPhoto) -> tuple[NDArray[np.uint8], Mask]:
    """Return colors (H, W, 3) as means of four rays a pixel, for fine textures, and whether two rays meet the model."""
    down, right = np.gradient(photo.rays, axis=(0, 1))
    total, count = np.zeros(photo.rays.shape), np.zeros(photo.rays.shape[:2])
    for dy, dx in product((-0.25, 0.25), repeat=2):
        picture = render_rays(model, photo.center, photo.rays + dy * down + dx * right)
        total, count = total + picture.colors, count + picture.covered
    return (total / np.maximum(count, 1)[..., None]).astype(np.uint8), np.asarray(count >= 2)


def color_errors(colors: NDArray[np.uint8], covered: Mask, photo: NDArray[np.uint8]) -> tuple[FloatArray, FloatArray]:
    """Return by how many gray levels a rendering (H, W, 3) is off its photo, after a gain and an offset, and locally.

    Both (H, W) are errors to the range of the nine pixels around: they excuse blur, and an edge that lies a pixel
    aside. The second is that of the rendering plus its median difference from the photo around: sheen is excused.
    """
    ours, theirs = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float64) for image in (colors, photo))
    if covered.sum() >= LEAST_PIXELS:
        # what is wrong moves a least-squares fit, but not the shares of dark and bright
        (dark, bright), (low, high) = (np.percentile(gray[covered], (10, 90)) for gray in (ours, theirs))
        ours = low + (ours - dark) * ((high - low) / (bright - dark) if bright > dark else 1.0)
    around = np.ones((3, 3), np.uint8)
    least, most = cv2.erode(theirs, around), cv2.dilate(theirs, around)
    difference = np.where(covered, np.clip(theirs - ours + 127.5, 0.0, 255.0), 127.5).astype(np.uint8)
    sheen = cv2.medianBlur(difference, AROUND_PX).astype(np.float64) - 127.0
    errors, local = (np.maximum(np.maximum(least - own, own - most), 0.0) for own in (ours, ours + sheen))
    return np.where(covered, errors, 0.0), np.where(covered, local, 0.0)


def cast_depth(caster: object, center: FloatArray, rays: FloatArray) -> FloatArray:
    """Return the depth (H, W) along rays (H, W, 3) of depth 1; inf without a surface."""
    return np.asarray(cast_rays(caster, center, rays.reshape(-1, 3))["t_hit"], np.float64).reshape(rays.shape[:2])


def depth_edges(depth: FloatArray, jump: float = JUMP) -> Mask:
    """Return the pixels (H, W) with a neighbor on a surface behind them, or on none, by a jump of the depth."""
    near = 1.0 / depth
    edges = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        a, b = np.moveaxis(near, axis, 0)[:-1], np.moveaxis(near, axis, 0)[1:]
        np.moveaxis(edges, axis, 0)[:-1] |= a - b > jump * a
        np.moveaxis(edges, axis, 0)[1:] |= b - a > jump * b
    return edges


def silhouette_scores(surface: Surface, photos: Sequence[PlacedPhoto], truth: Truth) -> Row:
    """Return precision, recall and F of the model's silhouettes, by their distance from true ones in each photo."""
    moved = align_centers({photo.name: photo.center for photo in photos}, truth)(surface.vertices)
    found, true = ray_caster(moved, surface.faces), ray_caster(truth.vertices, truth.faces)
    right, ours, met, theirs = 0, 0, 0, 0
    for name in (photo.name for photo in photos):
        pose, whole = truth.cam_from_world[name], truth.cameras[name]
        shrink = min(1.0, WIDEST / whole.width)
        width, height = round(shrink * whole.width), round(shrink * whole.height)
        K = np.diag([width / whole.width, height / whole.height, 1.0]) @ whole.K
        rays = (pixel_rays(Camera(K, width, height, whole.lens)) @ pose[:, :3]).reshape(height, width, 3)
        center = camera_center(pose)
        depth = cast_depth(true, center, rays)
        asked = _near_seen(center + rays[::STEP, ::STEP] * depth[::STEP, ::STEP, None], truth, (width, height))
        edges, true_edges = (depth_edges(z, THING) & asked for z in (cast_depth(found, center, rays), depth))
        right, ours = right + int((edges & _grown(true_edges, NEAR_PX)).sum()), ours + int(edges.sum())
        met, theirs = met + int((true_edges & _grown(edges, NEAR_PX)).sum()), theirs + int(true_edges.sum())
    precision, recall = _percent(right, ours), _percent(met, theirs)
    both = round(2.0 * precision * recall / max(precision + recall, 1e-9), 2)
    return {"silhouettes: precision %": precision, "silhouettes: recall %": recall, "silhouettes: F %": both}


def _near_seen(places: FloatArray, truth: Truth, size: tuple[int, int]) -> Mask:
    """Return the pixels of a photo at or beside places (h, w, 3) on a grid that enough photos see."""
    hit = np.isfinite(places).all(axis=2)
    seen = np.zeros(hit.shape, np.uint8)
    seen[hit] = sights_of(truth, places[hit], None).count >= SEEN_BY
    return _grown(cv2.resize(seen, size, interpolation=cv2.INTER_NEAREST) > 0, STEP)


def _grown(mask: Mask, radius: float) -> Mask:
    """Return the pixels within a radius of a mask."""
    if not mask.any():
        return mask
    return np.asarray(cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= radius)


def _closed(covered: Mask) -> Mask:
    """Return the mask with its gaps of at most twice `GAP_PX`, without any at the rim of the photo."""
    return covered | ~_grown(~np.pad(_grown(covered, GAP_PX), GAP_PX), GAP_PX)[GAP_PX:-GAP_PX, GAP_PX:-GAP_PX]


def _percent(part: int, whole: int) -> float:
    return round(100.0 * part / max(whole, 1), 2)


def outline_scores(model: Model, photos: Sequence[PlacedPhoto], truth: Truth | None = None) -> Row:
    """Return all figures of a model in the frame of its photos."""
    prepared = PreparedModel(model)
    row = border_scores(prepared, photos) | picture_scores(prepared, photos)
    return row | (silhouette_scores(model.surface, photos, truth) if truth else {})


def read_model(out: Path) -> Model:
    """Read the model of a finished run in the frame of its cameras; without OUT/texture, the one of OUT/model.ply."""
    place = Workspace(out)
    if place.texture.exists():
        return read_texture(place)
    import trimesh

    mesh = trimesh.load_mesh(out / "model.ply", process=False)
    vertices = read_frame(place).from_model.inverse()(np.asarray(mesh.vertices))
    return Model(Surface(vertices, np.asarray(mesh.faces, np.int64), np.asarray(mesh.visual.vertex_colors)[:, :3]))


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = new_parser("surface.outlines", __doc__)
    parser.add_argument("outs", type=Path, nargs="+", metavar="OUT", help="folder of a finished run")
    parser.add_argument("--truth", type=Path, help="folder with NAME/truth.json for an OUT of that name")
    add_results(parser, "surface-outlines")
    return parser.parse_args()


def main() -> None:
    """Measure all models, and write the results."""
    args, rows = parse_arguments(), []
    for out in args.outs:
        photos = [placed_photo(out, name, WIDEST) for name in placed_photos(out)]
        known = args.truth and (args.truth / out.name / TRUTH_FILE).exists()
        row: Row = {"photos": out.name, "method": "sfm-app", "placed": len(photos)}
        rows.append(row | outline_scores(read_model(out), photos, load_truth(args.truth / out.name) if known else None))
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    columns = dict.fromkeys(key for row in rows for key in row if key != "method")
    text = f"# Outlines\n\n{ABOUT}\n\n{table(rows, list(columns))}"
    found = document("surface-outlines", ABOUT, {}, {"sets": [row["photos"] for row in rows]}, rows)
    write(args.results, args.name, found, text)
    print(text)


if __name__ == "__main__":
    main()
