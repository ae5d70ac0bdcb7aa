"""match_graph: PhotoSet -> MatchGraph."""

from sfm_app.colmap.backend import backend
from sfm_app.colmap.database import create_database, read_match_graph
from sfm_app.colmap.features import extract_features, match_exhaustively
from sfm_app.context import RunContext
from sfm_app.diagnosis import NOTHING_MATCHED, why_no_scene
from sfm_app.types import MatchGraph, PhotoSet


def match_photos(photos: PhotoSet, run: RunContext) -> MatchGraph:
    """Find SIFT features and match every photo with every other, without geometric verification.

    Raises:
        ReconstructionError: no two photos have matches.
    """
    place, options = run.workspace, run.settings.matching
    names = [photo.name for photo in photos.photos]
    for suffix in ("", "-wal", "-shm"):
        place.database.with_name(place.database.name + suffix).unlink(missing_ok=True)
    with backend("finding features"):
        create_database(place.database, photos)
        extraction = extract_features(place.database, place.photos, names, options, run.workers, run.progress)
    with backend("matching photos"):
        matching = match_exhaustively(place.database, len(names), options, run.workers, run.progress)
    graph = load_match_graph(photos, run)
    run.record(
        keypoints={graph.images[key].name: len(points) for key, points in graph.keypoints.items()},
        pairs=len(graph.matches),
        matches=sum(len(rows) for rows in graph.matches.values()),
        colmap={"extraction": extraction, "matching": matching},
    )
    if not graph.matches:
        raise why_no_scene(graph, NOTHING_MATCHED, options).error()
    return graph


def load_match_graph(photos: PhotoSet, run: RunContext) -> MatchGraph:
    """Read the match graph back from the database."""
    with backend("reading the database"):
        return read_match_graph(run.workspace.database, photos)
