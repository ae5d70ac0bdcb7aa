"""Large groups of photos in parts: cut where the pose graph is thin, mapped side by side, joined and adjusted together.

`cut` divides the pose graph, `part_mapping` maps every part in a process and a folder of its own (`part_files`,
`part_process`), `joins` finds similarities between the models of parts, `frames` puts all of them into one frame and
drops joins that contradict the others, and `merge` makes one model of them. `parts_run` is the table of contents.
"""

from sfm_app.reconstruction.parts.parts_run import is_convincing, map_in_parts, part_size

__all__ = ["is_convincing", "map_in_parts", "part_size"]
