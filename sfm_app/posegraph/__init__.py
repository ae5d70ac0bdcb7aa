"""From fundamental matrices and cameras to relative poses that agree with each other.

`pair_pose` turns one fundamental matrix and two cameras into a relative pose, `rotations` finds the rotations of all
photos at once and which pairs contradict them, `guided` gives those and the rejected ones a second chance with what
the others know, `graph` puts it together.
"""

from sfm_app.posegraph.graph import PoseGraphOptions, build_pose_graph, with_model

__all__ = ["PoseGraphOptions", "build_pose_graph", "with_model"]
