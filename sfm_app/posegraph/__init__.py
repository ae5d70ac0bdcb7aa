"""From fundamental matrices and cameras to relative poses that agree with each other.

`pair_pose` turns one fundamental matrix and two cameras into a relative pose, `rotations` estimates the rotations of
all photos and finds the pairs that contradict them, `guided` re-estimates these and other rejected pairs with the
rotation known from the rest, and `graph` runs all of them.
"""

from sfm_app.posegraph.graph import PoseGraphOptions, build_pose_graph, with_model

__all__ = ["PoseGraphOptions", "build_pose_graph", "with_model"]
