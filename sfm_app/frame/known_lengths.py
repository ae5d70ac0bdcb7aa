"""What is known of lengths in a scene, as evidence of its scale."""

from collections.abc import Mapping, Sequence

import numpy as np

from sfm_app.frame.markers import find_markers_in_file, marker_scales
from sfm_app.frame.scale import ScaleEvidence
from sfm_app.frame.sighted_points import (
    PosedPhotos,
    Sight,
    SightedPoint,
    Sightlines,
    layout_scale,
    locate_point,
    measure_distance,
    named_photos,
    unrotate_pixels,
)
from sfm_app.runtime.context import RunContext
from sfm_app.tasks import Task
from sfm_app.types import ControlPoints, Photo, PhotoSet
from sfm_app.wording import format_length, list_names, parse_length, parse_point

TAPE_DEVIATION = 0.002
"""Relative standard deviation of a distance that somebody measured: two millimeters per meter. Chosen by hand."""
NAMES_SHOWN = 5


def distance_evidence(distances: Sequence[tuple[str, str, str]], model: Sightlines) -> list[ScaleEvidence]:
    """Return the scale by each known distance between two places."""
    found = []
    for first, second, length in distances:
        a, b, meters = np.array(parse_point(first)), np.array(parse_point(second)), parse_length(length)
        apart = measure_distance(a, b, model, 1.0, None)
        deviation = float(np.hypot(apart.deviation / apart.value, TAPE_DEVIATION))
        found.append(ScaleEvidence(f"the distance of {format_length(meters)}", meters / apart.value, deviation))
    return found


def marker_evidence(posed: PosedPhotos, run: RunContext, problems: list[str]) -> list[ScaleEvidence]:
    """Return the scale by each printed marker, and note markers that tell nothing."""
    options = run.settings.scale
    names = sorted(posed.names)
    task = Task(find_markers_in_file, run.workspace.photos, options.marker_family)
    seen = dict(zip(names, run.map(task, names, "looking for markers"), strict=True))
    rays = {name: [posed.sights(name, marker.corners) for marker in seen[name]] for name in names}
    found = marker_scales(seen, rays, parse_length(options.markers))
    run.record(markers={"photos": sum(map(bool, seen.values())), "not_used": dict(found.not_used)})
    problems += [f"marker {name} is not used: {reason}" for name, reason in found.not_used.items()]
    if not any(seen.values()):
        problems.append("no photo shows a marker; print a page of them with `sfm-app markers`")
    return list(found.evidence)


def control_places(
    photos: PhotoSet, posed: PosedPhotos, given: ControlPoints, problems: list[str]
) -> dict[str, SightedPoint]:
    """Return the place in the model of each ground control point that two photos determine."""
    names, found = named_photos(photos.photos), dict[str, SightedPoint]()
    unknown = sorted({photo for point in given.points for photo in point.marks if photo not in names})
    if unknown:
        problems.append(f"no photo in use is called {list_names(unknown, NAMES_SHOWN)}")
    marked = {photo for point in given.points for photo in point.marks if photo in names}
    scales = {name: layout_scale(names[name], photos.folder) for name in sorted(marked)}
    for point in given.points:
        sights = _mark_sights(point.name, point.marks, names, scales, posed, problems)
        placed = locate_point(sights)
        if isinstance(placed, str):
            problems.append(f"ground control point '{point.name}' is not used: {placed}")
            continue
        found[point.name] = placed
        problems += [
            f"ground control point '{point.name}': its mark in {photo} contradicts the others, and is left out"
            for photo in placed.left_out
        ]
    return found


def _mark_sights(
    point: str,
    marks: Mapping[str, tuple[float, float]],
    names: Mapping[str, Photo],
    scales: Mapping[str, float],
    posed: PosedPhotos,
    problems: list[str],
) -> list[Sight]:
    """Return the rays of a point's marks in photos with a pose."""
    sights = []
    for name, mark in marks.items():
        photo = names.get(name)
        if photo is None or photo.name not in posed:
            continue
        pixel = unrotate_pixels(photo, scales[name] * np.array([mark]))
        if not (0 <= pixel[0, 0] <= photo.width and 0 <= pixel[0, 1] <= photo.height):
            problems.append(f"ground control point '{point}': its mark in {name} lies outside of the photo")
            continue
        sights += posed.sights(photo.name, pixel)
    return sights
