"""One row for each photo: whether it has its place, why not, and how well it is tied to the model."""

import base64
import io
import logging
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

from PIL import Image

from sfm_app.camera.models import PARAMETERS
from sfm_app.colmap.model import ModelFigures
from sfm_app.report.contents import RunContents
from sfm_app.report.text import (
    GUESS_SOURCES,
    WARNING,
    contradiction_lines,
    duration_text,
    intrinsics_lines,
    scale_lines,
    scene_lines,
)
from sfm_app.runtime.workspace import model_triangles
from sfm_app.settings import Settings
from sfm_app.types import Calibration, CameraModel, Photo
from sfm_app.types.camera import correlation_key

# Which parameters of a camera the photos tell apart badly, as a table and in sentences.

STRONG = 0.5
"""Correlation from which on two parameters are said to depend on each other. Chosen by hand: a quarter of the variance
of the one is then that of the other."""
MOST_SENTENCES = 3
PAIR_PARAMETERS = ("fx", "fy", "cx", "cy", "k1")


@dataclass(frozen=True, slots=True)
class CorrelationTable:
    """Correlations between the parameters of a camera."""

    source: str
    """What they are from."""
    names: Sequence[str]
    """(n,) of the parameters."""
    rows: Sequence[Sequence[float | None]]
    """(n, n), the lower triangle; None above it, and where it is not known."""
    texts: Sequence[str]
    """What it says, in sentences."""


def correlation_table(before: Calibration, after: CameraModel | None) -> CorrelationTable | None:
    """Return the correlations after the last adjustment, else those from pairs; None where none are known.

    Terms of the lens that are 0 are left out, and the second focal of square pixels. A center that the photos do not
    determine is not: where it is off, the focal is off with it.

    Args:
        before: the camera from pairs of photos.
        after: the last adjustment; None where there was none.
    """
    if after is not None and after.correlations:
        values = dict(zip(PARAMETERS.get(after.model, ()), after.params, strict=False))
        left_out = () if "aspect" in after.determined else ("fy",)
        names = [name for name in after.deviations if values.get(name) and name not in left_out]
        return _table("after the last adjustment", names, after.correlations)
    if before.identifiable and before.correlations:
        left_out = ("fy",) if "aspect" in before.held else ()
        names = [name for name in PAIR_PARAMETERS if name not in (*left_out, *before.held)]
        return _table("from pairs of photos", names, before.correlations)
    return None


def _table(source: str, names: Sequence[str], values: Mapping[str, float]) -> CorrelationTable | None:
    """Return the table of some parameters; None where there are fewer than two."""
    if len(names) < 2:
        return None
    called = ["focal" if name == "fx" and "fy" not in names else name for name in names]
    rows = [
        [values.get(correlation_key(names[j], names[i])) if j < i else None for j in range(len(names))]
        for i in range(len(names))
    ]
    return CorrelationTable(source, called, rows, _sentences(called, rows))


def _sentences(names: Sequence[str], rows: Sequence[Sequence[float | None]]) -> list[str]:
    """Return which parameters depend on each other, the most dependent first."""
    found = [(value, names[j], names[i]) for j, i in combinations(range(len(names)), 2) if (value := rows[i][j])]
    found.sort(key=lambda one: -abs(one[0]))
    strong = [one for one in found if abs(one[0]) >= STRONG]
    said = [
        f"{first} and {second} move {'together' if value > 0 else 'against each other'}: {correlation_text(value)}"
        for value, first, second in strong[:MOST_SENTENCES]
    ]
    if len(strong) > len(said):
        said.append(f"and {len(strong) - len(said)} more pairs of parameters")
    if not said and found:
        value, first, second = found[0]
        said = [f"none hides in another: the strongest is {first} with {second}, {correlation_text(value)}"]
    return said


def correlation_text(value: float) -> str:
    """Return a correlation with two digits and a true minus."""
    return f"{value:.2f}".replace("-0.00", "0.00").replace("-", "\N{MINUS SIGN}")


# What a run has found, as the tables of the page: at a glance, warnings, cameras, dropped pairs, stages.

UNKNOWN_CAMERA = "these photos do not determine it"
"""How the texts of a camera begin why it is a guess."""
DETERMINE_IT = (
    "add photos from nearer, farther and other heights, some with the camera turned on its side, or give the camera, "
    "if you know it, with --calibration FILE"
)
"""What to do where pairs of photos do not determine a camera."""
PLACES_IN_K = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
"""Places of the parameters in K."""


@dataclass(frozen=True, slots=True)
class Fact:
    """One of the figures at a glance."""

    name: str
    value: str
    note: str = ""


@dataclass(frozen=True, slots=True)
class CameraTable:
    """One camera, as pairs of photos gave it and after the last adjustment."""

    name: str
    size: str
    model: str
    rows: Sequence[tuple[str, str, str]]
    """Parameter, value from pairs, value after adjustment."""
    texts: Sequence[str]
    correlations: CorrelationTable | None = None
    """None where they are not known, or only one parameter is determined."""


@dataclass(frozen=True, slots=True)
class StageRow:
    """What a stage has cost."""

    name: str
    seconds: float
    cpu_seconds: float
    peak_mb: float
    share: float
    """Of the seconds of the run."""


def glance(contents: RunContents) -> list[Fact]:
    """Return what was found, at a glance.

    Args:
        contents: of the run.
    """
    return [fact for fact in _facts(contents) if fact.value]


def _facts(contents: RunContents) -> Iterator[Fact]:
    scene, intrinsics = contents.scene, contents.intrinsics
    photos, pairs = contents.counts("photos"), contents.counts("view_graph")
    if scene is not None:
        count = len(scene.registered) + len(scene.unregistered)
        left_out = len(photos.get("unusable", ()))
        more = f"{left_out} more {'was' if left_out == 1 else 'were'} left out" if left_out else ""
        yield Fact("photos placed", f"{len(scene.registered)} of {count}", more)
    elif photos:
        yield Fact("usable photos", str(photos.get("usable", "")))
    if scene is not None and scene.cameras:
        camera = next(iter(scene.cameras.values()))
        deviation = camera.deviations.get("fx")
        more = f"± {deviation:.1f} px" if deviation is not None else ""
        yield Fact("focal length", f"{camera.K[0, 0]:.0f} px", more)
    elif intrinsics is not None and intrinsics.cameras:
        known = intrinsics.main
        yield Fact("focal length", f"{known.focal_px:.0f} px", "" if known.identifiable else "a guess")
    if pairs:
        yield Fact("pairs of photos", str(pairs.get("kept", "")), "that show the same place")
    if scene is not None:
        yield Fact("points", f"{scene.points:,}", f"seen {scene.observations:,} times")
        yield Fact("reprojection error", f"{scene.mean_reprojection_px:.2f} px", "mean")
    triangles = model_triangles(contents.stages)
    if triangles:
        yield Fact("triangles", f"{triangles:,}")
    if scene is not None:
        yield _unit_fact(contents)
    if contents.stages:
        yield Fact("time", duration_text(sum(stage["seconds"] for stage in contents.stages.values())))


def _unit_fact(contents: RunContents) -> Fact:
    """Return the unit of the model, and how well it is known."""
    if not contents.is_metric:
        return Fact("unit", "its own", "no scale known")
    frame = contents.frame
    by = f"by {frame.source.partition(', ')[0]}" if frame.source else "by GPS"
    return Fact("unit", "meters", by if frame.deviation is None else f"± {100 * frame.deviation:.2g} %, {by}")


def remarks(contents: RunContents) -> tuple[list[str], list[str]]:
    """Return the warnings of a run, each with what to do, and its other remarks.

    Args:
        contents: of the run.
    """
    lines = list(intrinsics_lines(contents.intrinsics)) if contents.intrinsics is not None else []
    for stage in ("view_graph", "intrinsics"):
        lines += contradiction_lines(contents.counts(stage))
    if contents.scene is not None:
        lines += scene_lines(contents.scene, contents.counts("scene"))
    if "scale" in contents.stages:
        lines += scale_lines(contents.counts("scale"))
    texts = [plain_text(line) for line in lines]
    warnings = [text.removeprefix(WARNING) for text in texts if text.startswith(WARNING)]
    others = [text for text in texts if not text.startswith((WARNING, UNKNOWN_CAMERA))]
    return warnings + unknown_cameras(contents), others


def plain_text(line: str) -> str:
    """Return a line of the terminal without its indentation, and with a true sign of deviations."""
    return " ".join(line.split()).replace("+-", "±")


def unknown_cameras(contents: RunContents) -> list[str]:
    """Return, of each camera that its pairs of photos do not determine, why, what came of it, and what to do.

    A camera none of whose photos is in the model changes nothing there: it is passed over.

    Args:
        contents: of the run.
    """
    cameras = contents.intrinsics.cameras if contents.intrinsics is not None else {}
    after = contents.scene.cameras if contents.scene is not None else {}
    return [
        _unknown_text(f" {name}" if len(cameras) > 1 else "", camera, after.get(name))
        for name, camera in cameras.items()
        if not camera.identifiable and (name in after or not after)
    ]


def _unknown_text(name: str, camera: Calibration, after: CameraModel | None) -> str:
    source = GUESS_SOURCES.get(camera.method, camera.method)
    text = f"Pairs of photos do not determine the camera{name}: {camera.reason}. "
    text += f"A focal of {camera.focal_px:.0f} px is {source}"
    if after is not None and "fx" in after.deviations:
        focal = value_text(after.K[0, 0], after.deviations["fx"])
        text += f"; the last adjustment, of all photos together, came to {focal} px"
    return f"{text}. What to do: {DETERMINE_IT}."


def camera_tables(contents: RunContents) -> list[CameraTable]:
    """Return all cameras with their deviations.

    Args:
        contents: of the run.
    """
    found, scene = contents.intrinsics, contents.scene
    if found is None:
        return []
    tables = []
    for name, camera in found.cameras.items():
        after = scene.cameras.get(name) if scene is not None else None
        rows = [
            (
                parameter,
                value_text(camera.K[at], camera.spread.get(parameter)),
                value_text(after.K[at], after.deviations.get(parameter)) if after is not None else "",
            )
            for parameter, at in PLACES_IN_K.items()
        ]
        rows += _lens_rows(after) if after is not None else []
        lens = contents.counts("scene").get("lenses", {}).get(name, {}).get("model", "") if after is not None else ""
        alone = intrinsics_lines(type(found)({name: camera}, found.camera_of, found.photos))
        texts = [plain_text(line) for line in alone[1:]]
        size = f"{camera.width} × {camera.height}"
        tables.append(CameraTable(name, size, lens, rows, texts, correlation_table(camera, after)))
    return tables


def _lens_rows(after: Any) -> list[tuple[str, str, str]]:
    """Return the terms of the lens that have a deviation."""
    names = [name for name in after.deviations if name not in PLACES_IN_K]
    first = len(after.params) - len(names)
    return [
        (name, "", value_text(after.params[first + k], after.deviations[name], 4))
        for k, name in enumerate(names)
        if first >= 0 and after.params[first + k]
    ]


def value_text(value: float, deviation: float | None, digits: int = 1) -> str:
    """Return a value with its standard deviation, if known.

    Args:
        value, deviation: to be written.
        digits: after the point.
    """
    more = "" if deviation is None else f" ± {deviation:.{digits}f}"
    return f"{value:.{digits}f}{more}"


def dropped_pairs(contents: RunContents) -> list[tuple[str, int]]:
    """Return why pairs of photos were dropped, and how many, those of the F first.

    Args:
        contents: of the run.
    """
    rejected = contents.counts("view_graph").get("rejected", {})
    later = contents.counts("scene").get("pairs_dropped", {})
    return [*rejected.items(), *later.items()]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two runs side by side."""

    other: str
    """Name of the other run."""
    rows: Sequence[tuple[str, str, str]]
    """What, in this run, in the other one."""


def compare(contents: RunContents, other: RunContents) -> Comparison:
    """Return what two runs have found, the settings in which they differ, and what their stages have cost.

    Args:
        contents: of this run.
        other: of the other one.
    """
    facts = [{fact.name: f"{fact.value} {fact.note}".strip() for fact in glance(one)} for one in (contents, other)]
    costs = [
        {f"{row.name}, CPU seconds": f"{row.cpu_seconds:.1f}" for row in stage_rows(one)} for one in (contents, other)
    ]
    here, there = facts[0] | costs[0], facts[1] | costs[1]
    rows = [(name, here.get(name, ""), there.get(name, "")) for name in {**here, **there}]
    settings = [one.manifest.get("settings", {}) for one in (contents, other)]
    rows += [(f"setting {name}", mine, theirs) for name, mine, theirs in sorted(_differences(*settings))]
    return Comparison(other.run.workspace.root.resolve().name, rows)


def stage_rows(contents: RunContents) -> list[StageRow]:
    """Return what each stage has cost.

    Args:
        contents: of the run.
    """
    whole = sum(stage["seconds"] for stage in contents.stages.values()) or 1.0
    return [
        StageRow(
            name, stage["seconds"], stage.get("cpu_seconds", 0.0), stage.get("peak_mb", 0.0), stage["seconds"] / whole
        )
        for name, stage in contents.stages.items()
    ]


def changed_settings(contents: RunContents) -> list[tuple[str, str, str]]:
    """Return the settings that are not at their defaults: name, value, default.

    Args:
        contents: of the run.
    """
    given = contents.manifest.get("settings", {})
    usual = Settings().model_dump()
    return sorted(_differences(given, usual))


def _differences(
    given: Mapping[str, Any], usual: Mapping[str, Any], prefix: str = ""
) -> Iterator[tuple[str, str, str]]:
    for name, value in given.items():
        default = usual.get(name)
        if isinstance(value, Mapping) and isinstance(default, Mapping):
            yield from _differences(value, default, f"{prefix}{name}.")
        elif value != default:
            yield f"{prefix}{name}", str(value), str(default)


logger = logging.getLogger("sfm_app")

PLACED, ELSEWHERE, UNPLACED, LEFT_OUT, USABLE = "placed", "in another model", "not placed", "left out", "usable"
ALL_PIXELS, LARGEST_PX, SMALLEST_PX = 6_000_000, 960, 160
"""Pixels of all pictures together, and bounds of their longer side: some 10 MB for any number of photos."""
QUALITY = 72
"""JPEG quality of the pictures. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class PhotoRow:
    """What the page says of one photo; None where it is not known."""

    name: str
    state: str
    reason: str = ""
    pairs: int | None = None
    """Pairs of photos that it is in."""
    inliers: int | None = None
    points: int | None = None
    residual_px: float | None = None
    coverage: float | None = None
    """Share of the photo with points of the model."""
    depth: float | None = None
    """Share of the photo with a depth."""
    picture: str = ""
    """Address of a small picture; empty where there is none."""


def photo_rows(contents: RunContents, figures: ModelFigures | None, pictures: Mapping[str, str]) -> list[PhotoRow]:
    """Return the rows of all photos, in order of their names, those that were left out last.

    Args:
        contents: of the run.
        figures: of its model; None where there is none.
        pictures: addresses of small pictures, by name of the photo; may lack some.
    """
    if contents.photos is None:
        return []
    photos = contents.photos.photos
    pairs, inliers = _count_pairs(contents)
    depths = contents.counts("depth_maps").get("coverage", {})
    rows = []
    for photo in sorted(photos, key=lambda one: one.name):
        state, reason = _state(photo, contents)
        seen = figures.photos.get(photo.name) if figures is not None else None
        rows.append(
            PhotoRow(
                photo.path, state, "; ".join(filter(None, (reason, *photo.notes))),
                pairs.get(photo.name, 0) if contents.views is not None else None,
                inliers.get(photo.name, 0) if contents.views is not None else None,
                seen.points if seen else None,
                seen.residual_px if seen and math.isfinite(seen.residual_px) else None,
                seen.coverage if seen else None,
                depths.get(photo.name), pictures.get(photo.name, ""),
            )
        )  # fmt: skip
    return rows + [PhotoRow(one.name, LEFT_OUT, one.reason) for one in contents.photos.unusable]


def _state(photo: Photo, contents: RunContents) -> tuple[str, str]:
    """Return whether a photo has its place, and why not."""
    scene = contents.scene
    if scene is None:
        return USABLE, ""
    if photo.name in scene.cam_from_world:
        return PLACED, ""
    others = contents.counts("scene").get("other_models", ())
    number = next((k for k, names in enumerate(others, 1) if photo.name in names), 0)
    if number:
        return ELSEWHERE, f"in other_models/{number}, which no pair connects with the main one"
    return UNPLACED, scene.unregistered.get(photo.name, "")


def _count_pairs(contents: RunContents) -> tuple[Counter[str], Counter[str]]:
    """Return the pairs that each photo is in, and their inliers, by name."""
    pairs, inliers = Counter[str](), Counter[str]()
    if contents.views is None or contents.matches is None:
        return pairs, inliers
    for pair, fit in contents.views.fits.items():
        for photo in pair:
            name = contents.matches.images[photo].name
            pairs[name] += 1
            inliers[name] += fit.inlier_count
    return pairs, inliers


def photo_names(contents: RunContents) -> list[str]:
    """Return the names of the usable photos in order of the page's rows."""
    return sorted(photo.name for photo in contents.photos.photos) if contents.photos is not None else []


def embedded_pictures(contents: RunContents) -> Mapping[str, str]:
    """Return small pictures of all photos as data addresses, by name.

    Args:
        contents: of the run.
    """
    names, folder = photo_names(contents), contents.run.workspace.photos
    side = picture_side(max(len(names), 1))
    found = contents.run.map(lambda name: _address(picture(folder / name, side)), names, "pictures of the report")
    return dict(zip(names, found, strict=True))


def picture_side(count: int) -> int:
    """Return the longer side of each picture, so that all together stay small.

    Args:
        count: of the pictures, > 0.
    """
    return int(min(max(math.sqrt(ALL_PIXELS / max(count, 1) * 4 / 3), SMALLEST_PX), LARGEST_PX))


def picture(path: Path, side: int) -> bytes:
    """Return a picture of a photo as JPEG; empty where the photo can no longer be read.

    Args:
        path: of the photo.
        side: most pixels of its longer side.
    """
    try:
        with Image.open(path) as image:
            image.draft("RGB", (side, side))
            small = image.convert("RGB")
            small.thumbnail((side, side))
            file = io.BytesIO()
            small.save(file, "JPEG", quality=QUALITY)
    except (OSError, ValueError, Image.DecompressionBombError) as err:  # the photo may be gone
        logger.info("no picture of %s", path.name, exc_info=err)
        return b""
    return file.getvalue()


def _address(jpeg: bytes) -> str:
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii") if jpeg else ""
