"""Rendered photo sets that test a calibrator by their lens, path or mixture of cameras."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

from benchmarks.common.photo_sets import PhotoSet, TrueCamera
from benchmarks.synthetic.walks import orbit
from sfm_app.synthetic.cameras import ArcOptions, Views, arc, make_camera
from sfm_app.synthetic.photo_folder import load_truth, save_truth, write_photo_folder
from sfm_app.synthetic.scenes import courtyard

SIZE = (960, 640)
LENSES = (-0.25, -0.1, 0.1)
"""Values of k1 of COLMAP's SIMPLE_RADIAL."""
TWO_FOCALS = (1.05, 1.5)
"""Focal lengths in widths, of two cameras with photos of one size."""


def walk(radial: float, seed: int) -> Views:
    """Make a hand-held walk; every seed has its own path and its own camera."""
    return arc(make_camera(*SIZE, focal_widths=1.05 + 0.1 * seed, radial=radial), seed=seed)


def turntable(seed: int) -> Views:
    """Make an orbit, which leaves the focal undetermined."""
    return orbit(make_camera(*SIZE), sweep_deg=80.0 + 20.0 * seed)


def two_cameras(seed: int) -> Views:
    """Make views with a longer lens in every other photo; nothing in the files tells them apart."""
    first, second = (make_camera(*SIZE, focal_widths=focal) for focal in TWO_FOCALS)
    views = arc(first, ArcOptions(photos=14), seed=seed)
    return views.with_camera(second, sorted(views.cameras)[1::2])


KINDS: Mapping[str, Callable[[int], Views]] = {
    "rendered": partial(walk, 0.0),
    **{f"rendered k1={k1:+.2f}": partial(walk, k1) for k1 in LENSES},
    "rendered orbit": turntable,
    "rendered two cameras": two_cameras,
}


def rendered_sets(seeds: int, cache: Path) -> Iterator[PhotoSet]:
    """Yield every kind for each of the seeds; complete folders in the cache are reused."""
    for kind, views in KINDS.items():
        for seed in range(seeds):
            name = f"{kind} seed {seed}"
            folder = cache / "photos" / name.replace(" ", "_")
            yield PhotoSet(name, folder, _truth(views(seed), folder, cache / "truth" / folder.name))


def _truth(views: Views, photos: Path, folder: Path) -> dict[str, TrueCamera]:
    if not folder.exists():  # written last
        save_truth(write_photo_folder(photos, courtyard(), views), folder)
    return {Path(name).stem: TrueCamera(camera.K, camera.radial) for name, camera in load_truth(folder).cameras.items()}
