"""Pages of texture, and the vertices that lie on them."""

import io

import numpy as np
from numpy.typing import NDArray

IndexArray = NDArray[np.int64]

JPEG_QUALITY = 90
"""Of the pages of texture, by the scale of libjpeg: below it blocks begin to show, above it files grow fast."""


def jpeg(page: NDArray[np.uint8]) -> bytes:
    """Return a page of texture (H, W, 3) as JPEG, with colors as sharp as brightness.

    JPEG's usual half resolution for colors smears them across the borders of charts: on the page of a brick wall it
    costs 3 dB, and files of the same size are 1.5 dB nearer to the page with full resolution and less quality.
    """
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(page).save(file, "JPEG", quality=JPEG_QUALITY, subsampling="4:4:4", optimize=True)
    return file.getvalue()


def split_corners(faces: IndexArray, uv: NDArray[np.float32]) -> tuple[IndexArray, NDArray[np.float32], IndexArray]:
    """Return one vertex per place on the surface and in the texture: those on borders of charts become several.

    Args:
        faces: (T, 3) vertex indices.
        uv: (T, 3, 2) places of their corners in the texture.

    Returns:
        For each of N new vertices the old one (N,) and its place in the texture (N, 2), and the faces (T, 3) of new
        ones; in the order of the old ones.
    """
    at, place = faces.ravel(), np.ascontiguousarray(uv, np.float32).reshape(-1, 2)
    order = np.lexsort((place[:, 1], place[:, 0], at))
    first = np.ones(len(order), bool)
    first[1:] = (np.diff(at[order]) != 0) | (np.diff(place[order], axis=0) != 0).any(axis=1)
    new = np.empty(len(order), np.int64)
    new[order] = np.cumsum(first) - 1
    kept = order[first]
    return at[kept], place[kept], new.reshape(-1, 3)


def pages_in_use(pages: NDArray[np.int32]) -> list[int]:
    """Return numbers of the pages that triangles lie on, in order."""
    return [int(page) for page in np.unique(pages)]
