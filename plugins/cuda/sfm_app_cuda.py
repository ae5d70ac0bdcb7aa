"""COLMAP's PatchMatch stereo (Schoenberger et al., ECCV 2016) on the GPU, as a plug-in of sfm-app.

Photos are processed one by one, first alone, then with the depths of their neighbors. So progress is shown per photo,
and a run that was killed continues at the photo where it stopped: COLMAP does not compute existing maps again.
"""

import zlib  # noqa: F401 - before pycolmap, whose bundled deflate breaks Python's if it is loaded first
from collections.abc import Iterable
from functools import partial
from threading import Lock

import pycolmap

from sfm_app.errors import BackendError
from sfm_app.plugins import DepthMethod, hookimpl
from sfm_app.settings import DepthSettings
from sfm_app.stereo import DepthTask, Kind
from sfm_app.types import Rejected

CONFIG = "patch-match-one.cfg"


def unavailable() -> str:
    """Return why the GPU cannot be used; empty if it can."""
    if not pycolmap.has_cuda:
        return "this pycolmap was built without CUDA (pip install pycolmap-cuda12)"
    devices = getattr(pycolmap, "get_num_cuda_devices", None)
    return "no CUDA device is found" if devices is not None and devices() < 1 else ""


def make(task: DepthTask) -> list[Rejected | None]:
    """Make depth and normal maps of all photos that have neighbors."""
    gpu = Lock()
    everything = range(len(task.views))
    task.map(partial(_match, task=task, geometric=False, gpu=gpu), everything, "matching depths")
    return task.map(partial(_match, task=task, geometric=True, gpu=gpu), everything, "confirming depths")


def _match(index: int, task: DepthTask, geometric: bool, gpu: Lock) -> Rejected | None:
    view = task.views[index]
    neighbors = [task.views[other] for other in task.ranked[index]]
    kind: Kind = "geometric" if geometric else "photometric"
    if not neighbors:
        return Rejected("no photo shares enough points")
    with gpu:
        if not task.store.has(view, kind):
            config = task.folder / "stereo" / CONFIG
            config.write_text(f"{view.name}\n{', '.join(other.name for other in neighbors)}\n", encoding="utf-8")
            try:
                pycolmap.patch_match_stereo(task.folder, options=_options(task.options, geometric), config_path=config)
            except Exception as err:  # pycolmap raises RuntimeError and ValueError without a common base
                raise BackendError(
                    f"PatchMatch failed on {view.name}: {err}", hint="method = cpu needs no GPU"
                ) from err
            config.unlink()
    return None if task.store.has(view, kind) else Rejected("PatchMatch gave no depth map")


def _options(settings: DepthSettings, geometric: bool) -> pycolmap.PatchMatchOptions:
    options = pycolmap.PatchMatchOptions()
    options.max_image_size = settings.max_image_size_px
    options.geom_consistency = geometric
    options.filter = geometric
    options.filter_min_num_consistent = settings.min_agreeing
    return options


@hookimpl
def sfm_depth_methods() -> Iterable[DepthMethod]:
    return [DepthMethod("patch-match", make, "COLMAP's PatchMatch stereo, with CUDA", unavailable)]
