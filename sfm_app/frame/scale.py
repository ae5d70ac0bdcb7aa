"""The size of a model: known lengths as evidence, and the frame of exported files."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from sfm_app.frame.coordinates import MapFrame
from sfm_app.geometry.poses import Similarity, normalize
from sfm_app.types import MapPlace, Model, PosedPhoto
from sfm_app.wording import parse_point

GPS = "GPS of the photos"
CONTRADICTION = 4.0
"""Largest difference of two agreeing scales, in standard deviations. Chosen by hand: one pair of 16 000 has more."""
IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))


@dataclass(frozen=True, slots=True)
class ScaleEvidence:
    """The scale by one object of known size."""

    name: str
    """Name of the object for people, such as "marker aruco-4x4 3"."""
    scale: float
    """Meters per unit of the model, > 0."""
    deviation: float
    """Relative standard deviation, > 0."""
    photos: int = 0


USED, LEFT_OUT, CHECK = "used", "left out", "check"
INSIDE = 3.0
"""Standard deviations within which a check point agrees. By definition: the usual bound."""


@dataclass(frozen=True, slots=True)
class SurveyedPoint:
    """A ground control point, and how far its place in the model is off."""

    name: str
    role: str
    """USED or LEFT_OUT in the fit of the frame, or CHECK."""
    photos: int
    """How many photos determine the place."""
    plan_m: float
    """Horizontal distance from the surveyed position to the place in the model."""
    height_m: float
    """Height of the place above the surveyed position."""
    plan_deviation_m: float | None = None
    """Standard deviation of both horizontal coordinates together, None unless the point checks."""
    height_deviation_m: float | None = None

    @property
    def is_inside(self) -> bool | None:
        """Whether both residuals lie inside three deviations; None unless the point checks."""
        if self.plan_deviation_m is None or self.height_deviation_m is None:
            return None
        return self.plan_m <= INSIDE * self.plan_deviation_m and abs(self.height_m) <= INSIDE * self.height_deviation_m


@dataclass(frozen=True, slots=True, eq=False)
class MetricFrame:
    """A similarity from the frame of OUT/sparse into that of all exported files, y up in both."""

    from_model: Similarity = IDENTITY
    deviation: float | None = None
    """Relative standard deviation of the unit, the meter; None if it is arbitrary."""
    source: str = ""
    """Names of the evidence in use, for people; empty without any."""
    evidence: tuple[ScaleEvidence, ...] = ()
    contradictions: tuple[str, ...] = ()
    """Evidence that contradicts the rest, one sentence each."""
    place: MapPlace | None = None
    """Place of the frame, by ground control points or else GPS."""
    surveyed: tuple[SurveyedPoint, ...] = ()
    """Ground control points and check points, in the order of their file."""

    @property
    def is_metric(self) -> bool:
        """Whether the unit is the meter."""
        return self.deviation is not None

    @property
    def changes(self) -> bool:
        """Whether exported files differ in frame from OUT/sparse."""
        return self.from_model is not IDENTITY

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON, with the transformation to the map for readers."""
        values, similarity = asdict(self), self.from_model
        del values["from_model"]
        frame = {"scale": similarity.scale, "R": similarity.R.tolist(), "t": similarity.t.tolist()}
        return frame | {"unit": "meter" if self.is_metric else "arbitrary"} | values | map_entry(self.place)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "MetricFrame":
        """Read the values of `to_dict`."""
        R, t = np.array(values["R"], np.float64), np.array(values["t"], np.float64)
        similarity = Similarity(float(values["scale"]), R, t)
        unchanged = similarity.scale == 1.0 and (np.eye(3) == R).all() and not t.any()
        return cls(
            IDENTITY if unchanged else similarity,
            values["deviation"],
            values["source"],
            tuple(ScaleEvidence(**one) for one in values["evidence"]),
            tuple(values["contradictions"]),
            read_place(values["place"]),
            tuple(SurveyedPoint(**one) for one in values.get("surveyed", ())),
        )


def map_entry(place: MapPlace | None) -> dict[str, Any]:
    """Return the transformation from a frame to the map for records of files; empty where its place is unknown."""
    return {"map": MapFrame(place).to_dict()} if place else {}


def read_place(values: Mapping[str, Any] | None) -> MapPlace | None:
    """Return the place of `asdict`, also by way of JSON."""
    return MapPlace(**{**values, "origin": tuple(values["origin"])}) if values else None


def agree(evidence: Sequence[ScaleEvidence], shape: float = 0.0) -> MetricFrame:
    """Return the frame by the weighted mean of the scales, without those that contradict the others.

    Without evidence, the unit is arbitrary. The scale farthest from the mean of the others is dropped while it differs
    by more than `CONTRADICTION` and two others remain. Of two contradicting scales, the more exact one counts, and the
    deviation covers half of the difference. `shape` is the relative deviation of the model's proportions, which more
    evidence does not reduce.
    """
    if not evidence:
        return MetricFrame()
    used, contradictions = list(evidence), []
    while len(used) > 2:
        differences = [_difference(one, _mean([other for other in used if other is not one]), shape) for one in used]
        worst = int(np.argmax(differences))
        if differences[worst] <= CONTRADICTION:
            break
        outlier = used.pop(worst)
        contradictions.append(_contradiction(outlier, _mean(used), f"the {len(used)} others"))
    mean = _mean(used)
    if len(used) == 2 and _difference(used[0], used[1], shape) > CONTRADICTION:
        best, other = sorted(used, key=lambda one: one.deviation)
        contradictions.append(_contradiction(other, best, best.name))
        half = abs(np.log(other.scale / best.scale)) / 2
        mean, used = replace(best, deviation=max(best.deviation, float(half))), [best]
    similarity = IDENTITY if mean.scale == 1.0 else Similarity(mean.scale, np.eye(3), np.zeros(3))
    source = ", ".join(one.name for one in used)
    deviation = float(np.hypot(mean.deviation, shape))
    return MetricFrame(similarity, deviation, source, tuple(evidence), tuple(contradictions))


def stand_upright(frame: MetricFrame, level: Sequence[tuple[str, str, str]]) -> MetricFrame:
    """Return the frame with the normal of level surfaces up, on average, after the smallest turn.

    Three places in the frame of OUT/sparse give a surface, counter-clockwise seen from above, as in the settings.
    """
    from scipy.spatial.transform import Rotation  # slow to import

    corners = np.array([[parse_point(place) for place in places] for places in level])
    normals = normalize(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    turn = Rotation.align_vectors([[0.0, 1.0, 0.0]], [normals.sum(axis=0)])[0].as_matrix()
    return replace(frame, from_model=Similarity(frame.from_model.scale, turn, np.zeros(3)))


def _mean(evidence: Sequence[ScaleEvidence]) -> ScaleEvidence:
    """Return the weighted mean of logarithms, with a deviation that covers the scatter."""
    logs = np.log([one.scale for one in evidence])
    weights = 1.0 / np.square([one.deviation for one in evidence])
    mean = float(weights @ logs / weights.sum())
    freedom = max(len(logs) - 1, 1)
    inflation = max(1.0, float(np.sqrt(weights @ (logs - mean) ** 2 / freedom)))
    return ScaleEvidence("", float(np.exp(mean)), inflation / float(np.sqrt(weights.sum())))


def _difference(one: ScaleEvidence, other: ScaleEvidence, shape: float) -> float:
    """Return the difference of two scales in standard deviations."""
    expected = np.linalg.norm([one.deviation, other.deviation, shape])
    return abs(float(np.log(one.scale / other.scale))) / float(expected)


def _contradiction(one: ScaleEvidence, against: ScaleEvidence, name: str) -> str:
    share = 100.0 * (one.scale / against.scale - 1.0)
    return (
        f"{one.name} contradicts {name}: by it, the model is {abs(share):.2g} % {'larger' if share > 0 else 'smaller'}"
    )


def move_model(model: Model, similarity: Similarity) -> Model:
    """Return a surface or points with their cameras in the similarity's target frame."""
    surface = replace(model.surface, vertices=similarity(model.surface.vertices))
    return replace(model, surface=surface, cameras=tuple(_move_camera(one, similarity) for one in model.cameras))


def _move_camera(camera: PosedPhoto, similarity: Similarity) -> PosedPhoto:
    """Return a camera in the target frame: lengths in the camera's frame scale, too, and rays stay."""
    R = camera.R @ similarity.R.T
    t = similarity.scale * camera.t - R @ similarity.t
    return replace(camera, cam_from_world=np.column_stack([R, t]))
