"""Known lengths in a scene as evidence of its scale: distances, markers and ground control points."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sfm_app.frame import sighted_points
from sfm_app.frame.markers import find_markers_in_file, marker_scales
from sfm_app.frame.scale import ScaleEvidence
from sfm_app.runtime.context import RunContext
from sfm_app.tasks import Task
from sfm_app.types import ControlPoints, PhotoSet
from sfm_app.wording import format_length, list_names, parse_length, parse_point

TAPE_DEVIATION = 0.002
"""Relative standard deviation of a distance measured by hand: two millimeters per meter. Chosen by hand."""


def distance_evidence(
    distances: Sequence[tuple[str, str, str]], model: sighted_points.Sightlines
) -> list[ScaleEvidence]:
    """Return the scale by each known distance: two points of the model and a length, as in the settings."""
    evidence = []
    for first, second, length in distances:
        a, b, meters = np.array(parse_point(first)), np.array(parse_point(second)), parse_length(length)
        distance = sighted_points.measure_distance(a, b, model, 1.0, None)
        deviation = float(np.hypot(distance.deviation / distance.value, TAPE_DEVIATION))
        evidence.append(ScaleEvidence(f"the distance of {format_length(meters)}", meters / distance.value, deviation))
    return evidence


def marker_evidence(posed: sighted_points.PosedPhotos, run: RunContext, problems: list[str]) -> list[ScaleEvidence]:
    """Return the scale by each printed marker, and add unusable markers to the problems."""
    options = run.settings.scale
    names = sorted(posed.names)
    task = Task(find_markers_in_file, run.workspace.photos, options.marker_family)
    markers = dict(zip(names, run.map(task, names, "detecting markers"), strict=True))
    rays = {name: [posed.sights(name, marker.corners) for marker in markers[name]] for name in names}
    evidence, unusable = marker_scales(markers, rays, parse_length(options.markers))
    run.record(markers={"photos": sum(map(bool, markers.values())), "not_used": unusable})
    problems += [f"marker {name} is not used: {reason}" for name, reason in unusable.items()]
    if not any(markers.values()):
        problems.append("no photo shows a marker; print a page of them with `sfm-app markers`")
    return evidence


def is_normalized(given: ControlPoints) -> bool:
    """Return whether marks seem to be shares of the width and height of the photo instead of pixels."""
    return all(0.0 <= value <= 1.0 for point in given.points for mark in point.marks.values() for value in mark)


def marks_in_pixels(photos: PhotoSet, given: ControlPoints) -> ControlPoints:
    """Return points whose marks are shares of width and height with marks in pixels of the upright photos."""
    names, points = sighted_points.named_photos(photos.photos), []
    for point in given.points:
        marks = {}
        for name in point.marks.keys() & names.keys():
            photo, mark = names[name], point.marks[name]
            size = (photo.height, photo.width) if photo.turn_deg % 180 else (photo.width, photo.height)
            scale = sighted_points.layout_scale(photo, photos.folder)
            marks[name] = (mark[0] * size[0] / scale, mark[1] * size[1] / scale)
        points.append(replace(point, marks=marks))
    return replace(given, points=tuple(points))


def control_places(
    photos: PhotoSet, posed: sighted_points.PosedPhotos, given: ControlPoints, problems: list[str]
) -> dict[str, sighted_points.SightedPoint]:
    """Return the place in the model of each ground control point that its marks determine, and add problems."""
    names, located = sighted_points.named_photos(photos.photos), dict[str, sighted_points.SightedPoint]()
    unknown = sorted({photo for point in given.points for photo in point.marks if photo not in names})
    if unknown:
        problems.append(f"no photo in use is called {list_names(unknown, 5)}")
    marked = {photo for point in given.points for photo in point.marks if photo in names}
    scales = {name: sighted_points.layout_scale(names[name], photos.folder) for name in sorted(marked)}
    for point in given.points:
        sights: list[sighted_points.Sight] = []
        for name, mark in point.marks.items():
            photo = names.get(name)
            if photo is None or photo.name not in posed:
                continue
            pixel = sighted_points.unrotate_pixels(photo, scales[name] * np.array([mark]))
            if not (0 <= pixel[0, 0] <= photo.width and 0 <= pixel[0, 1] <= photo.height):
                problems.append(f"ground control point '{point.name}': its mark in {name} lies outside of the photo")
                continue
            sights += posed.sights(photo.name, pixel)
        place = sighted_points.locate_point(sights)
        if isinstance(place, str):
            problems.append(f"ground control point '{point.name}' is not used: {place}")
            continue
        located[point.name] = place
        problems += [
            f"ground control point '{point.name}': its mark in {photo} contradicts the others, and is left out"
            for photo in place.outliers
        ]
    return located
