"""From relative poses to a COLMAP model: what happens between knowing K and the last bundle adjustment.

`mapping_passes` is the table of contents: map every group of photos, learn from the result, map again where that helps.
`initial_pairs` ranks pairs to start from, `mapping_runs` runs COLMAP's two mappers, `support` judges what they made by
the matches it explains, `model_split` cuts what hangs together by contradictions only, `second_look` seeks finer
features (`added_matches`) where photos found no place, `unregistered` says why they have none.
"""

from sfm_app.reconstruction.mapping_passes import Outcome, reconstruct
from sfm_app.reconstruction.second_look import Found, look_again

__all__ = ["Found", "Outcome", "look_again", "reconstruct"]
