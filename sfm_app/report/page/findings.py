"""What a run has found, as the tables of the page: at a glance, warnings, cameras, dropped pairs, stages."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sfm_app.report.camera_text import SOURCES, contradiction_lines, intrinsics_lines
from sfm_app.report.page.contents import RunContents
from sfm_app.report.page.correlations import CorrelationTable, correlation_table
from sfm_app.report.scale_text import scale_lines
from sfm_app.report.scene_text import scene_lines
from sfm_app.report.words import WARNING, duration_text
from sfm_app.runtime.manifest import model_triangles
from sfm_app.settings import Settings
from sfm_app.types import Calibration, CameraModel

UNKNOWN_CAMERA = "these photos do not determine it"
"""How the texts of a camera begin why it is a guess."""
DETERMINE_IT = (
    "add photos from nearer, farther and other heights, some with the camera turned on its side, or give the camera, "
    "if you know it, with --calibration FILE"
)
"""What to do where pairs of photos do not determine a camera."""
PARAMETERS = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
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
    source = SOURCES.get(camera.method, camera.method)
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
            for parameter, at in PARAMETERS.items()
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
    names = [name for name in after.deviations if name not in PARAMETERS]
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
