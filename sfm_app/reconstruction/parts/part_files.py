"""The inputs of one part as a file, so that any process, here or elsewhere, can map it."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.atomic_io import replace_atomically
from sfm_app.hashing import load_arrays
from sfm_app.numerical import json_text
from sfm_app.reconstruction.mapping_runs import Group
from sfm_app.settings import Settings
from sfm_app.types import (
    Intrinsics,
    LookAlikes,
    MatchedImage,
    MatchGraph,
    PairId,
    PoseGraph,
    RelativePose,
    ViewGraph,
)  # fmt: skip

INPUTS, RESULT = "inputs.npz", "result.json"
"""Files in the folder of a part: what it is mapped from, and what became of it."""
Arrays = dict[str, NDArray[Any]]


def pairs_of_parts(pairs: Iterable[PairId], parts: Sequence[Sequence[int]]) -> list[list[PairId]]:
    """Return the pairs within each part, in their order; one look at each pair, however many parts there are.

    Args:
        pairs: of photos.
        parts: ids of their photos; parts may share photos.
    """
    members: dict[int, set[int]] = {}
    for number, photos in enumerate(parts):
        for photo in photos:
            members.setdefault(photo, set()).add(number)
    found: list[list[PairId]] = [[] for _ in parts]
    nowhere: set[int] = set()
    for a, b in pairs:
        for number in members.get(a, nowhere) & members.get(b, nowhere):
            found[number].append((a, b))
    return found


def part_of_group(group: Group, photos: Sequence[int], pairs: Sequence[PairId]) -> Group:
    """Return what concerns some photos of a group.

    Args:
        group: photos with their matches, geometry and cameras.
        photos: ids of the part.
        pairs: those with matches, within the part.
    """
    matches, fits, poses = group.matches, group.views.fits, group.graph.poses
    images = {photo: matches.images[photo] for photo in photos}
    names = {image.name: group.intrinsics.camera_name(image) for image in images.values()}
    cameras = {name: camera for name, camera in group.intrinsics.cameras.items() if name in set(names.values())}
    return Group(
        tuple(photos),
        MatchGraph(
            images,
            {photo: matches.keypoints[photo] for photo in photos},
            {pair: matches.matches[pair] for pair in pairs},
        ),
        ViewGraph({pair: fits[pair] for pair in pairs if pair in fits}, {}),
        PoseGraph({pair: poses[pair] for pair in pairs if pair in poses}, {}, (tuple(photos),)),
        Intrinsics(cameras, names, {photo: image.name for photo, image in images.items()}),
    )


@dataclass(frozen=True, slots=True, eq=False)
class PartInputs:
    """What a part is mapped from."""

    part: Group
    """Photos, matches, geometry, relative poses and cameras."""
    mapped: frozenset[PairId]
    """Pairs of the pose graph that mapping follows."""
    settings: Settings
    asked: bool
    """Whether everything is mapped anew where a false join is found, so that no other mapper is needed then."""


def write_inputs(path: Path, inputs: PartInputs) -> None:
    """Write the inputs of a part, as a whole.

    Args:
        path: file to write.
        inputs: of the part.
    """
    part = inputs.part
    known = {
        "photos": list(part.photos),
        # frames and times of photos do not matter to mapping
        "images": [asdict(replace(image, gps=None, shown=None)) for image in part.matches.images.values()],
        "intrinsics": part.intrinsics.to_dict(),
        "settings": inputs.settings.model_dump(mode="json"),
        "asked": inputs.asked,
    }
    arrays = _match_arrays(part.matches) | _pose_arrays(part.graph)
    arrays |= {f"view_{name}": array for name, array in part.views.to_arrays().items()}
    arrays |= {"mapped": np.array(sorted(inputs.mapped), np.int64).reshape(-1, 2), "known": np.array(json_text(known))}
    with replace_atomically(path) as beside, beside.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def read_inputs(path: Path) -> PartInputs:
    """Read back what `write_inputs` wrote."""
    arrays = load_arrays(path)
    known = json.loads(str(arrays["known"]))
    images = {image["id"]: MatchedImage(**image) for image in known["images"]}
    views = {name.removeprefix("view_"): array for name, array in arrays.items() if name.startswith("view_")}
    part = Group(
        tuple(known["photos"]),
        _matches_from_arrays(images, arrays),
        ViewGraph.from_arrays(views),
        PoseGraph(_poses_from_arrays(arrays), {}, (tuple(known["photos"]),)),
        Intrinsics.from_dict(known["intrinsics"]),
    )
    mapped = frozenset((int(a), int(b)) for a, b in arrays["mapped"])
    return PartInputs(part, mapped, Settings.from_mapping(known["settings"]), known["asked"])


PlainJoin = tuple[list[list[int]], float]
"""Pairs of a false join, and the share that is missing across it, as JSON has them."""


def joins_to_plain(joins: Sequence[LookAlikes]) -> list[PlainJoin]:
    """Return false joins as plain values for JSON."""
    return [([list(pair) for pair in join.pairs], join.missing) for join in joins]


def joins_from_plain(values: Sequence[PlainJoin]) -> tuple[LookAlikes, ...]:
    """Rebuild from `joins_to_plain`."""
    return tuple(LookAlikes(tuple((a, b) for a, b in pairs), missing) for pairs, missing in values)


def _match_arrays(matches: MatchGraph) -> Arrays:
    keypoints, rows = list(matches.keypoints.values()), list(matches.matches.values())
    return {
        "keypoint_photos": np.array(list(matches.keypoints), np.int64),
        "keypoint_counts": np.array([len(x) for x in keypoints], np.int64),
        "keypoints": np.concatenate([*keypoints, np.zeros((0, 2))]),
        "match_pairs": np.array(list(matches.matches), np.int64).reshape(-1, 2),
        "match_counts": np.array([len(row) for row in rows], np.int64),
        "matches": np.concatenate([*rows, np.zeros((0, 2), np.uint32)]).astype(np.uint32),
    }


def _matches_from_arrays(images: Mapping[int, MatchedImage], arrays: Mapping[str, NDArray[Any]]) -> MatchGraph:
    keypoints = np.split(arrays["keypoints"], np.cumsum(arrays["keypoint_counts"]))[:-1]
    rows = np.split(arrays["matches"], np.cumsum(arrays["match_counts"]))[:-1]
    return MatchGraph(
        images,
        dict(zip(arrays["keypoint_photos"].tolist(), keypoints, strict=True)),
        dict(zip(map(tuple, arrays["match_pairs"].tolist()), rows, strict=True)),
    )


def _pose_arrays(graph: PoseGraph) -> Arrays:
    poses = list(graph.poses.values())
    return {
        "pose_pairs": np.array(list(graph.poses), np.int64).reshape(-1, 2),
        "pose_R": np.array([pose.R for pose in poses]).reshape(-1, 3, 3),
        "pose_t": np.array([pose.t for pose in poses]).reshape(-1, 3),
        "pose_counts": np.array([len(pose.inliers) for pose in poses], np.int64),
        "pose_inliers": np.concatenate([*(pose.inliers for pose in poses), np.zeros(0, bool)]),
        "pose_angle_deg": np.array([pose.angle_deg for pose in poses], np.float64),
        "pose_in_front": np.array([pose.in_front for pose in poses], np.float64),
        "pose_kind": np.array([pose.kind for pose in poses], np.str_),
        "pose_guided": np.array([pose.guided for pose in poses], np.bool_),
    }


def _poses_from_arrays(arrays: Mapping[str, NDArray[Any]]) -> dict[PairId, RelativePose]:
    columns = (
        arrays["pose_R"],
        arrays["pose_t"],
        np.split(arrays["pose_inliers"], np.cumsum(arrays["pose_counts"]))[:-1],
        arrays["pose_angle_deg"].tolist(),
        arrays["pose_in_front"].tolist(),
        arrays["pose_kind"].tolist(),
        arrays["pose_guided"].tolist(),
    )
    pairs = map(tuple, arrays["pose_pairs"].tolist())
    return {pair: RelativePose(*values) for pair, *values in zip(pairs, *columns, strict=True)}
