"""Compare the focal lengths that EXIF claims with those that the photos determine.

EXIF knows nothing of what was done to a photo later: a crop leaves the focal in pixels as it was, while the claim
shrinks with the longer side.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from sfm_app.numerical import Json
from sfm_app.runtime.context import RunContext
from sfm_app.types import MatchedImage

TOLERANCE = 0.08
"""Share of the focal by which a claim may be off: the 35 mm equivalent is rounded to a millimeter, counts along the
width or along the diagonal (4 % for photos of 4 : 3), and lenses breathe. Chosen by hand; not measured on its own."""
SIGMAS = 3.0
"""Standard deviations of the focal that the difference must exceed, too. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class FocalClaim:
    """What EXIF says of a camera, and what its photos say."""

    claimed_px: float
    """Median over its photos."""
    photos: int
    """Number of photos with a claim."""
    found_px: float
    deviation_px: float

    @property
    def is_contradicted(self) -> bool:
        """Whether the photos exclude the claim."""
        off = abs(self.found_px - self.claimed_px)
        return off > TOLERANCE * self.found_px and off > SIGMAS * self.deviation_px

    @property
    def text(self) -> str:
        """Both focals, and what may have happened to the photos."""
        deviation = f" +- {self.deviation_px:.3g}" if self.deviation_px > 0.0 else ""
        longer = self.found_px > self.claimed_px
        reason = "they were cropped or zoomed" if longer else "they were joined, or taken through another lens"
        return f"EXIF says {self.claimed_px:.0f} px, the photos say {self.found_px:.0f}{deviation}: {reason}"

    def to_dict(self) -> dict[str, Json]:
        """Return plain values for the manifest."""
        values = {"claimed_px": self.claimed_px, "found_px": self.found_px, "deviation_px": self.deviation_px}
        rounded: dict[str, Json] = {name: round(value, 2) for name, value in values.items()}
        text = {"text": self.text} if self.is_contradicted else {}
        return rounded | {"photos": self.photos, "contradicted": self.is_contradicted} | text


def focal_claim(images: Iterable[MatchedImage], found_px: float, deviation_px: float) -> FocalClaim | None:
    """Return the claim about a camera; None where EXIF says nothing.

    Args:
        images: its photos.
        found_px: focal length that the photos determine.
        deviation_px: its standard deviation.
    """
    claims = [image.exif_focal_px * shown_share(image) for image in images if image.exif_focal_px]
    return FocalClaim(float(np.median(claims)), len(claims), found_px, deviation_px) if claims else None


def shown_share(image: MatchedImage) -> float:
    """Return the longer side of the picture inside its bars over that of the photo, to which EXIF's focal refers."""
    return max(image.shown[2:]) / max(image.width, image.height) if image.shown else 1.0


def report_claims(found: Mapping[str, FocalClaim | None], run: RunContext) -> None:
    """Say which claims the photos contradict, and record all in the manifest; nothing where EXIF says nothing.

    Args:
        found: by name of the camera.
        run: the run.
    """
    known = {name: claim for name, claim in found.items() if claim is not None}
    if not known:
        return
    for name, claim in known.items():
        if claim.is_contradicted:
            run.progress.say(f"the photos {name}: {claim.text}")
    run.record(exif_focals={name: claim.to_dict() for name, claim in known.items()})
