"""Printed markers: the page, their corners in photos, and their size in the model."""

import io
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.errors import ConfigError, InputError
from sfm_app.files import replace_atomically
from sfm_app.frame.scale import ScaleEvidence
from sfm_app.frame.sighted_points import Sight, SightedPoint, locate_point
from sfm_app.geometry.poses import umeyama
from sfm_app.numerical import MAD_TO_SIGMA
from sfm_app.types.arrays import FloatArray
from sfm_app.wording import format_length

# Find the corners of a marker in a photo to a few hundredths of a pixel, by all edges of its pattern.
#
# Detectors look for the outer contour. Blur and the tone curve of a camera move every edge towards its dark side,
# so a contour comes out half a pixel too small: 1 % of a marker of 50 pixels. A pattern has edges with the dark
# side on the left and on the right, above and below, which tell this shift from the size.

ALONG = (0.25, 0.5, 0.75)
"""Where an edge of a cell is measured, as shares of its length."""
STEPS = 21
"""Samples of a profile from the middle of a light cell to the middle of the dark one beside it."""
ROUNDS = 4
UNKNOWNS = 9
"""Eight of a homography, and the shift of all edges towards their dark side."""
LEAST_SHARE = 0.75
"""Least share of the pattern's edges that are seen where they should be. Chosen by hand: another marker of the family
has two thirds of them, its border included."""
LEAST_CONTRAST = 0.3
"""Least contrast of an edge that is used, as a share of the median: shadows and glare hide some. Chosen by hand."""
MAX_RMS_CELLS = 0.25
"""Largest scatter of the edges about the pattern, in cells. Chosen by hand: noise and blur reach a tenth, another
pattern a half."""
LEAST_SIGMA_PX = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class FittedMarker:
    """The pattern of a marker, fitted to a photo."""

    corners: FloatArray
    """(4, 2) in pixels, clockwise from the pattern's own top left; pixel centers at +0.5."""
    sigma_px: float
    """Standard deviation of a corner, from the scatter of the edges."""


def fit_pattern(gray: NDArray[np.uint8], pattern: NDArray[np.uint8], corners: FloatArray) -> FittedMarker | None:
    """Fit the edges of a pattern to a photo, beginning with corners that are exact to a pixel or two.

    Args:
        gray: (H, W) photo.
        pattern: (N, N) cells of the marker with its dark border, 0 or 255; what surrounds it is light.
        corners: (4, 2) in pixels, clockwise from the pattern's own top left; pixel centers at +0.5.

    Returns:
        The corners; None where too few edges are seen, or they are those of another pattern.
    """
    light, dark = edge_sides(pattern)
    middle, cells = (light + dark) / 2, float(len(pattern))
    square = np.array([[0.0, 0.0], [cells, 0.0], [cells, cells], [0.0, cells]])
    H = cv2.getPerspectiveTransform(square.astype(np.float32), corners.astype(np.float32)).astype(np.float64)
    edges, rms = 0, np.inf
    for _ in range(ROUNDS):
        seen, contrast = _crossings(gray, _project(H, light), _project(H, dark))
        normals = _normals(H, middle, dark - light)
        off = np.einsum("ni,ni->n", normals, seen - _project(H, middle))
        usable = np.isfinite(off) & (contrast > LEAST_CONTRAST * max(float(np.median(contrast)), 1.0))
        if usable.sum() < LEAST_SHARE * len(middle):
            return None
        J = np.column_stack([_derivatives(H, middle, normals), np.ones(len(middle))])
        step, edges, rms = _solve_robustly(J[usable], off[usable])
        H = H + np.append(step[:8], 0.0).reshape(3, 3)
    found = _project(H, square)
    if not np.isfinite(found).all():
        return None
    cell_px = np.sqrt(cv2.contourArea(found.astype(np.float32))) / cells
    if edges < LEAST_SHARE * len(middle) or rms > MAX_RMS_CELLS * cell_px:
        return None
    # a corner is as sure as the two sides that meet in it, each measured by a share of the edges
    return FittedMarker(found, max(float(rms * np.sqrt(UNKNOWNS / edges)), LEAST_SIGMA_PX))


def edge_sides(pattern: NDArray[np.uint8]) -> tuple[FloatArray, FloatArray]:
    """Return points (E, 2) in light cells, x and y in cells, and those in the dark ones beside them, across an edge.

    Args:
        pattern: (N, N) cells of the marker, 0 or 255; what surrounds it is light.
    """
    lit = np.pad(pattern > 127, 1, constant_values=True)
    light, dark = [], []
    for row, column in np.argwhere(lit):
        for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            there = row + down, column + right
            if min(there) < 0 or max(there) >= len(lit) or lit[there]:
                continue
            for share in ALONG:
                offset = np.array([0.5, share] if right else [share, 0.5])
                here = np.array([column - 1.0, row - 1.0]) + offset
                light.append(here)
                dark.append(here + np.array([right, down], np.float64))
    return np.array(light).reshape(-1, 2), np.array(dark).reshape(-1, 2)


def _crossings(gray: NDArray[np.uint8], light: FloatArray, dark: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where (E, 2) profiles from light to dark pass the middle of their two gray levels, and the contrast (E,).

    A profile that does not pass it gives NaN.
    """
    along = np.linspace(0.0, 1.0, STEPS)
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
    place = (after - 1 + share) / (STEPS - 1)
    return light + place[:, None] * (dark - light), contrast


def _project(H: FloatArray, points: FloatArray) -> FloatArray:
    mapped = np.column_stack([points, np.ones(len(points))]) @ H.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def _normals(H: FloatArray, middle: FloatArray, across: FloatArray) -> FloatArray:
    """Return unit normals (E, 2) of the edges in the photo, towards their dark side."""
    edge = 0.5 * np.column_stack([-across[:, 1], across[:, 0]])
    drawn = _project(H, middle + edge) - _project(H, middle - edge)
    normals = np.column_stack([drawn[:, 1], -drawn[:, 0]])
    towards = _project(H, middle + 0.5 * across) - _project(H, middle)
    normals *= np.sign(np.einsum("ni,ni->n", normals, towards))[:, None]
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _derivatives(H: FloatArray, points: FloatArray, normals: FloatArray) -> FloatArray:
    """Return derivatives (E, 8) of the projections along the normals, by the entries of H but the last."""
    homogeneous = np.column_stack([points, np.ones(len(points))])
    mapped = homogeneous @ H.T
    x = mapped[:, :2] / mapped[:, 2:]
    rows = homogeneous / mapped[:, 2:]
    by_last = -np.einsum("ni,ni->n", normals, x)[:, None] * rows[:, :2]
    return np.hstack([normals[:, :1] * rows, normals[:, 1:] * rows, by_last])


def _solve_robustly(J: FloatArray, off: FloatArray) -> tuple[FloatArray, int, float]:
    """Solve J step = off without outliers; return the step, how many edges agree, and their scatter."""
    kept = np.ones(len(off), bool)
    units = np.maximum(np.abs(J).max(axis=0), 1e-12)
    for _ in range(3):
        step = np.linalg.lstsq(J[kept] / units, off[kept], rcond=None)[0] / units
        left = off - J @ step
        sigma = MAD_TO_SIGMA * float(np.median(np.abs(left[kept])))
        kept = np.abs(left) <= max(3.0 * sigma, 1e-3)
    freedom = max(int(kept.sum()) - UNKNOWNS, 1)
    return step, int(kept.sum()), float(np.sqrt((left[kept] ** 2).sum() / freedom))


# Find printed ArUco and AprilTag markers in photos.

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
"""Families that `auto` looks for. Families of few bits and many markers are left out: they are found in brickwork,
and aruco-original in windows."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenMarker:
    """A marker in one photo."""

    family: str
    number: int
    corners: FloatArray
    """(4, 2) in pixels, clockwise from the marker's own top left; pixel centers at +0.5."""
    sigma_px: float

    @property
    def name(self) -> str:
        """What the marker is called in messages."""
        return f"{self.family} {self.number}"


def find_markers_in_file(photo_dir: Path, family: str, name: str) -> list[SeenMarker]:
    """Return the markers in a photo; none where the photo cannot be read."""
    try:
        with Image.open(photo_dir / name) as image:
            gray = np.asarray(image.convert("L"))
    except OSError:
        return []
    return find_markers(gray, TRIED if family == AUTO else (family,))


def find_markers(gray: NDArray[np.uint8], families: Sequence[str]) -> list[SeenMarker]:
    """Return the markers of some families in a photo, each with corners from all edges of its pattern.

    Args:
        gray: (H, W) photo.
    """
    options = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    found: list[SeenMarker] = []
    for family in families:
        dictionary = load_dictionary(family)
        corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary, options).detectMarkers(gray)
        for outline, number in zip(corners, [] if numbers is None else numbers.ravel(), strict=True):
            pattern = draw_pattern(family, int(number))
            fitted = fit_pattern(gray, pattern, np.asarray(outline, np.float64).reshape(4, 2) + 0.5)
            if fitted is not None:
                found.append(SeenMarker(family, int(number), fitted.corners, fitted.sigma_px))
    return found


def load_dictionary(family: str) -> cv2.aruco.Dictionary:
    """Return OpenCV's dictionary of a family."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILIES[family]))


def draw_pattern(family: str, number: int) -> NDArray[np.uint8]:
    """Return the (N, N) cells of a marker with its dark border, 0 or 255."""
    dictionary = load_dictionary(family)
    return np.asarray(cv2.aruco.generateImageMarker(dictionary, number, dictionary.markerSize + 2), np.uint8)


def marker_count(family: str) -> int:
    """Return how many markers a family has."""
    return len(load_dictionary(family).bytesList)


# Draw a page of markers to print.

PAGES_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
"""Width and height of a sheet of paper, by its name."""
MARGIN_MM, LABEL_MM, RULER_MM = 10.0, 6.0, 100.0
MOST_PER_PAGE = 12

SUFFIXES = (".pdf", ".svg")
MM_PER_INCH = 25.4


def write_marker_page(
    path: Path, side_m: float, family: str = "apriltag-36h11", first: int = 0, paper: str = "a4"
) -> int:
    """Write a page of markers to print, true to scale, with a ruler to check the printer by.

    Args:
        side_m: side of the dark square of each marker, in meters.

    Returns:
        how many markers are on it.

    Raises:
        ConfigError: no marker of that size fits on the page, or a name is unknown.
        InputError: the file cannot be written.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"a page of markers is a PDF or SVG file, not {path.name}", hint="write -o markers.pdf")
    if family not in FAMILIES or paper not in PAGES_MM:
        raise ConfigError(
            f"no family of markers is named '{family}'" if family not in FAMILIES else f"no paper is named '{paper}'",
            hint=f"known: {', '.join(FAMILIES if family not in FAMILIES else PAGES_MM)}",
        )
    places = marker_places(side_m, len(draw_pattern(family, 0)), paper)
    places = places[: max(min(MOST_PER_PAGE, marker_count(family) - first), 0)]
    if not places:
        size = format_length(side_m)
        raise ConfigError(
            f"no marker of {size} fits on {paper}, or none has number {first}", hint="choose smaller ones"
        )
    data = _draw(places, side_m * 1000.0, family, first, paper, path.suffix.lower().removeprefix("."))
    try:
        with replace_atomically(path) as target:
            target.write_bytes(data)
    except OSError as err:
        raise InputError(f"cannot write {path}: {err.strerror}", hint="name another file with -o") from err
    return len(places)


def marker_places(side_m: float, cells: int, paper: str) -> list[tuple[float, float]]:
    """Return the lower left corners in millimeters of as many markers as fit on a page, with a light cell around each.

    Args:
        side_m: side of a marker, in meters.
    """
    width, height = PAGES_MM[paper]
    side = side_m * 1000.0
    step = side * (1.0 + 2.0 / cells)
    across = int((width - 2 * MARGIN_MM) / step)
    down = int((height - 3 * MARGIN_MM - LABEL_MM) / (step + LABEL_MM))
    left = (width - across * step) / 2 + side / cells
    tops = [height - MARGIN_MM - row * (step + LABEL_MM) - step + side / cells for row in range(down)]
    return [(left + column * step, top) for top in tops for column in range(across)]


def _draw(places: list[tuple[float, float]], side: float, family: str, first: int, paper: str, suffix: str) -> bytes:
    from matplotlib import rc_context
    from matplotlib.backends.backend_pdf import FigureCanvasPdf
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    width, height = PAGES_MM[paper]
    figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH))
    (FigureCanvasPdf if suffix == "pdf" else FigureCanvasSVG)(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0, width), ylim=(0, height), aspect="equal")
    axes.set_axis_off()
    for number, (x, y) in enumerate(places, start=first):
        pattern = draw_pattern(family, number)
        axes.fill(*_dark_bars(pattern, x, y, side), color="black", linewidth=0)
        label = f"{family} {number}, side {format_length(side / 1000.0)}"
        axes.text(x, y - side / len(pattern) - 1.0, label, fontsize=7, va="top")
    axes.plot([MARGIN_MM, MARGIN_MM + RULER_MM], [MARGIN_MM] * 2, color="black", linewidth=0.5)
    for tick in range(0, int(RULER_MM) + 1, 10):
        axes.plot([MARGIN_MM + tick] * 2, [MARGIN_MM, MARGIN_MM + 2.0], color="black", linewidth=0.5)
    note = (
        f"Print at 100 %. This ruler has {RULER_MM:.0f} mm: measure it, and the dark squares. Glue them to stiff card."
    )
    axes.text(MARGIN_MM, MARGIN_MM + 3.0, note, fontsize=7)
    file = io.BytesIO()
    undated = {"CreationDate": None} if suffix == "pdf" else {"Date": None}
    with rc_context({"svg.hashsalt": family}):  # else names in it are random
        figure.savefig(file, format=suffix, metadata=undated)
    return file.getvalue()


def _dark_bars(pattern: NDArray[np.uint8], x: float, y: float, side: float) -> list[FloatArray]:
    """Return x and y of the dark bars of a marker, in turn, as `Axes.fill` takes them.

    Bars along rows and along columns cover the seams of each other, which viewers would show as light lines.
    """
    cells = len(pattern)
    bars = [(row, row + 1, *bar) for row in range(cells) for bar in _runs(pattern[row] < 128)]
    bars += [(*bar, column, column + 1) for column in range(cells) for bar in _runs(pattern[:, column] < 128)]
    drawn: list[FloatArray] = []
    for top, bottom, left, right in bars:
        drawn.append(x + side / cells * np.array([left, right, right, left], np.float64))
        drawn.append(y + side / cells * (cells - np.array([top, top, bottom, bottom], np.float64)))
    return drawn


def _runs(dark: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return begin and end of each run of dark cells."""
    steps = np.diff(np.concatenate([[0], dark.astype(np.int8), [0]]))
    return list(zip(np.flatnonzero(steps > 0).tolist(), np.flatnonzero(steps < 0).tolist(), strict=True))


# The scale of a model from printed markers of known size.

SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
"""Corners of a marker of side 1 about its middle, clockwise from its own top left."""
EDGE_BIAS_PX = 0.05
"""Standard deviation in pixels of what edges leave of a side's length: 0.014 to 0.1 pixels for markers of 30 to 45
pixels and blur of 0.5 to 1.5, less for larger ones (`tests/unit/scale/test_marker_edges.py`)."""
MAX_SHAPE_ERROR = 0.05
"""Largest distance of a corner from the square, in sides, that is still a marker. Chosen by hand: a wrong detection, or
one number in two places, is off by a side or more."""


@dataclass(frozen=True, slots=True)
class MarkerScales:
    """What the markers of a set tell."""

    evidence: tuple[ScaleEvidence, ...]
    not_used: Mapping[str, str]
    """Markers that tell nothing, by name, with the reason."""


def marker_scales(
    seen: Mapping[str, Sequence[SeenMarker]], rays: Mapping[str, Sequence[Sequence[Sight]]], side_m: float
) -> MarkerScales:
    """Return the scale of a model by each marker.

    Args:
        side_m: side of each marker's dark square, in meters.
    """
    sights: dict[str, list[Sequence[Sight]]] = defaultdict(list)
    sizes: dict[str, list[float]] = defaultdict(list)
    for photo, markers in seen.items():
        names = [marker.name for marker in markers]
        for marker, corners in zip(markers, rays[photo], strict=True):
            if names.count(marker.name) == 1:  # two of one number in a photo: which is which is unknown
                sights[marker.name].append(corners)
                sizes[marker.name].append(side_px(marker.corners))
    evidence, not_used = [], {}
    for name in sorted(sights):
        found = _measure_marker(name, sights[name], float(np.median(sizes[name])), side_m)
        if isinstance(found, str):
            not_used[name] = found
        else:
            evidence.append(found)
    return MarkerScales(tuple(evidence), not_used)


def side_px(corners: FloatArray) -> float:
    """Return the mean side of a quadrilateral (4, 2)."""
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())


def _measure_marker(name: str, sights: Sequence[Sequence[Sight]], size_px: float, side_m: float) -> ScaleEvidence | str:
    """Return the scale by one marker that several photos show, or why it tells none."""
    corners: list[SightedPoint] = []
    for k in range(4):
        point = locate_point([photo[k] for photo in sights])
        if isinstance(point, str):
            return point.replace("it is marked", "it is seen")
        corners.append(point)
    places = np.array([corner.place for corner in corners])
    fit = umeyama(SQUARE, places)
    off = np.linalg.norm(fit(SQUARE) - places, axis=1).max() / fit.scale
    if off > MAX_SHAPE_ERROR:
        return f"it is no square in the model: a corner is off by {100 * off:.0f} % of its side; one number twice?"
    # the side is linear in the corners: s = sum a'R'b / sum a'a
    arms = SQUARE @ fit.R.T / (SQUARE**2).sum()
    variance = sum(arm @ corner.covariance @ arm for arm, corner in zip(arms, corners, strict=True))
    deviation = float(np.hypot(np.sqrt(variance) / fit.scale, EDGE_BIAS_PX / size_px))
    return ScaleEvidence(f"marker {name}", side_m / fit.scale, deviation, min(len(one.photos) for one in corners))
