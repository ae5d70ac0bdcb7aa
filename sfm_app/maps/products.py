"""Orthophoto, elevation model and contours of a finished run, step by step."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import numpy as np

from sfm_app.api import PathLike, open_run
from sfm_app.engine.stage import resume_hint
from sfm_app.errors import ConfigError, InputError, ReconstructionError
from sfm_app.exports import naming_target, stored_frame, stored_model
from sfm_app.maps.contours import contour_pixel, find_contours, write_geopackage
from sfm_app.maps.drawing import (
    Tile,
    assemble,
    count_tiles,
    cover,
    cut_front,
    draw_tiles,
    facing_corners,
    rays_per_pixel,
    texel_size,
)
from sfm_app.maps.geotiff import check_rasterio, write_cog
from sfm_app.maps.ground import bare_ground
from sfm_app.maps.projections import Projection, project, read_plane
from sfm_app.maps.sheets import Caption, write_sheet
from sfm_app.pipeline import TEXTURE
from sfm_app.progress import Callback, Progress, track
from sfm_app.runtime.context import RunContext
from sfm_app.settings import Settings
from sfm_app.wording import format_length, parse_length

ORTHOPHOTO, DSM, DTM, CONTOURS = "orthophoto", "dsm", "dtm", "contours"
SUFFIXES = {ORTHOPHOTO: "tif", DSM: "tif", DTM: "tif", CONTOURS: "gpkg"}
GIVE_SIZE = "give it with --gcp, --markers or --scale of `sfm-app run`"
UNSCALED = "--{option} 0.01, in the unit of the scene; --gcp, --markers or --scale of `sfm-app run` give it meters"
FOOT = 0.3048
"""Meters, by definition; the foot of the US survey is 2e-6 longer."""


@dataclass(frozen=True, slots=True)
class MapOptions:
    """Which plane, and how finely."""

    resolution: str = ""
    """Side of a pixel on the ground, such as 2cm; a bare number if the size of the scene is unknown; empty for that of
    the texture, which is that of the photos where its pages have room for them."""
    plane: str = ""
    """Empty for the ground, "facade" for the dominant vertical plane, three points for a plane, or two for a section:
    x,y,z in the frame of exported files, with blanks between them."""
    interval: str = ""
    """Step of contours, written as the resolution; empty for a round one with twenty heights or more."""
    ground: bool = False
    """Whether contours follow the bare ground."""


def export_map(
    out: PathLike, product: str, target: PathLike | None = None, options: MapOptions | None = None, *,
    progress: Progress | Callback | None = None,
) -> tuple[Path, ...]:  # fmt: skip
    """Write the orthophoto or heights of a finished run as a Cloud Optimized GeoTIFF, or contours as a GeoPackage.

    The DSM follows houses and trees, the DTM is the bare ground. A map lies in the run's system or UTM zone
    where GPS or control points give a place, else in a plane. Three points are counterclockwise for the viewer. A
    section shows what lies behind it, its first point at the left.

    Args:
        product: "orthophoto", "dsm", "dtm" or "contours".
        target: file to write; None for OUT/orthophoto.tif, OUT/dsm.tif, or with a plane OUT/orthophoto-plane.tif, ...

    Returns:
        The file and, for a GeoTIFF of a plane, the same with a scale bar as PNG and as PDF, which prints to scale.

    Raises:
        ConfigError: rasterio is missing; the product, the plane or the resolution is none; a DTM is of a wall, or of
            unknown size.
        InputError: the run has no model yet, the raster is too large, or the target cannot be written.
        ReconstructionError: nothing of the surface faces the viewer.

    Examples:
        >>> from sfm_app.maps.products import MapOptions, export_map
        >>> [path.name for path in export_map("out", "orthophoto", options=MapOptions(plane="facade"))]
        ['orthophoto-plane.tif', 'orthophoto-plane.png', 'orthophoto-plane.pdf']
    """
    options = options or MapOptions()
    if product not in SUFFIXES:
        raise ConfigError(f"'{product}' is no map", hint=f"one of {', '.join(SUFFIXES)}")
    if options.interval and product != CONTOURS:
        raise ConfigError(f"--interval does not apply to {product}", hint="omit it")
    if options.ground and product != CONTOURS:
        raise ConfigError(f"--ground does not apply to {product}", hint=f"--format {DTM} is the bare ground")
    is_ground = product == DTM or options.ground
    if is_ground and options.plane:
        raise ConfigError("a plane has no bare ground", hint="omit --plane")
    if product != CONTOURS or is_ground:
        check_rasterio()
    if options.plane:
        read_plane(options.plane)  # fail before files are read
    suffix = SUFFIXES[product]
    name = f"{product}-plane.{suffix}" if options.plane else f"{product}.{suffix}"
    place = Path(out) / name if target is None else Path(target)
    place = place / name if place.is_dir() else place
    if place.suffix.lower() not in (f".{suffix}", f".{suffix}f"):  # .tiff
        raise ConfigError(f"{place.name} does not end in .{suffix}", hint=f"name it {place.stem}.{suffix}")
    with open_run(Path(out), Settings(), progress) as run:
        return _write(run, product, place, options)


def _write(run: RunContext, product: str, target: Path, options: MapOptions) -> tuple[Path, ...]:
    model, frame = stored_model(run), stored_frame(run)
    if model.texture is None:
        raise InputError(f"the model in {run.workspace.root} has no texture", hint=resume_hint(run))
    shown = project(model.surface, frame, options.plane)
    corners, page = facing_corners(shown.points, model.surface.faces, model.texture)
    if shown.cut:
        corners, page = cut_front(corners, page)
    if not len(corners):
        raise ReconstructionError("nothing of the surface faces the viewer", hint="swap two points of --plane")
    texel = texel_size(corners, page, model.texture)
    is_ground = product == DTM or options.ground
    if is_ground and not (shown.unit_m and shown.height_m):
        raise ConfigError("bare ground needs the size of the scene: houses are told by it", hint=GIVE_SIZE)
    resolution = contour_pixel(corners, texel) if is_ground or product == CONTOURS else texel
    resolution = _read_length("resolution", options.resolution, shown.unit_m) or resolution
    grid, rays = cover(corners, resolution), rays_per_pixel(resolution, texel) if product == ORTHOPHOTO else 1
    run.progress.say(_describe(product, shown, resolution, _texture_scale(run)))
    pages = model.texture.pages if product == ORTHOPHOTO else ()
    drawn = draw_tiles(corners, page, pages, grid, rays)
    tiles: Iterable[Tile] = track(run.progress, drawn, "drawing", count_tiles(grid, rays))
    if is_ground:
        heights = bare_ground(assemble(tiles, grid), resolution * shown.unit_m, shown.height_m)
        tiles = [Tile(0, 0, np.zeros((*heights.shape, 0), np.uint8), heights)]
    with naming_target(target):
        if product == CONTOURS:
            interval = _read_length("interval", options.interval, shown.height_m)
            write_geopackage(find_contours(tiles, grid, interval), shown.wkt, target)
            return (target,)
        write_cog(tiles, grid, shown.wkt, target, _unit_name(shown.height_m) if product in (DSM, DTM) else None)
        if not options.plane:
            return (target,)
        return (target, *write_sheet(target, Caption(product, shown.title, shown.unit_m)))


def _read_length(option: str, text: str, unit_m: float) -> float:
    """Return a length of the command line in units of so many meters, 0 if that is unknown; 0 for an empty text."""
    try:
        value = 0.0 if not text else parse_length(text) / unit_m if unit_m else float(text)
    except ValueError as err:
        reason = str(err) if unit_m else f"'{text}' is no number, and the scene has no size for lengths"
        hint = f"--{option} 2cm" if unit_m else UNSCALED.format(option=option)
        raise ConfigError(f"--{option}: {reason}", hint=hint) from None
    if text and not (isfinite(value) and value > 0.0):
        raise ConfigError(f"--{option}: '{text}' is not positive", hint=UNSCALED.format(option=option))
    return value


def _texture_scale(run: RunContext) -> float:
    """Return the texels per pixel of the photos, along a side."""
    record = run.workspace.manifest.record(TEXTURE.name)
    return float(record.counts.get("scale", 1.0)) if record else 1.0


def _describe(product: str, shown: Projection, resolution: float, scale: float) -> str:
    """Return where the product lies, the side of a pixel, and what limits it."""
    unit = shown.unit_m
    pixel = format_length(resolution * unit) if unit else f"{resolution:.3g} units of the scene"
    text = f"{product}, {shown.title}, pixels of {pixel}"
    if not unit:
        text += "; the size is unknown: `sfm-app run` with --gcp, --markers or --scale gives it"
    if scale < 1.0:
        text += (
            f"; the photos are {1.0 / scale:.2g} times as fine: `sfm-app run` with --set texture.max_pages=64 keeps all"
        )
    return text


def _unit_name(meters: float) -> str:
    return "m" if meters == 1.0 else "ft" if abs(meters / FOOT - 1.0) < 1e-5 else ""
