#!/usr/bin/env python3
"""Run the two estimators alone, on synthetic matches: python examples/one_estimator.py"""

import sfm_app
from sfm_app.synthetic.correspondences import PairOptions, TrackOptions, make_pair, make_tracks


def main() -> None:
    """Estimate F of one pair, and K from all pairs."""
    pair = make_pair(PairOptions(outliers=0.5), seed=1)
    fit = sfm_app.estimate_fundamental(pair.x1, pair.x2, method="lev-ransac", seed=0)
    if not fit:
        raise SystemExit(f"rejected: {fit.reason}")
    print(f"{fit.inlier_count} of {len(pair.x1)} matches agree, rms {fit.rms_px:.2f} px, {fit.trials} samples")

    tracks = make_tracks(TrackOptions(), seed=1)
    calibration = sfm_app.calibrate_fundamentals(tracks.F, tracks.size, method="zero-curves")
    print(f"K, identifiable: {calibration.identifiable}\n{calibration.K.round(1)}")


if __name__ == "__main__":  # where processes are spawned, each of them imports the script
    main()
