"""The model of an earlier run in the database of this one, as a start for further photos."""

from collections.abc import Collection, Mapping
from pathlib import Path

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.models.model import pose_photo, posed_images, unposed_model
from sfm_app.colmap.types import all_points


def model_in_database(
    database: Path, earlier: Path, photos: Collection[int], keypoints: Mapping[int, int]
) -> pycolmap.Reconstruction:
    """Return the part of an earlier model that some photos see, with the photos and cameras of a database.

    Cameras get the parameters of the earlier model. Tracks lose the photos that are not there, and keypoints that only
    the earlier run had; points that fewer than two photos see are left out.

    Args:
        database: holds photos, keypoints and cameras; known photos have the ids that they have in the model.
        earlier: COLMAP's model on disk.
        photos: ids of the known photos.
        keypoints: number of keypoints of each photo in the database.
    """
    before = pycolmap.Reconstruction(earlier)
    model = unposed_model(database)
    placed = [image for image in posed_images(before) if image.image_id in photos]
    for image in placed:
        camera, known = model.cameras[model.images[image.image_id].camera_id], before.cameras[image.camera_id]
        camera.model, camera.params = known.model, known.params.tolist()
    for image in placed:
        pose_photo(model, image.image_id, image.cam_from_world())
    there = {image.image_id for image in placed}
    for _, point in sorted(all_points(before), key=lambda item: item[0]):
        track = pycolmap.Track()
        for element in point.track.elements:
            if element.image_id in there and element.point2D_idx < keypoints[element.image_id]:
                track.add_element(element.image_id, element.point2D_idx)
        if track.length() >= 2:
            model.add_point3D(point.xyz, track, point.color)
    return model
