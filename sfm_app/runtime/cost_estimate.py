"""Estimates of the minutes and the memory of a run from photos, pairs and settings, and plans within a memory limit.

The figures are from photos of 12 megapixels on one core of a server of 2023 (`python -m benchmarks.hundred`). Other
machines and scenes differ by a factor of two.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from sfm_app.settings import MeshSettings, Settings
from sfm_app.types import Photo

SHARE_OF_MACHINE = 0.8
"""Share of the machine's memory that a run may use without a limit. By hand."""
FUSED_AT_ONCE_MP = 45.0
"""Megapixels of depth maps that are fused at once, which take 3 GB; more save no time."""
MAPS_MB_PER_MP = 28
"""Memory in MB per megapixel of depth maps. Measured."""
REFINED_AT_ONCE_MP = 100.0
"""Megapixels of photos that the refinement holds at once, as in `meshing.refinement`."""
SERIAL_STAGES = ("scene", "mesh")
"""Stages that more workers hardly speed up."""


class OPTIONS:
    """Measured rates, each per megapixel (MP) of photos or depth maps."""

    features_per_mp: int = 4500
    """Photos with little texture have fewer. Measured."""
    fused_mb_per_mp: int = 70
    """Memory of COLMAP's fusion with its points, also those of one photo. Measured on castle-P19."""
    points_per_mp: int = 70_000
    """Fused points: 70 000 of a walk through a town, 58 000 of fountain-P11. Measured."""
    block_mb_per_point: float = 1600 / 1e6
    """Memory of the tetrahedra and their surface per fused point of a block. Measured."""
    depth_seconds_per_mp: float = 1.2
    """Core seconds of depth maps per neighbor. Measured."""
    finer_seconds_per_mp: float = 3.5
    """Core seconds of finer features, their matches and models. Measured on bathtub23."""
    refine_seconds_per_mp: float = 1.0
    """Core seconds of the surface's refinement. Measured."""
    refine_mb: float = 200.0
    """Memory of the refinement without photos. Measured."""
    refine_mb_per_mp: float = 25.0
    """Memory of the refinement per megapixel held at once, with divided triangles. Measured."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Expected cost of a run with a number of workers."""

    photos: int
    pairs: int
    workers: int
    core_seconds: Mapping[str, float]
    memory_mb: Mapping[str, float]
    """Both by stage; the memory is the peak."""

    def minutes(self, stages: Iterable[str]) -> float:
        """Return how many minutes these stages take."""
        return sum(self.core_seconds[name] / (1 if name in SERIAL_STAGES else self.workers) for name in stages) / 60

    def peak_mb(self, stages: Iterable[str]) -> float:
        """Return the most memory in MB that these stages hold."""
        return max((self.memory_mb[name] for name in stages), default=0.0)

    def text(self, stages: Iterable[str]) -> str:
        """Return photos, pairs, time, memory and workers in words."""
        names = list(stages)
        minutes, gigabytes = self.minutes(names), self.peak_mb(names) / 1000
        duration = minutes_text(minutes)
        workers = f"{self.workers} worker{'s' if self.workers > 1 else ''}"
        hard = " or more" if minutes >= 1.5 and "scene" in names else ""  # photos may be hard to place
        size = f"{self.photos} photos, {self.pairs} pair{'' if self.pairs == 1 else 's'}"
        return f"{size}: {duration}{hard}; {gigabytes:.1f} GB with {workers}"


def minutes_text(minutes: float) -> str:
    """Return expected minutes in words."""
    if minutes < 1.5:
        return "a minute or two" if minutes > 0.6 else "a minute at most"
    step = 1 if minutes < 10 else 5 if minutes < 60 else 10
    return f"about {max(1, round(minutes / step) * step)} minutes"


def finer_minutes(sizes: Iterable[tuple[int, int]], settings: Settings, workers: int) -> float:
    """Return how many minutes finer features of photos of these sizes take."""
    searched = sum(_megapixels(size, settings.matching.max_image_size_px) for size in sizes)
    return OPTIONS.finer_seconds_per_mp * searched / workers / 60


def largest_photo_megapixels(limit_mb: float) -> float:
    """Return the megapixels of the largest photo with which one worker can texture the surface."""
    return max(2.0, (limit_mb - 1650) / 8)


def cache_gb(limit_mb: float) -> float:
    """Return the size of fusion's cache of depth maps in GB; points and surface need memory, too."""
    return min(64.0, max(0.25, (limit_mb - 1500) / 1000))


def block_count(points: float, options: MeshSettings) -> int:
    """Return the number of blocks of the surface: one, or blocks of half the permitted number of points."""
    return 1 if points <= options.block_points else math.ceil(2 * points / options.block_points)


def block_workers(workers: int, limit_mb: float, options: MeshSettings) -> int:
    """Return how many blocks of the surface are made at once within the memory limit."""
    refined_mb = _refine_mb(REFINED_AT_ONCE_MP) if options.max_image_size_px else 0.0
    fit = (limit_mb - 1000) / max(OPTIONS.block_mb_per_point * options.block_points / 2, refined_mb)
    return max(1, int(min(workers, fit)))


def make_plan(photos: Iterable[Photo], settings: Settings, workers: int, limit_mb: float = math.inf) -> Plan:
    """Estimate the costs of all stages after the photos stage; a small memory limit means a small cache of fusion."""
    from sfm_app.retrieval import expected_pairs  # loads OpenCV and SciPy

    sizes = [(photo.width, photo.height) for photo in photos]
    count, pairs = len(sizes), expected_pairs(len(sizes), settings.matching)
    largest, whole_mp = max(map(math.prod, sizes), default=0) / 1e6, sum(map(math.prod, sizes)) / 1e6
    searched = [_megapixels(size, settings.matching.max_image_size_px) for size in sizes]
    mapped = [_megapixels(size, settings.depth.max_image_size_px) for size in sizes]
    features = sum(min(settings.matching.max_features, OPTIONS.features_per_mp * one) for one in searched) / max(
        count, 1
    )
    refined = [_megapixels(size, settings.mesh.max_image_size_px) for size in sizes]
    pages = settings.texture.max_pages * settings.texture.max_atlas_px**2 / 1e6
    dense, points = sum(mapped), OPTIONS.points_per_mp * sum(mapped)
    blocks = block_count(points, settings.mesh)
    block_mb = _blocks_mb(points, blocks, sum(refined), settings.mesh) * min(
        block_workers(workers, limit_mb, settings.mesh) if blocks > 1 else 1, blocks
    )
    fused_mb = OPTIONS.fused_mb_per_mp * (
        dense if dense <= FUSED_AT_ONCE_MP else min(dense, workers * FUSED_AT_ONCE_MP)
    )
    return Plan(
        count,
        pairs,
        workers,
        core_seconds={
            "match_graph": sum(searched) + 0.25 * pairs * (features / 8192) ** 2,
            "view_graph": 0.04 * pairs * features / 8192,
            "intrinsics": 0.03 * pairs,
            "scene": 2.0 * count,
            "scale": 1.0 + (0.2 * whole_mp if settings.scale.markers else 0.0),
            "depth_maps": OPTIONS.depth_seconds_per_mp * sum(mapped) * settings.depth.neighbors,
            "mesh": 5
            + (1.6 if dense <= FUSED_AT_ONCE_MP else 2.7) * dense
            + OPTIONS.refine_seconds_per_mp * sum(refined) / workers,
            "texture": 0.1 * whole_mp,
            "files": 1.0,
        },
        memory_mb={
            "match_graph": 450 + workers * (120 + 220 * max(searched, default=0) + 8 * largest) + 0.04 * pairs,
            "view_graph": 450 + 0.05 * pairs + 1.0 * count,
            "intrinsics": 500 + 0.06 * pairs,
            "scene": 700 + 15.5 * count * features / 8192,
            "scale": 600 + workers * 8 * largest + 5.0 * count,
            "depth_maps": 750 + workers * 150 * max(mapped, default=0) + 5.0 * count,
            "mesh": 950 + max(min(1000 * cache_gb(limit_mb), fused_mb), block_mb),
            "texture": 1000 + (8 + 3 * (blocks - 1)) * pages + workers * 8 * largest + 3.0 * count,
            "files": 850 + (8 + 3 * (blocks - 1)) * pages + 5.0 * count,
        },
    )


def _blocks_mb(points: float, blocks: int, refined_mp: float, options: MeshSettings) -> float:
    """Return the memory in MB of one block of the surface; the photos of all blocks have `refined_mp` megapixels."""
    meshed_mb = OPTIONS.block_mb_per_point * points / blocks
    return max(meshed_mb, _refine_mb(refined_mp / blocks)) if options.max_image_size_px else meshed_mb


def choose_plan(
    photos: Iterable[Photo], settings: Settings, workers: int, limit_mb: float, stages: Iterable[str]
) -> Plan:
    """Return the plan of these stages with the most workers within the memory limit; if none fits, with one."""
    chosen, names = list(photos), list(stages)
    plans = (make_plan(chosen, settings, number, limit_mb) for number in range(workers, 0, -1))
    return next((plan for plan in plans if plan.peak_mb(names) <= limit_mb), make_plan(chosen, settings, 1, limit_mb))


def _refine_mb(megapixels: float) -> float:
    return OPTIONS.refine_mb + megapixels + OPTIONS.refine_mb_per_mp * min(megapixels, REFINED_AT_ONCE_MP)


def _megapixels(size: tuple[int, int], longest: int) -> float:
    scale = min(1.0, longest / max(size))
    return size[0] * size[1] * scale**2 / 1e6
