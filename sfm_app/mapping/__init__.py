"""From relative poses to a COLMAP model: all steps between calibration and the last bundle adjustment.

`passes` is the table of contents: map every group of photos, learn cameras from the model, map again where that or
another hypothesis may help. `attempt` maps one group and scores the model, `parts` maps large groups, `look_alikes`
finds merged places, and `split_and_merge` cuts models. `feature_retry` adds finer features for unregistered photos, and
`incremental` adds photos to an earlier model.
"""

from sfm_app.mapping.feature_retry import MappedScene, retry_lost_photos
from sfm_app.mapping.passes import Outcome, reconstruct

__all__ = ["MappedScene", "Outcome", "reconstruct", "retry_lost_photos"]
