#!/usr/bin/env python3
"""Draw the figures of docs/concepts from the program's own code: python docs/figures/concepts.py"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

import sfm_app
from sfm_app.geometry.epipolar import fundamental_from_pose, to_homogeneous
from sfm_app.selfcal.consensus import Consensus
from sfm_app.selfcal.pairs import prepare
from sfm_app.selfcal.thesis.curves import focal_curves
from sfm_app.synthetic.cameras import Camera, arc, make_camera, pixel_rays
from sfm_app.synthetic.correspondences import TrackOptions, make_tracks
from sfm_app.synthetic.render import GAMMA, cast_rays, render_scene
from sfm_app.synthetic.render import prepare as prepare_scene
from sfm_app.synthetic.scenes import courtyard
from sfm_app.types import CameraPairs
from sfm_app.types.scene import camera_center

FloatArray = NDArray[np.float64]
PICTURES = Path(__file__).parents[1] / "pictures"
RIGHT, WRONG, LINE = "#0a7d55", "#d1495b", "#1f6fb2"
"""Colors that stay apart for color-blind readers."""


class TwoPhotos:
    """Two rendered photos of the courtyard, and where its points lie in both."""

    def __init__(self) -> None:
        views = arc(make_camera(720, 480))
        first, second = (sorted(views.cam_from_world)[k] for k in (4, 6))
        self.camera: Camera = views.cameras[first]
        self.poses = views.cam_from_world[first], views.cam_from_world[second]
        self.scene = prepare_scene(courtyard())
        self.photos = [np.clip(render_scene(self.scene, self.camera, pose), 0, 1) ** (1 / GAMMA) for pose in self.poses]

    @property
    def F(self) -> FloatArray:
        """(3, 3) true fundamental matrix."""
        (R1, t1), (R2, t2) = ((pose[:, :3], pose[:, 3]) for pose in self.poses)
        R = R2 @ R1.T
        return fundamental_from_pose(self.camera.K, self.camera.K, R, t2 - R @ t1)

    def see(self, x: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return where pixels (N, 2) of photo 1 lie in photo 2, and whether they are in it."""
        rays = pixel_rays(self.camera)[self.camera.width * x[:, 1].astype(int) + x[:, 0].astype(int)]
        pose = self.poses[0]
        center, directions = camera_center(pose), rays @ pose[:, :3]
        reach = cast_rays(self.scene.rays, center, directions)["t_hit"].astype(np.float64)
        seen = np.isfinite(reach)
        X = center + np.where(seen, reach, 1.0)[:, None] * directions
        y = (X @ self.poses[1][:, :3].T + self.poses[1][:, 3]) @ self.camera.K.T
        y = y[:, :2] / y[:, 2:]
        size = self.camera.width, self.camera.height
        return y, seen & ((y > 0) & (y < size)).all(axis=1)


def draw_epipolar_lines(two: TwoPhotos) -> None:
    """Draw points of one photo, and the lines on which they must lie in the other."""
    x = np.array([[172.0, 245.0], [396.0, 225.0], [416.0, 335.0], [528.0, 240.0]])
    y, _ = two.see(x)
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    colors = ("#ffd166", "#06d6a0", "#ef476f", "#4cc9f0")
    for part, photo, title in zip(
        axes, two.photos, ("photo 1: four places", "photo 2: where each of them must lie"), strict=True
    ):
        part.imshow(photo, extent=(0, two.camera.width, two.camera.height, 0))
        part.set(title=title, xticks=[], yticks=[], xlim=(0, two.camera.width), ylim=(two.camera.height, 0))
    for place, partner, (a, b, c), color in zip(x, y, to_homogeneous(x) @ two.F.T, colors, strict=True):
        axes[0].plot(*place, "o", color=color, markersize=8, markeredgecolor="black")
        ends = np.array([0.0, two.camera.width])
        axes[1].plot(ends, -(c + a * ends) / b, color=color, linewidth=2)
        axes[1].plot(*partner, "o", color=color, markersize=8, markeredgecolor="black")
    save(figure, "epipolar-lines.jpg")


def draw_matches(two: TwoPhotos) -> None:
    """Draw matches of which half are wrong, how far LEV-RANSAC trusts each, and what it keeps."""
    rng = np.random.default_rng(3)
    size = np.array([two.camera.width, two.camera.height])
    x1 = np.floor(rng.uniform(4, size - 4, (900, 2))) + 0.5
    x2, seen = two.see(x1)
    x1, x2 = x1[seen][:300], x2[seen][:300] + rng.normal(0, 0.5, (min(int(seen.sum()), 300), 2))
    wrong = rng.permutation(len(x1))[: len(x1) // 2]
    x2[wrong] = rng.uniform(0, size, (len(wrong), 2))
    fit = sfm_app.estimate_fundamental(x1, x2, seed=0)
    if not fit:
        raise SystemExit(fit.reason)
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.1), layout="constrained")
    titles = (
        f"{len(x1)} matches, half of them wrong",
        "how far each is trusted",
        f"what agrees: {fit.inlier_count} matches",
    )
    shades = np.ones(len(x1)), fit.priors, fit.inliers.astype(float)
    for part, title, shade in zip(axes, titles, shades, strict=True):
        part.imshow(two.photos[0], extent=(0, *size[:1], *size[1:], 0), alpha=0.45)
        for (u1, v1), (u2, v2), value in zip(x1, x2, shade, strict=True):
            if value > 0.02:
                part.plot(
                    [u1, u2],
                    [v1, v2],
                    color=LINE if shade is shades[0] else RIGHT,
                    linewidth=0.9,
                    alpha=float(max(value, 0.08)),
                )
        part.set(title=title, xticks=[], yticks=[], xlim=(0, size[0]), ylim=(size[1], 0))
    right = np.setdiff1d(np.arange(len(x1)), wrong)
    kept = fit.inliers[right].sum(), fit.inliers[wrong].sum()
    print(f"kept: {kept[0]} of {len(right)} right matches, {kept[1]} of {len(wrong)} wrong ones, {fit.trials} samples")
    save(figure, "matches.jpg")


def draw_influence() -> None:
    """Draw a line through points, one of which lies far out, and the influence of each on it."""
    rng = np.random.default_rng(5)
    x = np.append(np.sort(rng.uniform(0, 5, 14)), 10.0)
    y = 1.0 + 0.5 * x + rng.normal(0, 0.25, len(x))
    y[-1] -= 3.2
    A = np.column_stack([np.ones_like(x), x])
    hat = A @ np.linalg.solve(A.T @ A, A.T)
    residuals, leverage = y - hat @ y, np.diag(hat)
    variance = (residuals**2).sum() / (len(x) - 2)
    cook = residuals**2 / (2 * variance) * leverage / (1 - leverage) ** 2
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    reach = np.array([0.0, 10.5])
    for keep, color, label in (
        (np.ones(len(x), bool), WRONG, "line through all points"),
        (np.arange(len(x)) < len(x) - 1, RIGHT, "line without the last one"),
    ):
        a, b = np.linalg.lstsq(A[keep], y[keep], rcond=None)[0]
        axes[0].plot(reach, a + b * reach, color=color, label=label)
    axes[0].plot(x, y, "o", color="black", markersize=5)
    axes[0].legend(frameon=False)
    axes[0].set(title="one wrong point far out turns the line", xticks=[], yticks=[])
    axes[1].bar(np.arange(1, len(x) + 1), cook, color=[RIGHT] * (len(x) - 1) + [WRONG])
    axes[1].set(title="Cook's distance: how much each point moves it", xlabel="point", yticks=[])
    save(figure, "influence.png")


def draw_zero_curves() -> None:
    """Draw the zero curves of ten pairs, two of them wrong, and how many pairs each focal length satisfies."""
    tracks = make_tracks(TrackOptions(corrupted_pairs=2, outliers=0.6, sigma_px=0.5, aspect=(1.0, 1.0)), seed=4)
    Fs, broken = [], []
    for pair, views in tracks.pairs.items():
        fit = sfm_app.estimate_fundamental(views.x1, views.x2, seed=1)
        rng = np.random.default_rng(pair[1])
        broken.append(pair in tracks.corrupted)
        Fs.append(views.F + 0.12 * rng.normal(size=(3, 3)) * np.abs(views.F) if broken[-1] or not fit else fit.F)
    width, height = tracks.size
    true = tracks.K[0, 0, 0] / width, tracks.K[0, 1, 1] / width
    pairs = prepare(CameraPairs.from_Fs(np.array(Fs), tracks.size), unit_px=width, origin_px=(width / 2, height / 2))
    center = (tracks.K[0, 0, 2] / width - 0.5, tracks.K[0, 1, 2] / width - 0.5 * height / width)
    fx = np.linspace(0.4, 3.0, 700)
    curves = focal_curves(pairs, fx, center)
    figure, axes = plt.subplots(1, 2, figsize=(8, 4), layout="constrained")
    curve_parts(axes[0], fx, curves[:1], [False])
    axes[0].set(title="one pair: a curve of possible cameras")
    curve_parts(axes[1], fx, curves, broken)
    axes[1].plot(*true, "o", markersize=14, fillstyle="none", color="black", markeredgewidth=1.5)
    axes[1].set(title="ten pairs: eight meet, two do not")
    for part in axes:
        part.set(
            xlim=(0.4, 3.0),
            ylim=(0.4, 3.0),
            xlabel="focal length across, in photo widths",
            ylabel="focal length down",
            aspect="equal",
        )
    save(figure, "zero-curves.png")
    figure, part = plt.subplots(figsize=(6, 2.8), layout="constrained")
    votes(part, pairs, center, true[0])
    save(figure, "votes.png")


def curve_parts(part: Any, fx: FloatArray, curves: FloatArray, broken: list[bool]) -> None:
    """Draw curves without the jumps from one root to another."""
    for curve, wrong in zip(curves, broken, strict=True):
        y = np.where((curve > 0.05) & (np.abs(np.gradient(curve)) < 0.08), curve, np.nan)
        part.plot(fx, y, color=WRONG if wrong else LINE, linewidth=1.3, linestyle="--" if wrong else "-")


def votes(part: Any, pairs: Any, center: tuple[float, float], true: float) -> None:
    """Draw how many pairs agree with each focal length."""
    focals = np.geomspace(0.4, 3.0, 500)
    thetas = np.column_stack([np.log(focals), np.full((500, 2), center), np.zeros(500)])
    counts = Consensus(pairs, np.inf, np.ones(len(pairs))).evaluate(thetas, 0.03)
    part.fill_between(focals, counts, color=LINE, alpha=0.25)
    part.plot(focals, counts, color=LINE)
    part.axvline(true, color="black", linestyle=":", label="true focal length")
    part.legend(frameon=False)
    part.set(
        title="pairs that agree with a focal length",
        xlabel="focal length, in photo widths",
        ylabel="votes",
        xlim=(0.4, 3.0),
        ylim=(0, None),
    )


def save(figure: Any, name: str) -> None:
    """Write a figure into docs/pictures."""
    PICTURES.mkdir(exist_ok=True)
    more = {"pil_kwargs": {"quality": 82}} if name.endswith(".jpg") else {"metadata": {"Software": None}}
    figure.savefig(PICTURES / name, dpi=110, **more)
    plt.close(figure)
    print(name, (PICTURES / name).stat().st_size // 1000, "kB")


if __name__ == "__main__":
    photos = TwoPhotos()
    drawings: tuple[Callable[[], None], ...] = (
        lambda: draw_epipolar_lines(photos), lambda: draw_matches(photos), draw_influence, draw_zero_curves,
    )  # fmt: skip
    for draw in drawings:
        draw()
