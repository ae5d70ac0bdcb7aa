"""Which relative poses mapping follows: all of a small set, some of each photo of a large one."""

from dataclasses import replace

from sfm_app.retrieval.choice import choose_by_rank
from sfm_app.types import PoseGraph

MOST_FULLY_MAPPED, MAPPED_PARTNERS = 250, 16
"""Photos up to which mapping uses all pairs, and partners of each photo above. Chosen by hand."""


def pairs_to_map(graph: PoseGraph) -> PoseGraph:
    """Return the pose graph with as many pairs as mapping needs; all of them in small sets.

    Tracks join along a few pairs of each photo. COLMAP follows all pairs of every point again and again.

    Args:
        graph: relative poses.
    """
    photos = {photo for pair in graph.poses for photo in pair}
    if len(photos) <= MOST_FULLY_MAPPED:
        return graph
    counts = {pair: pose.inlier_count for pair, pose in graph.poses.items()}
    chosen = choose_by_rank(counts, 0, MAPPED_PARTNERS)
    return replace(graph, poses={pair: pose for pair, pose in graph.poses.items() if pair in chosen})
