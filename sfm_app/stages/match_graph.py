"""match_graph: PhotoSet -> MatchGraph."""

from dataclasses import replace

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.database import create_database, is_sound, remove_database
from sfm_app.colmap.growth import forget_changed_matches, grow_database
from sfm_app.estimation.diagnosis import NOTHING_MATCHED, diagnose_scene
from sfm_app.files import is_made_from
from sfm_app.matching.features import find_all_features, forget_features, match_pairs
from sfm_app.matching.pairs import match_probable_pairs
from sfm_app.products import read_matches
from sfm_app.retrieval import wants_all_pairs
from sfm_app.runtime.context import RunContext
from sfm_app.types import MatchGraph, PhotoSet


def make(photos: PhotoSet, run: RunContext) -> MatchGraph:
    """Find features and match pairs that no earlier run has; raise a ReconstructionError if there are no matches."""
    place, options = run.workspace, run.settings.matching
    marker = place.database_marker
    if not (is_made_from(marker, run.fingerprint) and is_sound(place.database)):
        marker.unlink(missing_ok=True)
        remove_database(place.database)
        with translate_errors("entering photos"):
            if run.earlier is None:
                create_database(place.database, photos)
            else:
                grow_database(place.database, run.earlier.place.database, photos, run.earlier.known)
        marker.write_text(run.fingerprint, encoding="utf-8", newline="\n")
    method = run.plugins.feature_method(options.features)
    find_all_features(method, run)
    if run.earlier is not None:
        changed = forget_changed_matches(place.database, run.earlier.place.database)
        earlier = run.earlier.with_replaced(changed)
        run = replace(run, earlier=earlier)
        run.record(known_photos=len(earlier.known), new_photos=len(earlier.new), gone_photos=len(earlier.gone))
    if wants_all_pairs(len(photos.photos), options):
        match_pairs(method, run)
    else:
        match_probable_pairs(method, lambda: read_matches(photos, place), run)
    forget_features(run)
    graph = read_matches(photos, place)
    run.record(
        keypoints={graph.images[key].name: len(points) for key, points in graph.keypoints.items()},
        pairs=len(graph.matches),
        matches=sum(len(rows) for rows in graph.matches.values()),
    )
    marker.unlink()
    if not graph.matches:
        raise diagnose_scene(graph, NOTHING_MATCHED, options).error()
    return graph
