"""Models of photos that walk along walls, with real cameras of COLMAP's."""

import numpy as np
import pytest

from sfm_app.colmap.backend import pycolmap
from sfm_app.mapping.attempt import PairSupport

WIDTH, HEIGHT, FOCAL, AWAY = 600, 450, 500.0, 5.0


class Walls:
    """Photos at x, y = 0, z = 0 that look at walls at z = `AWAY`; every walk sees the points of its own."""

    def __init__(self):
        self.model = pycolmap.Reconstruction()
        self.tracks = {}
        self.points = np.empty((0, 3))

    def add_points(self, low, high, seed, per_meter=120, away=AWAY):
        """Add points of a wall, and return their numbers."""
        count = round(per_meter * (high - low))
        x, y = np.random.default_rng(seed).uniform([[low], [-2]], [[high], [2]], (2, count))
        self.points = np.vstack([self.points, np.column_stack([x, y, np.full(count, away)])])
        return np.arange(len(self.points) - count, len(self.points))

    def add_walk(self, photos, places, known, shift=0.0, zoom=1.0):
        """Add photos with these ids at these places, which see the points that are known to them."""
        camera, focal = min(photos), zoom * FOCAL
        self.model.add_camera_with_trivial_rig(
            pycolmap.Camera(model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT,
                            params=[focal, WIDTH / 2, HEIGHT / 2], camera_id=camera)
        )  # fmt: skip
        for photo, place in zip(photos, places, strict=True):
            seen = self.points[known] - [place, shift, 0.0]
            x = focal * seen[:, :2] / seen[:, 2:] + [WIDTH / 2, HEIGHT / 2]
            inside = ((x > 0) & (x < [WIDTH, HEIGHT])).all(axis=1)
            image = pycolmap.Image(image_id=photo, name=f"{photo:03d}.jpg", camera_id=camera)
            image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in x[inside]])
            self.model.add_image_with_trivial_frame(
                image, pycolmap.Rigid3d(pycolmap.Rotation3d(np.eye(3)), -np.array([place, shift, 0.0]))
            )
            for row, number in enumerate(np.asarray(known)[inside]):
                self.tracks.setdefault(int(number), []).append((photo, row))

    def finish(self):
        """Return the model, and the matches that it explains."""
        common = {}
        for number, ends in sorted(self.tracks.items()):
            track = pycolmap.Track()
            for photo, row in ends:
                track.add_element(photo, row)
            self.model.add_point3D(self.points[number], track, np.zeros(3, np.uint8))
            for k, (photo, _) in enumerate(ends):
                for other, _ in ends[k + 1 :]:
                    pair = (min(photo, other), max(photo, other))
                    common[pair] = common.get(pair, 0) + 1
        return self.model, {pair: PairSupport(count, count, 0) for pair, count in common.items()}


@pytest.fixture
def walls():
    return Walls()
