"""The frame of everything that leaves the program, and how well its unit is known."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sfm_app.geometry.similarity import Similarity
from sfm_app.scale.evidence import ScaleEvidence
from sfm_app.types import Frustum, Model

IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))


@dataclass(frozen=True, slots=True, eq=False)
class MetricFrame:
    """A similarity from the frame of OUT/sparse into that of all exported files, y up in both."""

    from_model: Similarity = IDENTITY
    deviation: float | None = None
    """Relative standard deviation of the unit, which is the meter; None where the unit is arbitrary."""
    source: str = ""
    """What tells the size, for people; empty where nothing does."""
    evidence: tuple[ScaleEvidence, ...] = ()
    contradictions: tuple[str, ...] = ()
    """What was left out because it contradicts the rest."""
    crs: str = ""
    """Coordinate system of ground control points; empty without any."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """East, north and up of the frame's origin in that system: x is east, y up and z south of it."""

    @property
    def is_metric(self) -> bool:
        """Whether the unit is the meter."""
        return self.deviation is not None

    @property
    def changes(self) -> bool:
        """Whether anything has another place than in OUT/sparse."""
        return self.from_model is not IDENTITY

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        similarity = self.from_model
        return {
            "scale": similarity.scale,
            "R": similarity.R.tolist(),
            "t": similarity.t.tolist(),
            "unit": "meter" if self.is_metric else "arbitrary",
            "deviation": self.deviation,
            "source": self.source,
            "evidence": [
                {"name": one.name, "scale": one.scale, "deviation": one.deviation, "photos": one.photos}
                for one in self.evidence
            ],
            "contradictions": list(self.contradictions),
            "crs": self.crs,
            "offset": list(self.offset),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "MetricFrame":
        """Read what `to_dict` gives."""
        R, t = np.array(values["R"], np.float64), np.array(values["t"], np.float64)
        similarity = Similarity(float(values["scale"]), R, t)
        still = similarity.scale == 1.0 and (np.eye(3) == R).all() and not t.any()
        east, north, up = map(float, values["offset"])
        return cls(
            IDENTITY if still else similarity,
            values["deviation"],
            values["source"],
            tuple(ScaleEvidence(**one) for one in values["evidence"]),
            tuple(values["contradictions"]),
            values["crs"],
            (east, north, up),
        )


def move_model(model: Model, similarity: Similarity) -> Model:
    """Return a surface or points with their cameras in another frame.

    Args:
        model: not changed.
        similarity: from its frame into the new one.
    """
    surface = replace(model.surface, vertices=similarity(model.surface.vertices))
    return replace(model, surface=surface, cameras=tuple(_move_camera(one, similarity) for one in model.cameras))


def _move_camera(camera: Frustum, similarity: Similarity) -> Frustum:
    """Return a camera in another frame: lengths in its own frame grow, too, and rays stay what they are."""
    R = camera.cam_from_world[:, :3] @ similarity.R.T
    t = similarity.scale * camera.cam_from_world[:, 3] - R @ similarity.t
    return replace(camera, cam_from_world=np.column_stack([R, t]))
