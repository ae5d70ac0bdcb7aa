"""From relative poses to a COLMAP model: all steps between calibration and the last bundle adjustment.

`passes` maps all groups of photos once, and `hypotheses` tries what may explain more. `attempt` maps one group and
scores the model, `parts` maps large groups, `look_alikes` finds merged places, and `splits` cuts models.
`feature_retry` finds finer features for unregistered photos, and `new_photos` adds photos to an earlier model.
"""

from sfm_app.mapping.hypotheses import reconstruct
from sfm_app.mapping.passes import Outcome

__all__ = ["Outcome", "reconstruct"]
