"""intrinsics: ViewGraph -> Intrinsics."""

from collections import Counter
from dataclasses import replace

from sfm_app.estimation.calibrating import find_or_keep_intrinsics
from sfm_app.estimation.claims import find_priors
from sfm_app.products import write_intrinsics
from sfm_app.runtime.context import RunContext
from sfm_app.types import Calibration, Intrinsics, MatchGraph, ViewGraph


def make(matches: MatchGraph, views: ViewGraph, run: RunContext) -> Intrinsics:
    """Find the cameras, write them to calibration.json and record their figures."""
    priors = find_priors(matches, run)
    intrinsics = replace(find_or_keep_intrinsics(matches.with_priors(priors), views, run), priors=priors)
    photos = Counter(intrinsics.camera_of.values())
    run.record(
        cameras={name: _summary(camera) for name, camera in intrinsics.cameras.items()},
        photos={name: photos[name] for name in intrinsics.cameras},
        identifiable=sum(camera.identifiable for camera in intrinsics.cameras.values()),
    )
    write_intrinsics(intrinsics, run.workspace)
    return intrinsics


def _summary(camera: Calibration) -> dict[str, object]:
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    plain = {name: round(float(value), 3) for name, value in (("fx", fx), ("fy", fy), ("cx", cx), ("cy", cy))}
    plain["k1"] = round(camera.radial, 5)
    return plain | {"method": camera.method, "identifiable": camera.identifiable, "reason": camera.reason}
