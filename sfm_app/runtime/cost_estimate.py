"""Estimates of the minutes and the memory of a run from photos, pairs and settings, and plans within a memory limit.

The figures come from photos of 12 megapixels on one core of a server of 2023 (`python -m benchmarks.hundred`). Other
machines differ by a factor of two, and so do other scenes.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from sfm_app.retrieval import expected_pairs
from sfm_app.settings import MeshSettings, Settings
from sfm_app.types import Photo

MEGA = 1e6
SHARE_OF_MACHINE = 0.8
"""Share of the machine's memory that a run may use where no limit is set."""
FEATURES_PER_MP = 4500
"""Photos with little texture have fewer."""

FUSED_AT_ONCE_MP = 75.0
"""Megapixels of depth maps that are fused at once; more are fused in blocks. Chosen on 1000 photos of a town, where 50,
75 and 150 cost the same CPU seconds, and 6.5, 6.8 and 14 GB with two workers."""
MAPS_MB_PER_MP = 28
"""Memory of the maps themselves; on photos of a town."""
FUSED_MB_PER_MP = 42
"""Memory of COLMAP's fusion for each megapixel of depth maps, points included; on photos of a town."""
POINTS_PER_MP = 70_000
"""Fused points of each megapixel of depth maps: 70 000 of a walk through a town, 58 000 of fountain-P11."""
BLOCK_MB_PER_POINT = 1200 / MEGA
"""Memory of Poisson's reconstruction and of the surface that it gives, for each point of a block: COLMAP's process had
950 bytes for each of 1.3 million points of a town."""
DEPTH_SECONDS_PER_MP = 1.2
"""Core seconds of the depth maps for each of their megapixels and each neighbor: 1.0 on fountain-P11 with one level,
1.2 on castle-P19 with two."""
REFINE_SECONDS_PER_MP, REFINE_MB, REFINE_MB_PER_MP = 1.0, 200.0, 25.0
"""Core seconds of the surface's refinement for each megapixel of photos, its memory, and that for each megapixel of the
photos that it holds at once, divided triangles included; on fountain-P11 and `ornament`."""
REFINED_AT_ONCE_MP = 100.0
"""Megapixels of photos that the refinement holds at once, as `meshing.refinement.sights` has it."""
SERIAL_STAGES = ("scene", "mesh")
"""Stages in which more workers are of little use."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Expected cost of a run with a number of workers."""

    photos: int
    pairs: int
    workers: int
    core_seconds: Mapping[str, float]
    """By stage."""
    memory_mb: Mapping[str, float]
    """Most memory at any moment, by stage."""

    def minutes(self, stages: Iterable[str]) -> float:
        """Return how many minutes these stages take."""
        return sum(self.core_seconds[name] / (1 if name in SERIAL_STAGES else self.workers) for name in stages) / 60

    def peak_mb(self, stages: Iterable[str]) -> float:
        """Return the most memory in MB that these stages hold."""
        return max((self.memory_mb[name] for name in stages), default=0.0)

    def text(self, stages: Iterable[str]) -> str:
        """Describe the plan for people."""
        names = list(stages)
        minutes, gigabytes = self.minutes(names), self.peak_mb(names) / 1000
        how_long = "a minute or two" if minutes > 0.6 else "a minute at most"
        if minutes >= 1.5:
            how_long = f"about {_round_minutes(minutes)} minutes"
        workers = f"{self.workers} worker{'s' if self.workers > 1 else ''}"
        hard = " or more" if minutes >= 1.5 and "scene" in names else ""  # photos may be hard to place
        size = f"{self.photos} photos, {self.pairs} pair{'' if self.pairs == 1 else 's'}"
        return f"{size}: {how_long}{hard}; {gigabytes:.1f} GB with {workers}"


def largest_photo_megapixels(limit_mb: float) -> float:
    """Return the most megapixels of a photo with which one worker can texture the surface."""
    return max(2.0, (limit_mb - 1650) / 8)


def cache_gb(limit_mb: float) -> float:
    """Return the size of fusion's cache of depth maps in GB; the points and the surface need memory, too.

    Where the cache is smaller than the maps, fusion reads all of them again and again: 200 photos were not done after
    half an hour with 2 GB.
    """
    return min(64.0, max(0.25, (limit_mb - 1500) / 1000))


def block_count(points: float, options: MeshSettings) -> int:
    """Return the number of blocks of the surface: one, or such as have half as many points as one may have.

    Two workers then need no more memory than one does for the largest surface that is made at once.

    Args:
        points: fused from all depth maps.
        options: most points of a surface that is made at once.
    """
    return 1 if points <= options.block_points else math.ceil(2 * points / options.block_points)


def block_workers(workers: int, limit_mb: float, options: MeshSettings) -> int:
    """Return how many blocks of the surface are made at once.

    Args:
        workers: the most.
        limit_mb: most memory.
        options: most points of a surface that is made at once.
    """
    refined_mb = _refine_mb(REFINED_AT_ONCE_MP) if options.max_image_size_px else 0.0
    fit = (limit_mb - 1000) / max(BLOCK_MB_PER_POINT * options.block_points / 2, refined_mb)
    return max(1, int(min(workers, fit)))


def make_plan(photos: Iterable[Photo], settings: Settings, workers: int, limit_mb: float = math.inf) -> Plan:
    """Estimate the costs of all stages after the photos stage.

    Args:
        photos: that are used.
        settings: in force.
        workers: that work at once.
        limit_mb: most memory; fusion caches less where it is small.
    """
    sizes = [(photo.width, photo.height) for photo in photos]
    count, pairs = len(sizes), expected_pairs(len(sizes), settings.matching)
    largest = max((width * height for width, height in sizes), default=0) / MEGA
    searched = [_megapixels(size, settings.matching.max_image_size_px) for size in sizes]
    mapped = [_megapixels(size, settings.depth.max_image_size_px) for size in sizes]
    features = sum(min(settings.matching.max_features, FEATURES_PER_MP * one) for one in searched) / max(count, 1)
    refined = [_megapixels(size, settings.mesh.max_image_size_px) for size in sizes]
    pages = settings.texture.max_pages * settings.texture.max_atlas_px**2 / MEGA
    dense, points = sum(mapped), POINTS_PER_MP * sum(mapped)
    blocks = block_count(points, settings.mesh)
    together = block_workers(workers, limit_mb, settings.mesh) if blocks > 1 else 1
    block_mb = BLOCK_MB_PER_POINT * points / blocks
    if settings.mesh.max_image_size_px:
        block_mb = max(block_mb, _refine_mb(sum(refined) / blocks))
    block_mb *= min(together, blocks)
    fused_mb = FUSED_MB_PER_MP * (dense if dense <= FUSED_AT_ONCE_MP else min(dense, workers * FUSED_AT_ONCE_MP))
    return Plan(
        count,
        pairs,
        workers,
        core_seconds={
            "match_graph": sum(searched) + 0.25 * pairs * (features / 8192) ** 2,
            "view_graph": 0.04 * pairs * features / 8192,
            "intrinsics": 0.03 * pairs,
            "scene": 2.0 * count,
            "scale": 1.0
            + (0.2 * sum(width * height for width, height in sizes) / MEGA if settings.scale.markers else 0.0),
            "depth_maps": DEPTH_SECONDS_PER_MP * sum(mapped) * settings.depth.neighbors,
            "mesh": 5
            + (1.6 if dense <= FUSED_AT_ONCE_MP else 2.7) * dense
            + REFINE_SECONDS_PER_MP * sum(refined) / workers,
            "texture": 0.1 * sum(width * height for width, height in sizes) / MEGA,
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


def choose_plan(
    photos: Iterable[Photo], settings: Settings, workers: int, limit_mb: float, stages: Iterable[str]
) -> Plan:
    """Return the plan with the most workers that stays within the memory limit; with one worker if none does.

    Args:
        photos, settings, limit_mb: photos in use; settings in force; most memory.
        workers: the most that may work at once.
        stages: names of those that will run.
    """
    chosen, names = list(photos), list(stages)
    plans = (make_plan(chosen, settings, number, limit_mb) for number in range(workers, 0, -1))
    return next((plan for plan in plans if plan.peak_mb(names) <= limit_mb), make_plan(chosen, settings, 1, limit_mb))


def _refine_mb(megapixels: float) -> float:
    """Return the memory in MB of the surface's refinement with photos of so many megapixels."""
    return REFINE_MB + megapixels + REFINE_MB_PER_MP * min(megapixels, REFINED_AT_ONCE_MP)


def _megapixels(size: tuple[int, int], longest: int) -> float:
    """Return the megapixels of a photo after it is scaled down to a longest side."""
    scale = min(1.0, longest / max(size))
    return size[0] * size[1] * scale**2 / MEGA


def _round_minutes(minutes: float) -> int:
    """Round to a multiple of 1, 5 or 10, depending on the size."""
    step = 1 if minutes < 10 else 5 if minutes < 60 else 10
    return max(1, round(minutes / step) * step)
