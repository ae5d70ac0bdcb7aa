"""Texture pages and normal maps as files, and the vertices of their triangles."""

import io

import numpy as np
from numpy.typing import NDArray

IndexArray = NDArray[np.int64]

JPEG_QUALITY = 90
"""Quality of texture pages on libjpeg's scale: lower values show blocks, higher ones make much larger files."""

NORMAL_QUALITY, NORMAL_SUFFIX, NORMAL_TYPE = 92, "jpg", "image/jpeg"
"""Quality and kind of normal maps. Chosen on fountain-P11 (benchmarks/surface/normal_map.py): 0.5 MB, and shading 1.7
degrees off on average; PNG takes 1.3 MB for 1.1 degrees, quality 80 takes 0.3 MB for 2.2 degrees."""


def jpeg(page: NDArray[np.uint8]) -> bytes:
    """Return a texture page (H, W, 3) as JPEG, without chroma subsampling.

    JPEG's usual chroma subsampling smears colors across the borders of charts: on the page of a brick wall it costs
    3 dB. At equal file size, full resolution with lower quality is 1.5 dB closer to the page.
    """
    try:
        return _encode(page, JPEG_QUALITY, optimize=True)
    except OSError:  # Pillow reserves a byte for each pixel; pages that are mostly noise take more
        return _encode(page, JPEG_QUALITY, optimize=False)


def normal_picture(page: NDArray[np.uint8]) -> bytes:
    """Return a normal map (H, W, 3) as a file, of the kind that `NORMAL_SUFFIX` names."""
    return _encode(page, NORMAL_QUALITY, optimize=False)


def _encode(page: NDArray[np.uint8], quality: int, *, optimize: bool) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(page).save(file, "JPEG", quality=quality, subsampling="4:4:4", optimize=optimize)
    return file.getvalue()


def split_corners(faces: IndexArray, uv: NDArray[np.float32]) -> tuple[IndexArray, NDArray[np.float32], IndexArray]:
    """Divide vertices on chart borders, so that each vertex has one texture coordinate.

    Args:
        faces: (T, 3) vertex indices.
        uv: (T, 3, C) texture coordinates of their corners, and whatever else may differ there.

    Returns:
        For each of N new vertices, in the order of the old ones: the old vertex (N,) and the texture coordinates
        (N, C); and the faces (T, 3) of new vertices.
    """
    at, place = faces.ravel(), np.ascontiguousarray(uv, np.float32).reshape(faces.size, -1)
    order = np.lexsort((*place.T[::-1], at))
    first = np.ones(len(order), bool)
    first[1:] = (np.diff(at[order]) != 0) | (np.diff(place[order], axis=0) != 0).any(axis=1)
    new = np.empty(len(order), np.int64)
    new[order] = np.cumsum(first) - 1
    kept = order[first]
    return at[kept], place[kept], new.reshape(-1, 3)


def pages_in_use(pages: NDArray[np.int32]) -> list[int]:
    """Return the numbers of the pages that triangles lie on, ascending."""
    return [int(page) for page in np.unique(pages)]
