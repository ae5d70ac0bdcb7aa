"""Which camera model the photos support: cameras tried as those of another family, and the ranking of all models."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from sfm_app.bundle_adjustment.camera_rules import NO_RULE
from sfm_app.bundle_adjustment.lens_evidence import LensChoice, estimate_lenses
from sfm_app.bundle_adjustment.lens_family import asks_for_other_family, convert_lens, family_evidence
from sfm_app.bundle_adjustment.normal_equations import Bundle, cost, reduce
from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.bundles.bundle_arrays import NO_RULES, Rules, read_bundle, write_camera
from sfm_app.colmap.bundles.bundle_rounds import LOSS_SCALE_PX, MIN_PHOTOS, Rounds, adjust_in_rounds, lens_priors
from sfm_app.colmap.models.model import posed_images, submodel
from sfm_app.geometry.lenses.projections import CX, CY, FISHEYE, FX, FY, PERSPECTIVE
from sfm_app.numerical import FAILURES, Json, error_reason

logger = logging.getLogger("sfm_app")

OUTERMOST = 0.999
"""Share of the observations that reach the radius up to which a lens is made like another: the rest may be wrong.
Chosen by hand; not measured on its own."""
MOST_COMPARED = 250
"""Photos of a camera on which its families are compared, at even steps among all: each of them is adjusted several
times. Chosen by hand."""
RUNNERS_UP = 3
"""Number of rivals of the same family in the manifest. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class LensRecord:
    """The model of a camera, and its rivals."""

    chosen: LensChoice
    file_model: str
    """COLMAP's name of the model that it is written as."""
    rivals: tuple[LensChoice, ...]
    """The most probable other models, best first; their evidence is that which they lose against the chosen one."""
    folding: bool
    """Whether a more probable lens was refused, because it folds inside the photo."""

    def to_dict(self) -> dict[str, Json]:
        """Return plain values for the manifest."""
        rivals: list[Json] = [
            {"model": one.model, "free": list(one.free), "log_evidence_lost": round(one.log_evidence, 2)}
            for one in self.rivals
        ]
        found: dict[str, Json] = {"model": self.chosen.model, "free": list(self.chosen.free), "file": self.file_model}
        return found | {"runners_up": rivals} | ({"refused_as_folding": True} if self.folding else {})


@dataclass(frozen=True, slots=True, eq=False)
class Families:
    """A model with cameras of the most probable families."""

    model: pycolmap.Reconstruction
    """The given one where no camera changes its family; else another, to be adjusted again."""
    rivals: Mapping[int, LensChoice] = field(default_factory=dict)
    """By camera id the model of the family that lost; its evidence is what it lost by."""


def best_families(model: pycolmap.Reconstruction, rounds: Rounds, rules: Rules = NO_RULES) -> Families:
    """Choose the better family for cameras that ask for the other one: what explains the observations better.

    Both are adjusted to the same tracks.

    Args:
        model: adjusted; not changed.
        rounds: the last rounds of its adjustment.
        rules: of some cameras, by id; those that must be of a family are not tried as another.
    """
    rivals = {}
    for row, camera_id in enumerate(rounds.ids):
        family, params = int(rounds.bundle.family[row]), rounds.found.params[row]
        reach, best = _observed_reach(rounds.bundle, row), rounds.found.ranking[row][0]
        many = np.count_nonzero(rounds.bundle.camera == row) >= MIN_PHOTOS
        is_open = many and rules.get(camera_id, NO_RULE).family is None
        asks = is_open and asks_for_other_family(params, family, reach, best, bool(rounds.found.folding[row]))
        other = convert_lens(params, family, reach) if asks else None
        if other is None:
            continue
        photos = _spread_photos(model, camera_id)
        part = model if photos is None else submodel(model, photos)
        trial, same = pycolmap.Reconstruction(part), pycolmap.Reconstruction(part)
        write_camera(trial.cameras[camera_id], other, FISHEYE if family == PERSPECTIVE else PERSPECTIVE)
        try:
            adjust_in_rounds(same, None, rules)
            adjust_in_rounds(trial, None, rules)
        except FAILURES as err:
            logger.info("camera %d is not tried as another: %s", camera_id, error_reason(err))
            continue
        (kept, choice), (gained, rival) = _compare(same, trial, camera_id, rules)
        if gained > kept:
            model = trial if part is model else _with_camera(model, trial.cameras[camera_id])
            choice, rival = rival, choice
        rivals[camera_id] = replace(rival, log_evidence=abs(gained - kept))
    return Families(model, rivals)


def _spread_photos(model: pycolmap.Reconstruction, camera_id: int) -> list[int] | None:
    """Return photos of a camera at even steps among all of them; None where all photos of the model are few."""
    if model.num_reg_images() <= MOST_COMPARED:
        return None
    own = sorted(image.image_id for image in posed_images(model) if image.camera_id == camera_id)
    return own[:: -(-len(own) // MOST_COMPARED)]


def _with_camera(model: pycolmap.Reconstruction, camera: pycolmap.Camera) -> pycolmap.Reconstruction:
    """Return a copy of a model with the lens of another model's camera."""
    copy = pycolmap.Reconstruction(model)
    own = copy.cameras[camera.camera_id]
    own.model, own.params = camera.model, camera.params.tolist()
    return copy


def _compare(
    first: pycolmap.Reconstruction, second: pycolmap.Reconstruction, camera_id: int, rules: Rules
) -> tuple[tuple[float, LensChoice], ...]:
    """Return the evidence and the best model of a camera in two models with the same tracks."""
    read = [(model, *read_bundle(model, rules)) for model in (first, second)]
    reduced = [reduce(bundle, LOSS_SCALE_PX) for _, _, bundle in read]
    noise_px = min(one.noise_px for one in reduced)
    found = []
    for (model, ids, bundle), system in zip(read, reduced, strict=True):
        priors = lens_priors(model, ids, bundle, rules)
        ranking = estimate_lenses(bundle.params, replace(system, noise_px=noise_px), priors).ranking
        best = ranking[ids.index(camera_id)][0]
        found.append((family_evidence(cost(bundle, LOSS_SCALE_PX), noise_px, best), best))
    return tuple(found)


def record_lenses(
    model: pycolmap.Reconstruction, rounds: Rounds, others: Mapping[int, LensChoice]
) -> dict[int, LensRecord]:
    """Return the chosen model of each camera and its rivals, by camera id.

    Args:
        model: adjusted.
        rounds: the last rounds of its adjustment.
        others: rivals of the other family, from `best_families`.
    """
    found = {}
    for row, camera_id in enumerate(rounds.ids):
        best, *rest = rounds.found.ranking[row]
        rivals = [replace(one, log_evidence=best.log_evidence - one.log_evidence) for one in rest]
        rivals = rivals[:RUNNERS_UP] + ([others[camera_id]] if camera_id in others else [])
        rivals.sort(key=lambda one: one.log_evidence)
        name = model.cameras[camera_id].model.name
        found[camera_id] = LensRecord(best, name, tuple(rivals), bool(rounds.found.folding[row]))
    return found


def _observed_reach(bundle: Bundle, row: int) -> float:
    """Return the radius of the outermost observations of a camera, in focal lengths."""
    params = bundle.params[row]
    x = bundle.x[bundle.camera[bundle.photo] == row]
    about = (x - params[[CX, CY]]) / params[[FX, FY]]
    return float(np.quantile(np.hypot(*about.T), OUTERMOST)) if len(x) else 0.0
