"""Cloud Optimized GeoTIFF by GDAL, tile by tile."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from sfm_app.errors import ConfigError
from sfm_app.files import replace_atomically
from sfm_app.maps.drawing import Grid, Tile

INSTALL_HINT = "pip install 'sfm-app[maps]'"
HOLE = -9999.0
"""Height of holes: GDAL's usual one, below all ground."""
BLOCK_PX = 512
"""Side of the blocks of a file, as GDAL's driver has it by default."""


def check_rasterio() -> None:
    """Raise a ConfigError if rasterio, which brings GDAL, is missing or broken."""
    try:
        import rasterio  # noqa: F401
    except ImportError as err:
        raise ConfigError(f"orthophotos and elevation models need rasterio: {err}", hint=INSTALL_HINT) from None


def write_cog(tiles: Iterable[Tile], grid: Grid, wkt: str, target: Path, heights_in: str | None = None) -> None:
    """Write colors with opacity as a Cloud Optimized GeoTIFF, or heights in a unit; OSError if it cannot be written.

    `wkt` is the coordinate system, `heights_in` "m" or "ft"; both are empty where unknown. The same tiles give the same
    bytes. The tiles go to a plain file first, because the overviews precede the pixels.
    """
    import rasterio
    import rasterio.shutil
    from rasterio._err import CPLE_BaseError  # raised, and exported nowhere
    from rasterio.crs import CRS
    from rasterio.enums import ColorInterp
    from rasterio.transform import Affine
    from rasterio.windows import Window

    heights = heights_in is not None
    form = {
        "driver": "GTiff", "width": grid.width, "height": grid.height, "tiled": True, "blockxsize": BLOCK_PX,
        "blockysize": BLOCK_PX, "compress": "deflate", "zlevel": 1, "sparse_ok": True, "bigtiff": "if_safer",
        "crs": CRS.from_wkt(wkt) if wkt else None,
        "transform": Affine(grid.resolution, 0.0, grid.left, 0.0, -grid.resolution, grid.top),
    }  # fmt: skip
    form |= {"count": 1, "dtype": "float32", "nodata": HOLE} if heights else {"count": 4, "dtype": "uint8"}
    with replace_atomically(target) as draft:
        plain = draft.with_suffix(".tiles")
        try:
            with rasterio.open(plain, "w", **form) as file:
                if heights:
                    file.units = (heights_in,)
                else:
                    file.colorinterp = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
                for tile in tiles:
                    window = Window(tile.column, tile.row, tile.heights.shape[1], tile.heights.shape[0])
                    bands = np.nan_to_num(tile.heights, nan=HOLE)[None] if heights else np.moveaxis(tile.colors, 2, 0)
                    file.write(bands, window=window)
            rasterio.shutil.copy(
                plain, draft, driver="COG", compress="deflate", predictor="yes", blocksize=BLOCK_PX,
                overview_resampling="average", bigtiff="if_safer", sparse_ok="true",
            )  # fmt: skip
        except CPLE_BaseError as err:  # closing a file on a full disk has no errors: the copy does
            raise OSError(str(err)) from err
        finally:
            plain.unlink(missing_ok=True)
