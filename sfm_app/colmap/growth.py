"""Continue from an earlier run: its database and its model, with other photos.

Known photos keep their ids, keypoints, descriptors and matches. New photos get ids that no photo had before.
"""

import contextlib
import sqlite3
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

from sfm_app.colmap.backend import all_points, pycolmap
from sfm_app.colmap.database import matched_image, ordered_photos, write_match_graph
from sfm_app.colmap.model import pose_photo, posed_images, unposed_model
from sfm_app.files import replace_atomically
from sfm_app.types import MatchGraph, PhotoSet

COPIES = (
    ("SELECT * FROM keypoints", "INSERT INTO keypoints VALUES (?, ?, ?, ?)", lambda key: (key,)),
    ("SELECT * FROM descriptors", "INSERT INTO descriptors VALUES (?, ?, ?, ?, ?)", lambda key: (key,)),
    ("SELECT * FROM matches", "INSERT INTO matches VALUES (?, ?, ?, ?)", pycolmap.pair_id_to_image_pair),
)
"""Queries that copy tables, and the ids of photos in the key of a row."""
LAST_ID = "SELECT seq FROM sqlite_sequence WHERE name = 'images'"
"""Query for the largest id that a photo ever had."""


def grow_database(path: Path, earlier: Path, photos: PhotoSet, known: Collection[str]) -> None:
    """Make the database of these photos; the known ones have the features and matches of an earlier run."""
    with _connection(earlier) as connection:
        earlier_ids = dict(connection.execute("SELECT name, image_id FROM images"))
        last = max([0, *earlier_ids.values(), *(seq for (seq,) in connection.execute(LAST_ID))])
    ids = {name: key for name, key in earlier_ids.items() if name in known}
    members = ordered_photos(photos)
    new = [photo.name for photo in members if photo.name not in ids]
    ids |= {name: key for key, name in enumerate(new, start=last + 1)}
    images = {ids[photo.name]: matched_image(ids[photo.name], photo) for photo in members}
    with replace_atomically(path) as beside:
        write_match_graph(beside, MatchGraph(images, {}, {}))
        _copy_rows(beside, earlier, {key for name, key in ids.items() if name in known})


def forget_changed_matches(path: Path, earlier: Path) -> frozenset[str]:
    """Remove the matches of photos whose keypoints differ from those of an earlier run, and return their names."""
    query = "SELECT image_id, rows, cols, data FROM keypoints"
    with _connection(earlier) as before, _connection(path) as now:
        old = {key: values for key, *values in before.execute(query)}
        changed = {key for key, *values in now.execute(query) if key in old and values != old[key]}
        pairs = [key for (key,) in now.execute("SELECT pair_id FROM matches")] if changed else []
        affected = [(key,) for key in pairs if not changed.isdisjoint(pycolmap.pair_id_to_image_pair(key))]
        now.executemany("DELETE FROM matches WHERE pair_id = ?", affected)
        names = now.execute("SELECT image_id, name FROM images").fetchall()
    return frozenset(name for key, name in names if key in changed)


def _copy_rows(path: Path, earlier: Path, photos: Collection[int]) -> None:
    known = frozenset(photos)
    with _connection(earlier) as source, _connection(path) as target:
        for read, write, photos_of in COPIES:
            rows = (row for row in source.execute(read) if known.issuperset(photos_of(row[0])))
            target.executemany(write, rows)


@contextlib.contextmanager
def _connection(path: Path) -> Iterator[sqlite3.Connection]:
    with contextlib.closing(sqlite3.connect(path)) as connection, connection:
        yield connection


def model_in_database(
    database: Path, earlier: Path, photos: Collection[int], keypoints: Mapping[int, int]
) -> pycolmap.Reconstruction:
    """Return the part of an earlier model that some photos see, with the photos and cameras of a database.

    Known photos have the ids of the model. Cameras get the parameters of the earlier model. Tracks lose photos that are
    not known, and keypoints that the database lacks; points with fewer than two photos are left out.
    """
    before = pycolmap.Reconstruction(earlier)
    model = unposed_model(database)
    placed = [image for image in posed_images(before) if image.image_id in photos]
    for image in placed:
        camera, known = model.cameras[model.images[image.image_id].camera_id], before.cameras[image.camera_id]
        camera.model, camera.params = known.model, known.params.tolist()
    for image in placed:
        pose_photo(model, image.image_id, image.cam_from_world())
    members = {image.image_id for image in placed}
    for _, point in sorted(all_points(before), key=lambda item: item[0]):
        track = pycolmap.Track()
        for element in point.track.elements:
            if element.image_id in members and element.point2D_idx < keypoints[element.image_id]:
                track.add_element(element.image_id, element.point2D_idx)
        if track.length() >= 2:
            model.add_point3D(point.xyz, track, point.color)
    return model
