"""From relative poses to a COLMAP model: what happens between knowing K and the last bundle adjustment.

`passes` is the table of contents: map every group of photos, learn from the result, map again where that helps.
`seeds` ranks pairs to start from, `attempts` runs COLMAP's two mappers, `support` judges what they made by the matches
it explains, `joins` cuts what hangs together by contradictions only, `left_out` says why photos have no place.
"""

from sfm_app.reconstruction.passes import Outcome, reconstruct

__all__ = ["Outcome", "reconstruct"]
