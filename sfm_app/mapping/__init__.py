"""From relative poses to a COLMAP model: all steps between calibration and the last bundle adjustment.

`mapping_passes` is the table of contents: map every group of photos, learn cameras from the model, map again where that
helps. `initial_pairs` ranks pairs to start from, `mapping_runs` runs COLMAP's two mappers, and `support` scores their
models by the matches they explain. `model_split` cuts joins that more matches contradict than support, `second_look`
adds finer features (`added_matches`) for unregistered photos, and `unregistered` says why photos have no pose.
"""

from sfm_app.mapping.feature_retry import MappedScene, retry_lost_photos
from sfm_app.mapping.passes import Outcome, reconstruct

__all__ = ["MappedScene", "Outcome", "reconstruct", "retry_lost_photos"]
