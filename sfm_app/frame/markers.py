"""Printed markers: the page, their corners in photos, and their size in the model."""

import io
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
from PIL import Image

from sfm_app.errors import ConfigError, InputError
from sfm_app.files import replace_atomically
from sfm_app.frame.scale import ScaleEvidence
from sfm_app.frame.sighted_points import Sight, SightedPoint, locate_point
from sfm_app.geometry.poses import umeyama
from sfm_app.numerical import MAD_TO_SIGMA
from sfm_app.types.arrays import BoolArray, ByteArray, FloatArray
from sfm_app.wording import format_length

AUTO = "auto"
FAMILIES = MappingProxyType({
    "apriltag-36h11": "DICT_APRILTAG_36h11", "aruco-6x6": "DICT_6X6_250", "aruco-5x5": "DICT_5X5_250",
    "aruco-4x4": "DICT_4X4_50", "aruco-7x7": "DICT_7X7_250", "aruco-original": "DICT_ARUCO_ORIGINAL",
    "apriltag-25h9": "DICT_APRILTAG_25h9", "apriltag-16h5": "DICT_APRILTAG_16h5", "aruco-4x4-1000": "DICT_4X4_1000",
    "aruco-5x5-1000": "DICT_5X5_1000", "aruco-6x6-1000": "DICT_6X6_1000", "aruco-7x7-1000": "DICT_7X7_1000",
    "aruco-mip-36h12": "DICT_ARUCO_MIP_36h12",
})  # fmt: skip
"""OpenCV's dictionaries, by our names."""
TRIED = ("apriltag-36h11", "aruco-6x6", "aruco-5x5", "aruco-4x4", "aruco-7x7")
"""Families that `auto` looks for; families of few bits and many markers are found in brickwork or windows."""
UNKNOWNS = 9
"""Eight of a homography, and the shift of all edges towards their dark side. By definition."""


class OPTIONS:
    """Constants of the fit of patterns to photos."""

    along: tuple[float, ...] = (0.25, 0.5, 0.75)
    """Positions of the measurements on an edge of a cell, as shares of its length."""
    steps: int = 21
    """Samples of a profile from the middle of a light cell to the middle of the dark one beside it."""
    rounds: int = 4
    min_share: float = 0.75
    """Least share of the pattern's edges that agree. Chosen by hand: other markers of a family reach two thirds."""
    min_contrast: float = 0.3
    """Least contrast of an edge, as a share of the median: shadows and glare hide some. Chosen by hand."""
    max_rms_cells: float = 0.25
    """Largest scatter of the edges about the pattern, in cells. Chosen by hand: noise and blur reach a tenth, another
    pattern a half."""
    edge_bias_px: float = 0.05
    """Standard deviation of the remaining bias of a side's length: 0.014 to 0.1 for markers of 30 to 45 pixels and blur
    of 0.5 to 1.5, less for larger ones; on rendered photos, as in the unit tests."""
    max_shape_error: float = 0.05
    """Largest distance of a corner from the square, in sides. Chosen by hand: a wrong detection, or one number in two
    places, is off by a side or more."""


# Corners, to a few hundredths of a pixel by all edges of the pattern.
# Detectors look for the outer contour. Blur and the camera's tone curve move every edge towards its dark side, so that
# a contour is half a pixel too small: 1 % of a marker of 50 pixels. A pattern has edges with the dark side on either
# side and above and below, which separate this shift from the size.


def fit_pattern(gray: ByteArray, pattern: ByteArray, corners: FloatArray) -> FloatArray | None:
    """Return the corners (4, 2) of a pattern in a photo (H, W), by all edges of the pattern; None if too few agree.

    The cells (N, N) with the dark border are 0 or 255. The given corners are exact to a pixel or two, clockwise from
    the pattern's own top left, pixel centers at +0.5.
    """
    light, dark = edge_sides(pattern)
    middle, cells = (light + dark) / 2, float(len(pattern))
    square = np.array([[0.0, 0.0], [cells, 0.0], [cells, cells], [0.0, cells]])
    H = cv2.getPerspectiveTransform(square.astype(np.float32), corners.astype(np.float32)).astype(np.float64)
    edges, rms = 0, np.inf
    for _ in range(OPTIONS.rounds):
        crossings, contrast = _crossings(gray, _project(H, light), _project(H, dark))
        normals = _normals(H, middle, dark - light)
        residuals = np.einsum("ni,ni->n", normals, crossings - _project(H, middle))
        usable = np.isfinite(residuals) & (contrast > OPTIONS.min_contrast * max(float(np.median(contrast)), 1.0))
        if usable.sum() < OPTIONS.min_share * len(middle):
            return None
        J = np.column_stack([_derivatives(H, middle, normals), np.ones(len(middle))])
        step, edges, rms = _solve_robustly(J[usable], residuals[usable])
        H = H + np.append(step[:8], 0.0).reshape(3, 3)
    corners = _project(H, square)
    if not np.isfinite(corners).all():
        return None
    cell_px = np.sqrt(cv2.contourArea(corners.astype(np.float32))) / cells
    if edges < OPTIONS.min_share * len(middle) or rms > OPTIONS.max_rms_cells * cell_px:
        return None
    return corners


def edge_sides(pattern: ByteArray) -> tuple[FloatArray, FloatArray]:
    """Return points (E, 2), x and y in cells, in the light and the dark cells beside each edge of a pattern (N, N)."""
    lit = np.pad(pattern > 127, 1, constant_values=True)
    light, dark = [], []
    for row, column in np.argwhere(lit):
        for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            neighbor = row + down, column + right
            if min(neighbor) < 0 or max(neighbor) >= len(lit) or lit[neighbor]:
                continue
            for share in OPTIONS.along:
                offset = np.array([0.5, share] if right else [share, 0.5])
                point = np.array([column - 1.0, row - 1.0]) + offset
                light.append(point)
                dark.append(point + np.array([right, down], np.float64))
    return np.array(light).reshape(-1, 2), np.array(dark).reshape(-1, 2)


def _crossings(gray: ByteArray, light: FloatArray, dark: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points (E, 2) where profiles cross their middle gray level, NaN without one, and the contrast (E,)."""
    along = np.linspace(0.0, 1.0, OPTIONS.steps)
    places = (light[:, None] + along[None, :, None] * (dark - light)[:, None]).astype(np.float32) - np.float32(0.5)
    levels = cv2.remap(gray, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    profile = np.asarray(levels, np.float64)
    contrast = profile[:, 0] - profile[:, -1]
    below = profile < ((profile[:, 0] + profile[:, -1]) / 2)[:, None]
    after = np.maximum(below.argmax(axis=1), 1)
    rows = np.arange(len(profile))
    high, low = profile[rows, after - 1], profile[rows, after]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (high - (profile[:, 0] + profile[:, -1]) / 2) / (high - low)
    share[~below.any(axis=1)] = np.nan
    crossing = (after - 1 + share) / (OPTIONS.steps - 1)
    return light + crossing[:, None] * (dark - light), contrast


def _project(H: FloatArray, points: FloatArray) -> FloatArray:
    mapped = np.column_stack([points, np.ones(len(points))]) @ H.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def _normals(H: FloatArray, middle: FloatArray, across: FloatArray) -> FloatArray:
    """Return unit normals (E, 2) of the edges in the photo, towards their dark side."""
    edge = 0.5 * np.column_stack([-across[:, 1], across[:, 0]])
    tangents = _project(H, middle + edge) - _project(H, middle - edge)
    normals = np.column_stack([tangents[:, 1], -tangents[:, 0]])
    towards = _project(H, middle + 0.5 * across) - _project(H, middle)
    normals *= np.sign(np.einsum("ni,ni->n", normals, towards))[:, None]
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _derivatives(H: FloatArray, points: FloatArray, normals: FloatArray) -> FloatArray:
    """Return derivatives (E, 8) of the projections along the normals by the first eight entries of H."""
    homogeneous = np.column_stack([points, np.ones(len(points))])
    mapped = homogeneous @ H.T
    x = mapped[:, :2] / mapped[:, 2:]
    rows = homogeneous / mapped[:, 2:]
    by_last = -np.einsum("ni,ni->n", normals, x)[:, None] * rows[:, :2]
    return np.hstack([normals[:, :1] * rows, normals[:, 1:] * rows, by_last])


def _solve_robustly(J: FloatArray, r: FloatArray) -> tuple[FloatArray, int, float]:
    """Solve J step = r without outliers; return the step, the number of inliers, and their scatter."""
    inliers = np.ones(len(r), bool)
    units = np.maximum(np.abs(J).max(axis=0), 1e-12)
    for _ in range(3):
        step = np.linalg.lstsq(J[inliers] / units, r[inliers], rcond=None)[0] / units
        errors = r - J @ step
        sigma = MAD_TO_SIGMA * float(np.median(np.abs(errors[inliers])))
        inliers = np.abs(errors) <= max(3.0 * sigma, 1e-3)
    freedom = max(int(inliers.sum()) - UNKNOWNS, 1)
    return step, int(inliers.sum()), float(np.sqrt((errors[inliers] ** 2).sum() / freedom))


@dataclass(frozen=True, slots=True, eq=False)
class DetectedMarker:
    """A marker in one photo."""

    family: str
    number: int
    corners: FloatArray
    """(4, 2) in pixels, clockwise from the marker's own top left; pixel centers at +0.5."""

    @property
    def name(self) -> str:
        """Name of the marker in messages."""
        return f"{self.family} {self.number}"


def find_markers_in_file(photo_dir: Path, family: str, name: str) -> list[DetectedMarker]:
    """Return the markers of a family, or of `AUTO`, in a photo; none if it cannot be read."""
    try:
        with Image.open(photo_dir / name) as image:
            gray = np.asarray(image.convert("L"))
    except OSError:
        return []
    return find_markers(gray, TRIED if family == AUTO else (family,))


def find_markers(gray: ByteArray, families: Sequence[str]) -> list[DetectedMarker]:
    """Return the markers of some families in a photo (H, W), with corners from all edges of their patterns."""
    options = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    markers: list[DetectedMarker] = []
    for family in families:
        dictionary = load_dictionary(family)
        corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary, options).detectMarkers(gray)
        for outline, number in zip(corners, [] if numbers is None else numbers.ravel(), strict=True):
            pattern = draw_pattern(family, int(number))
            fitted = fit_pattern(gray, pattern, np.asarray(outline, np.float64).reshape(4, 2) + 0.5)
            if fitted is not None:
                markers.append(DetectedMarker(family, int(number), fitted))
    return markers


def load_dictionary(family: str) -> cv2.aruco.Dictionary:
    """Return OpenCV's dictionary of a family."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILIES[family]))


def draw_pattern(family: str, number: int) -> ByteArray:
    """Return the (N, N) cells of a marker with its dark border, 0 or 255."""
    dictionary = load_dictionary(family)
    return np.asarray(cv2.aruco.generateImageMarker(dictionary, number, dictionary.markerSize + 2), np.uint8)


PAGES_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
"""Width and height of a sheet of paper, by its name."""


class PAGE:
    """Layout of a page of markers."""

    margin_mm: float = 10.0
    label_mm: float = 6.0
    """Height of the line of text below a marker."""
    ruler_mm: float = 100.0
    """Length of the ruler to check the printer by."""
    max_markers: int = 12


def write_marker_page(
    path: Path, side_m: float, family: str = "apriltag-36h11", first: int = 0, paper: str = "a4"
) -> int:
    """Write a page of markers, dark squares of `side_m` meters, to a PDF or SVG file, and return their number.

    Raise a ConfigError if no marker fits on the page, an InputError if the file cannot be written.
    """
    if path.suffix.lower() not in (".pdf", ".svg"):
        raise ConfigError(f"a page of markers is a PDF or SVG file, not {path.name}", hint="write -o markers.pdf")
    places = marker_places(side_m, len(draw_pattern(family, 0)), paper)
    count = len(load_dictionary(family).bytesList)
    places = places[: max(min(PAGE.max_markers, count - first), 0)]
    if not places:
        size = format_length(side_m)
        raise ConfigError(f"no marker of {size} fits on {paper}, or none has number {first}", hint="choose others")
    data = _draw(places, side_m * 1000.0, family, first, paper, path.suffix.lower().removeprefix("."))
    try:
        with replace_atomically(path) as target:
            target.write_bytes(data)
    except OSError as err:
        raise InputError(f"cannot write {path}: {err.strerror}", hint="name another file with -o") from err
    return len(places)


def marker_places(side_m: float, cells: int, paper: str) -> list[tuple[float, float]]:
    """Return the lower left corners, in mm, of as many markers as fit on a page, with a light cell around each."""
    (width, height), margin, label = PAGES_MM[paper], PAGE.margin_mm, PAGE.label_mm
    side = side_m * 1000.0
    step = side * (1.0 + 2.0 / cells)
    across = int((width - 2 * margin) / step)
    down = int((height - 3 * margin - label) / (step + label))
    left = (width - across * step) / 2 + side / cells
    tops = [height - margin - row * (step + label) - step + side / cells for row in range(down)]
    return [(left + column * step, top) for top in tops for column in range(across)]


def _draw(places: list[tuple[float, float]], side: float, family: str, first: int, paper: str, suffix: str) -> bytes:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    (width, height), margin, ruler = PAGES_MM[paper], PAGE.margin_mm, PAGE.ruler_mm
    figure = Figure(figsize=(width / 25.4, height / 25.4))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0, width), ylim=(0, height), aspect="equal")
    axes.set_axis_off()
    for number, (x, y) in enumerate(places, start=first):
        pattern = draw_pattern(family, number)
        axes.fill(*_dark_bars(pattern, x, y, side), color="black", linewidth=0)
        label = f"{family} {number}, side {format_length(side / 1000.0)}"
        axes.text(x, y - side / len(pattern) - 1.0, label, fontsize=7, va="top")
    axes.plot([margin, margin + ruler], [margin] * 2, color="black", linewidth=0.5)
    for tick in range(0, int(ruler) + 1, 10):
        axes.plot([margin + tick] * 2, [margin, margin + 2.0], color="black", linewidth=0.5)
    note = f"Print at 100 %. This ruler has {ruler:.0f} mm: measure it, and the dark squares. Glue them to stiff card."
    axes.text(margin, margin + 3.0, note, fontsize=7)
    file = io.BytesIO()
    undated = {"CreationDate": None} if suffix == "pdf" else {"Date": None}
    with rc_context({"svg.hashsalt": family}):  # random names otherwise
        figure.savefig(file, format=suffix, metadata=undated)
    return file.getvalue()


def _dark_bars(pattern: ByteArray, x: float, y: float, side: float) -> list[FloatArray]:
    """Return x and y of the dark bars, alternating, for `Axes.fill`; rows and columns cover each other's seams."""
    cells = len(pattern)
    bars = [(row, row + 1, *bar) for row in range(cells) for bar in _runs(pattern[row] < 128)]
    bars += [(*bar, column, column + 1) for column in range(cells) for bar in _runs(pattern[:, column] < 128)]
    outlines: list[FloatArray] = []
    for top, bottom, left, right in bars:
        outlines.append(x + side / cells * np.array([left, right, right, left], np.float64))
        outlines.append(y + side / cells * (cells - np.array([top, top, bottom, bottom], np.float64)))
    return outlines


def _runs(dark: BoolArray) -> list[tuple[int, int]]:
    steps = np.diff(np.concatenate([[0], dark.astype(np.int8), [0]]))
    return list(zip(np.flatnonzero(steps > 0).tolist(), np.flatnonzero(steps < 0).tolist(), strict=True))


SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
"""Corners of a marker of side 1 about its middle, clockwise from its own top left."""


def marker_scales(
    markers: Mapping[str, Sequence[DetectedMarker]], rays: Mapping[str, Sequence[Sequence[Sight]]], side_m: float
) -> tuple[list[ScaleEvidence], dict[str, str]]:
    """Return the scale by each marker, and the reason for each unusable marker by name.

    `rays` holds by photo, for each of its markers, the rays of the four corners. `side_m` is that of a dark square.
    """
    sights: dict[str, list[Sequence[Sight]]] = defaultdict(list)
    sizes: dict[str, list[float]] = defaultdict(list)
    for photo, detected in markers.items():
        names = [marker.name for marker in detected]
        for marker, corners in zip(detected, rays[photo], strict=True):
            if names.count(marker.name) == 1:  # two of one number in a photo are ambiguous
                sights[marker.name].append(corners)
                sizes[marker.name].append(side_px(marker.corners))
    evidence: list[ScaleEvidence] = []
    unusable: dict[str, str] = {}
    for name in sorted(sights):
        scale = _measure_marker(name, sights[name], float(np.median(sizes[name])), side_m)
        if isinstance(scale, str):
            unusable[name] = scale
        else:
            evidence.append(scale)
    return evidence, unusable


def side_px(corners: FloatArray) -> float:
    """Return the mean side of a quadrilateral (4, 2)."""
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())


def _measure_marker(name: str, sights: Sequence[Sequence[Sight]], size_px: float, side_m: float) -> ScaleEvidence | str:
    corners: list[SightedPoint] = []
    for k in range(4):
        point = locate_point([photo[k] for photo in sights])
        if isinstance(point, str):
            return point.replace("it is marked", "it is seen")
        corners.append(point)
    places = np.array([corner.place for corner in corners])
    fit = umeyama(SQUARE, places)
    error = np.linalg.norm(fit(SQUARE) - places, axis=1).max() / fit.scale
    if error > OPTIONS.max_shape_error:
        return f"it is no square in the model: a corner is off by {100 * error:.0f} % of its side; one number twice?"
    # the side is linear in the corners: s = sum a'R'b / sum a'a
    arms = SQUARE @ fit.R.T / (SQUARE**2).sum()
    variance = sum(arm @ corner.covariance @ arm for arm, corner in zip(arms, corners, strict=True))
    deviation = float(np.hypot(np.sqrt(variance) / fit.scale, OPTIONS.edge_bias_px / size_px))
    return ScaleEvidence(f"marker {name}", side_m / fit.scale, deviation, min(len(one.photos) for one in corners))
