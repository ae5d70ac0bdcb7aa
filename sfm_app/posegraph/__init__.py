"""From fundamental matrices and cameras to relative poses that agree with each other.

`pair_pose` estimates the relative pose of one pair, `rotations` the rotations of all photos and the pairs that
contradict them, `look_alikes` the pairs that confuse equal things, and `graph` combines them.
"""

from sfm_app.posegraph.graph import PoseGraphOptions, build_pose_graph, with_model

__all__ = ["PoseGraphOptions", "build_pose_graph", "with_model"]
