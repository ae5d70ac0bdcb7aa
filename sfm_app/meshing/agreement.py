"""Agreement of photos on a surface, and the displacement of each vertex that would improve it.

A photo is warped through the surface into another one. Where both differ at equal local brightness and contrast, the
surface is too near or too far: the difference divided by its derivative along the viewing ray is the distance (Vu,
Labatut, Pons, Keriven: High accuracy and visibility-consistent dense multiview stereo. PAMI 2012, with a gradient
descent; here in Gauss-Newton steps, which need a tenth of the iterations).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.raster import Raster
from sfm_app.jit import kernel
from sfm_app.types import PosedPhoto
from sfm_app.types.arrays import FloatArray, IndexArray

Gray = NDArray[np.float32]

REACH = 3
"""Pixels from the middle of a window to its border; windows have the same brightness and contrast in both photos.
Chosen on `ornament`."""
NOISE_GRAY = 3.0
"""Standard deviation of gray levels that the surface does not explain. Chosen by hand."""
OUTLIER = 3.0
"""Differences of this many deviations count half (Cauchy). By definition of the weight."""
UNRELATED, RELATED = 0.1, 0.5
"""Correlations of a window at which it counts nothing, and fully. Chosen by hand."""
LEAST_FACING = 0.2
"""Least cosine between the normal and the rays to both photos. Chosen by hand."""


@dataclass(frozen=True, slots=True, eq=False)
class RefinePhoto:
    """A posed photo and its gray levels."""

    posed: PosedPhoto
    gray: NDArray[np.uint8]
    """(H, W)."""
    masked: NDArray[np.bool_] | None = None
    """(H, W) masked pixels."""

    def posed_at(self, share: float) -> PosedPhoto:
        """Return the pose and the camera at a share of the full resolution."""
        width, height = (max(2, round(share * side)) for side in (self.posed.width, self.posed.height))
        return self.posed.resize(width, height)

    def mask_at(self, size: tuple[int, int]) -> NDArray[np.bool_] | None:
        """Return the mask at a size (W, H): pixels of which any part is masked."""
        if self.masked is None:
            return None
        return np.asarray(cv2.resize(self.masked.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0)

    def image_at(self, size: tuple[int, int]) -> Gray:
        """Return (H, W, 3) smooth gray levels at a size (W, H), and their derivatives by x and by y, per pixel."""
        small = self.gray
        if size != small.shape[::-1]:
            small = np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_AREA), np.uint8)
        gray = np.asarray(cv2.GaussianBlur(small.astype(np.float32), (0, 0), 0.6), np.float32)  # chosen on `ornament`
        by_x, by_y = (cv2.Sobel(gray, cv2.CV_32F, *axis, ksize=3, scale=1.0 / 8.0) for axis in ((1, 0), (0, 1)))
        return np.stack([gray, by_x, by_y], axis=-1, dtype=np.float32)


@dataclass(slots=True, eq=False)
class Pull:
    """The cost - 2 g d + h d^2 of the displacement d of each vertex along its normal, in terms of the photos."""

    g: FloatArray
    """(V,)."""
    h: FloatArray
    """(V,)."""
    correlation: float = 0.0
    """Sum of the correlations over pixels."""
    pixels: float = 0.0

    @classmethod
    def zeros(cls, count: int) -> "Pull":
        """Make the pull of no photo on `count` vertices."""
        return cls(np.zeros(count), np.zeros(count))

    def add(self, other: "Pull") -> None:
        """Add the pull of other photos."""
        self.g += other.g
        self.h += other.h
        self.correlation += other.correlation
        self.pixels += other.pixels


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A photo at one resolution, and the surface in it."""

    photo: PosedPhoto
    image: Gray
    """(H, W, 3), see `RefinePhoto.image_at`."""
    raster: Raster


def compare(vertices: FloatArray, faces: IndexArray, normals: Gray, here: Sight, others: Iterable[Sight]) -> Pull:
    """Return the pull of the differences between a photo and others; the normals (T, 3) are those of the triangles."""
    pull, raster, center = Pull.zeros(len(vertices)), here.raster, here.photo.center
    rays = np.linalg.inv(here.photo.projection[:, :3])  # from pixels (x, y, 1) to rays in the world, at depth 1
    shape = raster.depth.shape
    g, h = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    views = np.empty((*shape, 3), np.float32)
    sums = np.empty((7, shape[1]))
    for other in others:
        P = other.photo.projection
        _look_through(
            (raster.depth, raster.face, normals), (P[:, :3] @ rays, P @ np.append(center, 1.0)),
            (rays, center - other.photo.center), (other.image, other.raster.depth), views,
        )  # fmt: skip
        correlation, pixels = _weigh(here.image, views, sums, g, h)
        pull.correlation += correlation
        pull.pixels += pixels
    _sum_up((vertices, faces), (raster.face, raster.depth), (rays, center), (g, h), (pull.g, pull.h))
    return pull


@kernel
def _look_through(surface: Any, homography: Any, eyes: Any, other: Any, views: Gray) -> None:
    """Fill `views` (H, W, 3): gray level of the other photo, its change per displacement, and 1 where visible, else 0.

    `homography` H and p take pixel x at depth z to z H x + p of the other photo. `eyes` are the rays of the photo, and
    its center relative to that of the other. `other` has the image of the other, and the depths of the surface in it.
    """
    depth, face, normals = surface
    H, p = homography
    M, apart = eyes
    image, other_depth = other
    height, width = other_depth.shape
    for i in range(depth.shape[0]):
        y = i + 0.5
        for j in range(depth.shape[1]):
            views[i, j, 0], views[i, j, 1], views[i, j, 2] = 0.0, 0.0, 0.0
            f = face[i, j]
            if f < 0:
                continue
            x, z = j + 0.5, float(depth[i, j])
            hz = H[2, 0] * x + H[2, 1] * y + H[2, 2]
            w = z * hz + p[2]
            if w <= 0.0:
                continue
            hx, hy = H[0, 0] * x + H[0, 1] * y + H[0, 2], H[1, 0] * x + H[1, 1] * y + H[1, 2]
            over = 1.0 / w
            u, v = (z * hx + p[0]) * over, (z * hy + p[1]) * over
            if not (0.5 <= u < width - 0.5 and 0.5 <= v < height - 0.5):
                continue
            col, row = min(int(u - 0.5), width - 2), min(int(v - 0.5), height - 2)
            limit = 0.003 * w  # beyond, the place is hidden from the other photo; by hand
            near = int(abs(other_depth[row, col] - w) <= limit) + int(abs(other_depth[row, col + 1] - w) <= limit)
            near += int(abs(other_depth[row + 1, col] - w) <= limit)
            near += int(abs(other_depth[row + 1, col + 1] - w) <= limit)
            if near < 2:
                continue
            rx, ry = M[0, 0] * x + M[0, 1] * y + M[0, 2], M[1, 0] * x + M[1, 1] * y + M[1, 2]
            rz = M[2, 0] * x + M[2, 1] * y + M[2, 2]
            nx, ny, nz = normals[f, 0], normals[f, 1], normals[f, 2]
            along = nx * rx + ny * ry + nz * rz
            if along >= 0.0 or along * along < LEAST_FACING * LEAST_FACING * (rx * rx + ry * ry + rz * rz):
                continue
            ox, oy, oz = z * rx + apart[0], z * ry + apart[1], z * rz + apart[2]
            across = nx * ox + ny * oy + nz * oz
            if across >= 0.0 or across * across < LEAST_FACING * LEAST_FACING * (ox * ox + oy * oy + oz * oz):
                continue
            # the displacement changes the depth by 1 / (normal ray)
            change = over / along
            du, dv = (hx - u * hz) * change, (hy - v * hz) * change
            a, b = np.float32(u - 0.5 - col), np.float32(v - 0.5 - row)
            for c in range(3):
                upper = image[row, col, c] + a * (image[row, col + 1, c] - image[row, col, c])
                lower = image[row + 1, col, c] + a * (image[row + 1, col + 1, c] - image[row + 1, col, c])
                value = upper + b * (lower - upper)
                if c == 0:
                    views[i, j, 0] = value
                else:
                    views[i, j, 1] += value * (du if c == 1 else dv)
            views[i, j, 2] = 1.0


@kernel
def _weigh(image: Gray, views: Gray, sums: FloatArray, g: Gray, h: Gray) -> tuple[float, float]:
    """Add the cost of each pixel to g and h; return the sum of correlations, and the number of pixels.

    Windows get the same mean and contrast in both photos. `sums` (7, W) is overwritten with sums over the rows of a
    window: pixels, both gray levels, their squares and product, and the slope.
    """
    height, width = views.shape[0], views.shape[1]
    sums[:] = 0.0
    total, count = 0.0, 0.0
    noise = NOISE_GRAY * NOISE_GRAY
    least = 0.6 * (2 * REACH + 1) ** 2  # pixels of a window that both photos see; by hand
    for i in range(-REACH, height):
        if i + REACH < height:
            _add_row(image, views, i + REACH, 1.0, sums)
        if i > REACH:
            _add_row(image, views, i - REACH - 1, -1.0, sums)
        if i < 0:
            continue
        n, a, b, aa, bb, ab, s = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(-REACH, width):
            if j + REACH < width:
                k = j + REACH
                n, a, b, aa = n + sums[0, k], a + sums[1, k], b + sums[2, k], aa + sums[3, k]
                bb, ab, s = bb + sums[4, k], ab + sums[5, k], s + sums[6, k]
            if j > REACH:
                k = j - REACH - 1
                n, a, b, aa = n - sums[0, k], a - sums[1, k], b - sums[2, k], aa - sums[3, k]
                bb, ab, s = bb - sums[4, k], ab - sums[5, k], s - sums[6, k]
            if j < 0 or views[i, j, 2] == 0.0:
                continue
            one = 1.0 / n
            mean, other = a * one, b * one
            variance, other_variance = (
                max(aa * one - mean * mean, 0.0) + noise,
                max(bb * one - other * other, 0.0) + noise,
            )
            gain = np.sqrt(variance / other_variance)
            correlation = (ab * one - mean * other) / (gain * other_variance)
            total += correlation
            count += 1.0
            related = min((correlation - UNRELATED) / (RELATED - UNRELATED), 1.0)
            if n < least or related <= 0.0:
                continue
            off = (image[i, j, 0] - mean) - gain * (views[i, j, 0] - other)
            slope = gain * (views[i, j, 1] - s * one)
            deviations = off / (OUTLIER * NOISE_GRAY)
            weight = related / ((1.0 + deviations * deviations) * (2.0 * noise))
            g[i, j] += weight * slope * off
            h[i, j] += weight * slope * slope
    return total, count


@kernel
def _add_row(image: Gray, views: Gray, i: int, sign: float, sums: FloatArray) -> None:
    """Add a row to the sums over rows, or take it away."""
    for j in range(views.shape[1]):
        if views[i, j, 2] > 0.0:
            a, b = float(image[i, j, 0]), float(views[i, j, 0])
            sums[0, j] += sign
            sums[1, j] += sign * a
            sums[2, j] += sign * b
            sums[3, j] += sign * (a * a)
            sums[4, j] += sign * (b * b)
            sums[5, j] += sign * (a * b)
            sums[6, j] += sign * views[i, j, 1]


@kernel
def _sum_up(mesh: Any, raster: Any, eye: Any, costs: Any, sums: Any) -> None:
    """Add the cost of each pixel to the corners of its triangle, by its place on it."""
    vertices, faces = mesh
    face, depth = raster
    M, center = eye
    g, h = costs
    whole_g, whole_h = sums
    for i in range(face.shape[0]):
        y = i + 0.5
        for j in range(face.shape[1]):
            if h[i, j] <= 0.0:
                continue
            x, z = j + 0.5, float(depth[i, j])
            a, b, c = faces[face[i, j], 0], faces[face[i, j], 1], faces[face[i, j], 2]
            second, third = _weights(
                vertices[a], vertices[b], vertices[c],
                (
                    center[0] + z * (M[0, 0] * x + M[0, 1] * y + M[0, 2]),
                    center[1] + z * (M[1, 0] * x + M[1, 1] * y + M[1, 2]),
                    center[2] + z * (M[2, 0] * x + M[2, 1] * y + M[2, 2]),
                ),
            )  # fmt: skip
            first = 1.0 - second - third
            whole_g[a] += first * g[i, j]
            whole_g[b] += second * g[i, j]
            whole_g[c] += third * g[i, j]
            whole_h[a] += first * h[i, j]
            whole_h[b] += second * h[i, j]
            whole_h[c] += third * h[i, j]


@kernel
def _weights(a: FloatArray, b: FloatArray, c: FloatArray, place: tuple[float, float, float]) -> tuple[float, float]:
    """Return the weights of the second and the third corner of a triangle at a place on it, within [0, 1]."""
    bb, cc, bc, bp, cp = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        to_b, to_c, to_p = b[k] - a[k], c[k] - a[k], place[k] - a[k]
        bb += to_b * to_b
        cc += to_c * to_c
        bc += to_b * to_c
        bp += to_b * to_p
        cp += to_c * to_p
    area = max(bb * cc - bc * bc, 1e-300)
    second = min(max((cc * bp - bc * cp) / area, 0.0), 1.0)
    return second, min(max((bb * cp - bc * bp) / area, 0.0), 1.0 - second)
