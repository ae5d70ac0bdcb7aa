"""The dense cloud as compressed LAS; needs laspy and lazrs."""

from pathlib import Path

import numpy as np

from sfm_app.formats.exporters import FinishedScene


def write_laz(scene: FinishedScene, target: Path) -> None:
    """Write the dense cloud with colors; coordinates are exact to a hundred-millionth of its size."""
    import laspy

    cloud = scene.cloud()
    head = laspy.LasHeader(point_format=2, version="1.2")  # the first version with colors: every reader knows it
    head.creation_date = None  # same cloud, same bytes
    head.generating_software = "sfm_app"
    extent = float(np.ptp(cloud.points, axis=0).max()) or 1.0
    step = float(10.0 ** np.ceil(np.log10(extent / 2e9)))  # 32 bits hold the longest side
    head.offsets, head.scales = cloud.points.min(axis=0), np.full(3, step)
    las = laspy.LasData(head)
    las.x, las.y, las.z = cloud.points.T
    las.red, las.green, las.blue = cloud.colors.T.astype(np.uint16) * 257  # LAS has 16-bit colors
    with target.open("wb") as file:
        las.write(file, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)
