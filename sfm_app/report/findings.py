"""Tables of the page: figures at a glance, warnings, cameras, pairs, stages, and a row per photo."""

import logging
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sfm_app.camera.models import PARAMETERS
from sfm_app.colmap.model import ModelFigures
from sfm_app.frame.scale import SurveyedPoint
from sfm_app.photos.decode import small_jpeg
from sfm_app.report.contents import RunContents, data_address
from sfm_app.report.text import REMEDY, SOURCES, WARNING, duration_text, intrinsics_lines, result_lines
from sfm_app.runtime.workspace import model_triangles
from sfm_app.settings import Settings
from sfm_app.types import Calibration, CameraModel, Photo
from sfm_app.types.camera import correlation_key

# Correlations between the parameters of a camera.

PAIR_PARAMETERS = ("fx", "fy", "cx", "cy", "k1")


@dataclass(frozen=True, slots=True)
class CorrelationTable:
    """Correlations between the parameters of a camera."""

    source: str
    """Estimate with these correlations."""
    names: Sequence[str]
    rows: Sequence[Sequence[float | None]]
    """(n, n), the lower triangle; None elsewhere, and for unknown values."""


def correlation_table(before: Calibration, after: CameraModel | None) -> CorrelationTable | None:
    """Return the correlations after the last adjustment, else those from pairs; None if neither is known."""
    if after is not None and after.correlations:
        values = dict(zip(PARAMETERS.get(after.model, ()), after.params, strict=False))
        omitted = () if "aspect" in after.determined else ("fy",)
        names = [name for name in after.deviations if values.get(name) and name not in omitted]
        return _table("after the last adjustment", names, after.correlations)
    if before.identifiable and before.correlations:
        omitted = ("fy",) if "aspect" in before.held else ()
        names = [name for name in PAIR_PARAMETERS if name not in (*omitted, *before.held)]
        return _table("from pairs of photos", names, before.correlations)
    return None


def _table(source: str, names: Sequence[str], values: Mapping[str, float]) -> CorrelationTable | None:
    if len(names) < 2:
        return None
    labels = ["focal" if name == "fx" and "fy" not in names else name for name in names]
    rows = [
        [values.get(correlation_key(names[j], names[i])) if j < i else None for j in range(len(names))]
        for i in range(len(names))
    ]
    return CorrelationTable(source, labels, rows)


def correlation_text(value: float) -> str:
    """Return a correlation with two digits and a true minus."""
    return f"{value:.2f}".replace("-0.00", "0.00").replace("-", "\N{MINUS SIGN}")


# Figures at a glance, warnings, cameras, dropped pairs and stages.

UNKNOWN_CAMERA = "these photos do not determine it"
"""Prefix of the reason why a camera is a guess."""
PLACES_IN_K = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}


@dataclass(frozen=True, slots=True)
class Fact:
    """One of the figures at a glance."""

    name: str
    value: str
    note: str = ""


@dataclass(frozen=True, slots=True)
class CameraTable:
    """One camera, from pairs of photos and after the last adjustment."""

    name: str
    size: str
    model: str
    rows: Sequence[tuple[str, str, str]]
    """Parameter, value from pairs, value after adjustment."""
    texts: Sequence[str]
    correlations: CorrelationTable | None = None
    """None if unknown, or if the photos determine one parameter only."""


def glance(contents: RunContents) -> list[Fact]:
    """Return the figures at a glance."""
    return [fact for fact in _facts(contents) if fact.value]


def _facts(contents: RunContents) -> Iterator[Fact]:
    scene, pairs = contents.scene, contents.counts("view_graph")
    yield from _photo_facts(contents)
    if pairs:
        yield Fact("pairs of photos", str(pairs.get("kept", "")), "that show the same place")
    if scene is not None:
        yield Fact("points", f"{scene.points:,}", f"{scene.observations:,} observations")
        yield Fact("reprojection error", f"{scene.mean_reprojection_px:.2f} px", "mean")
    triangles = model_triangles(contents.stages)
    if triangles:
        yield Fact("triangles", f"{triangles:,}")
    if scene is not None:
        yield _unit_fact(contents)
    if contents.stages:
        yield Fact("time", duration_text(sum(stage["seconds"] for stage in contents.stages.values())))


def _photo_facts(contents: RunContents) -> Iterator[Fact]:
    scene, intrinsics, photos = contents.scene, contents.intrinsics, contents.counts("photos")
    if scene is not None:
        count, unusable = len(scene.registered) + len(scene.unregistered), len(photos.get("unusable", ()))
        note = f"and {unusable} unusable" if unusable else ""
        yield Fact("photos placed", f"{len(scene.registered)} of {count}", note)
    elif photos:
        yield Fact("usable photos", str(photos.get("usable", "")))
    if scene is not None and scene.cameras:
        camera = next(iter(scene.cameras.values()))
        deviation = camera.deviations.get("fx")
        note = f"± {deviation:.1f} px" if deviation is not None else ""
        yield Fact("focal length", f"{camera.K[0, 0]:.0f} px", note)
    elif intrinsics is not None and intrinsics.cameras:
        known = intrinsics.main
        yield Fact("focal length", f"{known.focal_px:.0f} px", "" if known.identifiable else "a guess")


def _unit_fact(contents: RunContents) -> Fact:
    if not contents.is_metric:
        return Fact("unit", "arbitrary", "unknown scale")
    frame = contents.frame
    by = f"by {frame.source.partition(', ')[0]}" if frame.source else "by GPS"
    return Fact("unit", "meters", by if frame.deviation is None else f"± {100 * frame.deviation:.2g} %, {by}")


def remarks(contents: RunContents) -> tuple[list[str], list[str]]:
    """Return the warnings of a run, each with a remedy, and its other remarks."""
    texts = [plain_text(line) for line in result_lines(contents.intrinsics, contents.scene, contents.stages)]
    warnings = [text.removeprefix(WARNING) for text in texts if text.startswith(WARNING)]
    others = [text for text in texts if not text.startswith((WARNING, UNKNOWN_CAMERA))]
    return warnings + unknown_cameras(contents), others


def plain_text(line: str) -> str:
    """Return a line of the terminal without indentation, and with a true ± sign."""
    return " ".join(line.split()).replace("+-", "±")


def unknown_cameras(contents: RunContents) -> list[str]:
    """Return reason, used value and remedy for each undetermined camera of a run without a scene."""
    if contents.intrinsics is None or contents.scene is not None:  # a scene states how sure its own cameras are
        return []
    cameras = contents.intrinsics.cameras
    return [
        f"Pairs of photos do not determine the camera{f' {name}' if len(cameras) > 1 else ''}: {camera.reason}. "
        f"A focal of {camera.focal_px:.0f} px is {SOURCES.get(camera.method, camera.method)}. What to do: {REMEDY}."
        for name, camera in cameras.items()
        if not camera.identifiable
    ]


def camera_tables(contents: RunContents) -> list[CameraTable]:
    """Return all cameras with their deviations."""
    intrinsics, scene = contents.intrinsics, contents.scene
    if intrinsics is None:
        return []
    tables = []
    for name, camera in intrinsics.divided_as(scene.camera_of if scene is not None else {}).items():
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
        lines = intrinsics_lines(type(intrinsics)({name: camera}, intrinsics.camera_of, intrinsics.photos))
        texts = [plain_text(line) for line in lines[1:]]
        size = f"{camera.width} × {camera.height}"
        tables.append(CameraTable(name, size, lens, rows, texts, correlation_table(camera, after)))
    return tables


def survey_rows(surveyed: Sequence[SurveyedPoint]) -> list[tuple[str, ...]]:
    """Return name, use, photos, plan and height of each ground control point and check point, in mm with deviations."""
    return [
        (
            one.name,
            one.role if one.is_inside is None else f"{one.role}, {'inside' if one.is_inside else 'outside'}",
            str(one.photos),
            *(
                value_text(1e3 * value, None if deviation is None else 1e3 * deviation)
                for value, deviation in ((one.plan_m, one.plan_deviation_m), (one.height_m, one.height_deviation_m))
            ),
        )
        for one in surveyed
    ]


def _lens_rows(after: CameraModel) -> list[tuple[str, str, str]]:
    terms = zip(PARAMETERS.get(after.model, ()), after.params, strict=False)
    known = [(name, value) for name, value in terms if value and name not in PLACES_IN_K and name in after.deviations]
    return [(name, "", value_text(value, after.deviations[name], 4)) for name, value in known]


def value_text(value: float, deviation: float | None, digits: int = 1) -> str:
    """Return a value with so many decimals, and its standard deviation, if known."""
    more = "" if deviation is None else f" ± {deviation:.{digits}f}"
    return f"{value:.{digits}f}{more}"


def dropped_pairs(contents: RunContents) -> list[tuple[str, int]]:
    """Return reasons and numbers of dropped pairs of photos, the stage of fundamental matrices first."""
    rejected = contents.counts("view_graph").get("rejected", {})
    later = contents.counts("scene").get("pairs_dropped", {})
    return [*rejected.items(), *later.items()]


def compare(contents: RunContents, other: RunContents) -> list[tuple[str, str, str]]:
    """Return the name and both values of the figures, costs and differing settings of two runs."""
    here, there = (
        {fact.name: f"{fact.value} {fact.note}".strip() for fact in glance(one)}
        | {f"{name}, CPU seconds": f"{stage.get('cpu_seconds', 0.0):.1f}" for name, stage in one.stages.items()}
        for one in (contents, other)
    )
    rows = [(name, here.get(name, ""), there.get(name, "")) for name in {**here, **there}]
    settings = [one.manifest.get("settings", {}) for one in (contents, other)]
    return rows + [(f"setting {name}", mine, theirs) for name, mine, theirs in sorted(_differences(*settings))]


def changed_settings(contents: RunContents) -> list[tuple[str, str, str]]:
    """Return name, value and default of each changed setting."""
    return sorted(_differences(contents.manifest.get("settings", {}), Settings().model_dump()))


def _differences(
    values: Mapping[str, Any], defaults: Mapping[str, Any], prefix: str = ""
) -> Iterator[tuple[str, str, str]]:
    for name, value in values.items():
        default = defaults.get(name)
        if isinstance(value, Mapping) and isinstance(default, Mapping):
            yield from _differences(value, default, f"{prefix}{name}.")
        elif value != default:
            yield f"{prefix}{name}", str(value), str(default)


# A row and a small picture per photo.

logger = logging.getLogger("sfm_app")

PLACED, ELSEWHERE, UNPLACED, LEFT_OUT, USABLE = "placed", "in another model", "not placed", "left out", "usable"
ALL_PIXELS, LARGEST_PX, SMALLEST_PX = 6_000_000, 960, 160
"""Pixels of all pictures together, and bounds of their longer side: 10 MB for any number of photos. By hand."""


@dataclass(frozen=True, slots=True)
class PhotoRow:
    """Row of a photo; None for unknown values."""

    name: str
    state: str
    reason: str = ""
    pairs: int | None = None
    inliers: int | None = None
    points: int | None = None
    residual_px: float | None = None
    coverage: float | None = None
    """Share of its area with points of the model."""
    depth: float | None = None
    """Share of its area with a depth."""
    picture: str = ""
    """Address of a small picture; empty without one."""


def photo_rows(contents: RunContents, figures: ModelFigures | None, pictures: Mapping[str, str]) -> list[PhotoRow]:
    """Return the rows of all photos by name, unusable files last; `pictures` are addresses of some by photo."""
    if contents.photos is None:
        return []
    photos = contents.photos.photos
    pairs, inliers = _count_pairs(contents)
    depths = contents.counts("depth_maps").get("coverage", {})
    rows = []
    for photo in sorted(photos, key=lambda one: one.name):
        state, reason = _state(photo, contents)
        measured = figures.photos.get(photo.name) if figures is not None else None
        rows.append(
            PhotoRow(
                photo.label, state, "; ".join(filter(None, (reason, *photo.notes))),
                pairs.get(photo.name, 0) if contents.views is not None else None,
                inliers.get(photo.name, 0) if contents.views is not None else None,
                measured.points if measured else None,
                measured.residual_px if measured and math.isfinite(measured.residual_px) else None,
                measured.coverage if measured else None,
                depths.get(photo.name), pictures.get(photo.name, ""),
            )
        )  # fmt: skip
    return rows + [PhotoRow(one.name, LEFT_OUT, one.reason) for one in contents.photos.unusable]


def _state(photo: Photo, contents: RunContents) -> tuple[str, str]:
    scene = contents.scene
    if scene is None:
        return USABLE, ""
    if photo.name in scene.cam_from_world:
        return PLACED, ""
    others = contents.counts("scene").get("other_models", ())
    number = next((k for k, names in enumerate(others, 1) if photo.name in names), 0)
    if number:
        return ELSEWHERE, f"in other_models/{number}; no pair connects it with the main model"
    return UNPLACED, scene.unregistered.get(photo.name, "")


def _count_pairs(contents: RunContents) -> tuple[Counter[str], Counter[str]]:
    """Return pairs and inliers of each photo, by name."""
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
    """Return the names of the usable photos in the order of the page's rows."""
    return sorted(photo.name for photo in contents.photos.photos) if contents.photos is not None else []


def embedded_pictures(contents: RunContents) -> Mapping[str, str]:
    """Return small pictures of all photos as data addresses, by name."""
    names, folder = photo_names(contents), contents.run.workspace.photos
    side = picture_side(max(len(names), 1))
    jpegs = contents.run.map(lambda name: small_jpeg(folder / name, side), names, "pictures of the report")
    return {name: data_address("image/jpeg", jpeg) for name, jpeg in zip(names, jpegs, strict=True) if jpeg}


def picture_side(count: int) -> int:
    """Return the longer side of each picture in pixels: all together stay small."""
    return int(min(max(math.sqrt(ALL_PIXELS / max(count, 1) * 4 / 3), SMALLEST_PX), LARGEST_PX))
