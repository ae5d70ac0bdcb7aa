"""COLMAP's SIFT features of panoramas, found in perspective views and entered as keypoints of the panorama."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.database import open_database
from sfm_app.photos.decode import read_picture, upright_image
from sfm_app.photos.masks import read_mask
from sfm_app.photos.panoramas.feature_views import PanoramaViews
from sfm_app.progress import Progress, track


def extract_panoramas(
    database: Path,
    photo_dir: Path,
    names: Sequence[str],
    mask_dir: Path | None,
    extraction: pycolmap.FeatureExtractionOptions,
    progress: Progress,
) -> None:
    """Find SIFT features of panoramas that have none yet. Ours.

    Of too many features those of the largest scale are kept, as COLMAP does.

    Args:
        database: holds the photos; keypoints and descriptors are entered.
        photo_dir: folder with the photos.
        names: names of the panoramas.
        mask_dir: has a mask of every photo; None without masks.
        extraction: COLMAP's options; the largest size is that of one view.
        progress: shows a bar.
    """
    with open_database(database) as reader:
        images = {image.name: image.image_id for image in reader.read_all_images()}
        left = [name for name in names if not reader.exists_keypoints(images[name])]
    for name in track(progress, left, "panoramas", len(left)) if left else ():
        keypoints, descriptors = _find_in_panorama(photo_dir / name, extraction)
        if mask_dir is not None:
            used = read_mask(mask_dir, name)
            column, row = np.clip(keypoints[:, :2].astype(np.int64), 0, np.array(used.shape[::-1]) - 1).T
            keypoints, descriptors = keypoints[used[row, column]], descriptors[used[row, column]]
        best = np.argsort(-keypoints[:, 2], kind="stable")[: extraction.sift.max_num_features]
        with open_database(database) as target:
            target.write_keypoints(images[name], np.ascontiguousarray(keypoints[best, :2], np.float32))
            target.write_descriptors(images[name], _to_descriptors(descriptors[best]))


def _find_in_panorama(
    path: Path, extraction: pycolmap.FeatureExtractionOptions
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return keypoints (N, 3), x and y in pixels of the panorama and the scale in a view, and descriptors (N, 128)."""
    pixels = np.asarray(upright_image(read_picture(path)).convert("RGB"), np.uint8)
    views = PanoramaViews.cover((pixels.shape[1], pixels.shape[0]), extraction.max_image_size)
    pixels = views.shrink(pixels)
    keypoints, descriptors = [np.zeros((0, 3))], [np.zeros((0, 128), np.uint8)]
    with tempfile.TemporaryDirectory(prefix="sfm-app-views-") as folder:
        names = [f"{view:02d}.png" for view in range(len(views.rotations))]
        for view, name in enumerate(names):
            Image.fromarray(views.render(pixels, view)).save(Path(folder) / name, compress_level=1)
        found = Path(folder) / "views.db"
        with open_database(found):
            pass  # COLMAP needs an existing file
        pycolmap.extract_features(found, Path(folder), names, extraction_options=extraction, device=pycolmap.Device.cpu)
        with open_database(found) as reader:
            images = {image.name: image.image_id for image in reader.read_all_images()}
            for view, name in enumerate(names):
                points = np.asarray(reader.read_keypoints(images[name]), np.float64)
                if not len(points):
                    continue  # a clear sky
                own = np.flatnonzero(views.is_nearest(points[:, :2], view))
                scale = np.sqrt(np.abs(points[own, 2] * points[own, 5] - points[own, 3] * points[own, 4]))
                keypoints.append(np.column_stack([views.to_panorama(points[own, :2], view), scale]))
                descriptors.append(np.asarray(reader.read_descriptors(images[name]).data, np.uint8)[own])
    return np.concatenate(keypoints), np.concatenate(descriptors)


def _to_descriptors(rows: NDArray[np.uint8]) -> pycolmap.FeatureDescriptors:
    return pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, np.ascontiguousarray(rows))
