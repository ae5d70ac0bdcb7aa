"""A textured plane that any view can photograph, with its true depths."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from sfm_app.stereo import View


@dataclass(frozen=True)
class Plane:
    """n'X = d with a random texture, coarse and fine."""

    normal: np.ndarray
    distance: float
    texture: np.ndarray
    px_per_unit: float = 70.0

    def depth(self, view: View) -> np.ndarray:
        """(H, W) true depths at the view's sample points."""
        rays = self._rays(view, view.sample_px)
        return ((self.distance - self.normal @ view.center) / (rays @ self.normal)).astype(np.float32)

    def photo(self, view: View) -> np.ndarray:
        """(H, W) gray photo."""
        rays = self._rays(view, 0.5)
        depth = (self.distance - self.normal @ view.center) / (rays @ self.normal)
        points = view.center + depth[..., None] * rays
        at = (points[..., :2] * self.px_per_unit + 1000).astype(np.float32)
        return cv2.remap(self.texture, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)

    @staticmethod
    def _rays(view: View, offset: float) -> np.ndarray:
        y, x = np.mgrid[: view.height, : view.width] + offset
        return np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(view.K).T @ view.R


@pytest.fixture(scope="session")
def plane() -> Plane:
    rng = np.random.default_rng(3)
    texture = sum(
        cv2.resize(rng.normal(0, sigma, (2000 // size, 2000 // size)), (2000, 2000), interpolation=cv2.INTER_CUBIC)
        for size, sigma in ((3, 25), (9, 25), (40, 20))
    )
    normal = np.array([0.25, -0.15, 1.0])
    return Plane(normal / np.linalg.norm(normal), 4.0, np.clip(texture + 128, 0, 255).astype(np.uint8))


@pytest.fixture(scope="session")
def make_view(plane):
    """A view of the plane from a center, looking along +z unless turned, with sparse points where it sees the plane."""

    def make(center, name="a", turn=(0.0, 0.0, 0.0), size=(240, 180), sample_px=0.5) -> View:
        R = cv2.Rodrigues(np.array(turn, float))[0]
        K = np.array([[230.0, 0, 117], [0, 226.0, 92], [0, 0, 1]])
        pose = np.column_stack([R, -R @ np.array(center, float)])
        grid = np.stack(np.meshgrid(np.linspace(-2, 2, 41), np.linspace(-2, 2, 41)), axis=-1).reshape(-1, 2)
        points = np.column_stack([grid, (plane.distance - grid @ plane.normal[:2]) / plane.normal[2]])
        seen = points @ R.T + pose[:, 3]
        pixels = seen @ K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        ids = np.flatnonzero((seen[:, 2] > 0) & np.all((pixels > 0) & (pixels < size), axis=1))
        return View(name, K, pose, *size, ids.astype(np.int64), points[ids], sample_px)

    return make
