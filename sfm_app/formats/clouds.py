"""Point clouds as binary PLY and as compressed LAS."""

from pathlib import Path

import numpy as np

from sfm_app.formats.exporters import FinishedScene
from sfm_app.formats.meshes import COLOR, NORMAL, PLACE, Columns, header, table
from sfm_app.types.scene import PointCloud

LAS_VERSION, COLORED_POINTS = "1.2", 2
"""The first version with colors, which every reader of LAS knows."""
LEVELS_16_BIT = 257
"""Steps of 16-bit colors, which LAS has, for one of 8-bit colors. By definition."""
MOST_STEPS = 2e9
"""Most steps of LAS's 32-bit coordinates along the longest side of the cloud; they can count 2.1e9. By definition."""


def write_cloud_ply(scene: FinishedScene, target: Path) -> None:
    """Write the dense cloud as binary PLY with normals and colors.

    Args:
        scene: the finished scene.
        target: PLY file.
    """
    target.write_bytes(cloud_ply(scene.cloud()))


def cloud_ply(cloud: PointCloud) -> bytes:
    """Return points as binary PLY, with normals where they are known.

    Args:
        cloud: the points.
    """
    columns: Columns = [cloud.points, cloud.colors]
    kinds = PLACE + COLOR
    if cloud.normals is not None:
        columns, kinds = [cloud.points, cloud.normals, cloud.colors], PLACE + NORMAL + COLOR
    rows = table(kinds, columns)
    return header({"vertex": rows}).encode("ascii") + rows.tobytes()


def write_laz(scene: FinishedScene, target: Path) -> None:
    """Write the dense cloud as compressed LAS with colors; coordinates are exact to a hundred-millionth of its size.

    Args:
        scene: the finished scene.
        target: LAZ file.
    """
    import laspy

    cloud = scene.cloud()
    head = laspy.LasHeader(point_format=COLORED_POINTS, version=LAS_VERSION)
    head.creation_date = None  # same cloud, same bytes
    head.generating_software = "sfm_app"
    head.offsets, head.scales = cloud.points.min(axis=0), np.full(3, step_size(cloud))
    las = laspy.LasData(head)
    las.x, las.y, las.z = cloud.points.T
    las.red, las.green, las.blue = cloud.colors.T.astype(np.uint16) * LEVELS_16_BIT
    with target.open("wb") as file:
        las.write(file, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)


def step_size(cloud: PointCloud) -> float:
    """Return the step of coordinates: a power of ten."""
    extent = float(np.ptp(cloud.points, axis=0).max()) or 1.0
    return float(10.0 ** np.ceil(np.log10(extent / MOST_STEPS)))
