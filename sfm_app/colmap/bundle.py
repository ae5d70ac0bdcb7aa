"""The last bundle adjustment: refine cameras, poses, points and tracks until they no longer change.

COLMAP finds poses and points; the cameras, their priors and their lens models are ours (`sfm_app.bundle`).
"""

import logging
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sfm_app.bundle import lens_parts
from sfm_app.bundle.lens_evidence import (
    LensChoice,
    LensEstimate,
    convert_lens,
    divide_by_focal,
    estimate_lenses,
    family_evidence,
    suggests_other_family,
)
from sfm_app.bundle.normal_equations import Bundle, best_step, bundle_scale, cost, elimination_width, reduce
from sfm_app.camera.models import FILE_MODELS, INDEX, PARAMETERS, file_model, params_of_row, row_of_calibration
from sfm_app.camera.rows import CX, CY, FISHEYE, FX, FY, PANORAMA, PERSPECTIVE
from sfm_app.colmap.backend import (
    Camera,
    Reconstruction,
    all_cameras,
    all_points,
    pycolmap,
    run_in_daemon_thread,
    translate_errors,
)
from sfm_app.colmap.database import open_database
from sfm_app.colmap.model import RefinedCamera, camera_family, finite_mask, posed_images, read_camera, submodel
from sfm_app.errors import NumericalError
from sfm_app.numerical import FAILURES, Json, error_reason, finite_entries
from sfm_app.types import Calibration
from sfm_app.types.arrays import FloatArray, IndexArray
from sfm_app.types.camera import named_correlations

# COLMAP's models as the arrays of our bundle adjustment, and back.

Rules = Mapping[int, lens_parts.CameraRule]
"""The user's rules, by camera id; cameras without a rule are free."""
NO_RULES: Rules = MappingProxyType({})


def write_camera(camera: Camera, params: FloatArray, family: int) -> None:
    """Change a camera in place to the smallest of FILE_MODELS with these parameters (12,), unless it is a panorama."""
    if family == PANORAMA:
        return
    name = file_model(params, family)
    camera.model = pycolmap.CameraModelId.__members__[name]
    camera.params = params_of_row(params, name)


def read_bundle(model: Reconstruction, rules: Rules = NO_RULES) -> tuple[list[int], Bundle]:
    """Return the ids of the cameras in use, and the model as arrays; cameras that rules keep are fixed."""
    images = [model.images[image_id] for image_id in sorted(model.reg_image_ids())]
    ids, points = sorted(photos_per_camera(model)), sorted(model.points3D)
    cameras = [model.cameras[camera_id] for camera_id in ids]
    fixed = np.array([camera_id in rules and rules[camera_id].is_kept for camera_id in ids], np.bool_)
    poses = np.array([image.cam_from_world().matrix() for image in images])
    photo, point, x = _read_observations(images, points)
    return ids, Bundle(
        params=np.array([read_camera(camera) for camera in cameras]),
        camera=np.array([ids.index(image.camera_id) for image in images]),
        R=poses[:, :, :3],
        t=poses[:, :, 3],
        X=np.array([model.points3D[point_id].xyz for point_id in points], np.float64).reshape(-1, 3),
        photo=photo,
        point=point,
        x=x,
        family=np.array([camera_family(camera) for camera in cameras], np.int64),
        fixed=fixed if fixed.any() else None,
    )


def _read_observations(
    images: Sequence[pycolmap.Image], points: Sequence[int]
) -> tuple[IndexArray, IndexArray, FloatArray]:
    """Return rows (N,) of the photo and (N,) of the point of each observation, and its position (N, 2)."""
    rows = {point_id: row for row, point_id in enumerate(points)}
    observed = [image.get_observation_points2D() for image in images]
    keypoints = [keypoint for one in observed for keypoint in one]
    return (
        np.repeat(np.arange(len(images)), [len(one) for one in observed]),
        np.array([rows[keypoint.point3D_id] for keypoint in keypoints], np.int64),
        np.array([keypoint.xy for keypoint in keypoints], np.float64).reshape(-1, 2),
    )


def write_bundle(model: Reconstruction, ids: list[int], bundle: Bundle) -> None:
    """Write cameras, poses and points, in the order of `read_bundle`, into a model in place."""
    for camera_id, params, family in zip(ids, bundle.params, bundle.family, strict=True):
        write_camera(model.cameras[camera_id], params, int(family))
    for image_id, R, t in zip(sorted(model.reg_image_ids()), bundle.R, bundle.t, strict=True):
        image = model.images[image_id]
        model.frames[image.frame_id].set_cam_from_world(image.camera_id, pycolmap.Rigid3d(pycolmap.Rotation3d(R), t))
    for point, xyz in zip(sorted(model.points3D), bundle.X, strict=True):
        model.points3D[point].xyz = xyz


def photos_per_camera(model: Reconstruction) -> Counter[int]:
    """Return the number of posed photos of each camera, by its id."""
    return Counter(model.images[image_id].camera_id for image_id in sorted(model.reg_image_ids()))


# Rounds of the last bundle adjustment: a step of everything, then tracks are completed and filtered.

logger = logging.getLogger("sfm_app")


@dataclass(frozen=True, slots=True)
class AdjustmentOptions:
    """Limits of the last adjustment."""

    min_photos: int = 5
    """Photos of a camera below which only its focal and k1 are refined. With fewer, effects that the camera model
    leaves out change its parameters more than the noise does. Chosen by hand."""
    max_error_px: float = 4.0
    """Largest reprojection error of a point (COLMAP's)."""
    min_angle_deg: float = 1.5
    """Least angle between the rays of a point (COLMAP's)."""
    rounds: int = 6
    """Most rounds. Chosen by hand."""
    changed_share: float = 0.0005
    """Share of the observations below which a change of their number lets the rounds end. Chosen by hand."""
    settled_step: float = 0.2
    """Step of the cameras, in standard deviations, below which the rounds end. Chosen by hand."""
    min_point_share: float = 0.1
    """Smallest share of the points after an adjustment; one that drops more has diverged. Chosen by hand."""
    long_step: float = 1.0
    """Step of the cameras, in standard deviations, above which COLMAP's solver refines poses and points, as where the
    linear step would raise the cost. Chosen by hand."""
    most_tied: int = 250
    """Photos that a photo is tied to (`elimination_width`) above which COLMAP's solver takes conjugate gradients. Where
    all see the same, a factorization grows with the cube of the photos; along streets it is five times as fast.
    Measured on photos of a room and of a town."""
    outermost: float = 0.999
    """Share of the observations within the radius for the conversion of a lens. Chosen by hand."""
    most_compared: int = 250
    """Photos of a camera on which its families are compared, at even steps among all. Chosen by hand."""
    runners_up: int = 3
    """Rivals of the same family in the manifest. Chosen by hand."""


OPTIONS = AdjustmentOptions()


@dataclass(frozen=True, slots=True, eq=False)
class Rounds:
    """Result of the last round; its step is in the model."""

    ids: list[int]
    """Ids of the cameras, in the order of the arrays."""
    bundle: Bundle
    """Before the last step."""
    lenses: LensEstimate
    noise_px: float
    open_points: int
    """Points that their rays did not determine when the rounds began."""


def adjust_in_rounds(
    model: Reconstruction, graph: pycolmap.CorrespondenceGraph | None, rules: Rules = NO_RULES
) -> Rounds:
    """Refine cameras, poses, points and tracks of a model in place, until they no longer change.

    The cameras are of FILE_MODELS; without a graph of all matches, the tracks stay. NumericalError if it diverges.
    """
    points, open_points = model.num_points3D(), []
    for _ in range(OPTIONS.rounds):
        ids, bundle = read_bundle(model, rules)
        if not (np.isfinite(bundle.params).all() and (bundle.params[:, [FX, FY]] > 0).all()):
            raise NumericalError("a camera has no focal length")
        scale_px = bundle_scale(bundle)
        reduced = reduce(bundle, scale_px)
        open_points.append(reduced.open_points)
        lenses = estimate_lenses(bundle.params, reduced, lens_priors(model, ids, bundle, rules))
        moved = best_step(bundle, reduced, lenses.params, scale_px)
        write_bundle(model, ids, moved)
        is_refused = np.array_equal(moved.t, bundle.t)
        if is_refused or lenses.step > OPTIONS.long_step:
            solve(model)
        changed = improve_tracks(model, graph) if graph else 0
        if model.num_points3D() <= OPTIONS.min_point_share * points:
            raise NumericalError(f"only {model.num_points3D()} of {points} points remain")
        if not is_refused and lenses.step < OPTIONS.settled_step and changed < OPTIONS.changed_share * len(bundle.x):
            break
    return Rounds(ids, bundle, lenses, reduced.noise_px, open_points[0])


def solve(model: Reconstruction, refined: Collection[int] = ()) -> None:
    """Adjust poses, points and the focals of `refined` cameras in place, on one thread: sums over several vary."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = bundle_scale(read_bundle(model)[1])
    options.ceres.solver_options.max_num_iterations = 50
    options.ceres.solver_options.function_tolerance = 1e-5
    options.ceres.solver_options.num_threads = 1
    options.ceres.max_num_images_direct_sparse_cpu_solver = _choose_most_factored(model)
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    options.refine_principal_point = options.refine_extra_params = False
    for camera_id in sorted(photos_per_camera(model).keys() - set(refined)):
        config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    run_in_daemon_thread(pycolmap.create_default_ceres_bundle_adjuster(options, config, model).solve)


def _choose_most_factored(model: Reconstruction) -> int:
    """Return the number of photos up to which COLMAP's solver factors the normal equations: all, or `most_tied`."""
    photos = sorted(model.reg_image_ids())
    if len(photos) <= OPTIONS.most_tied:
        return OPTIONS.most_tied
    rows = {photo: row for row, photo in enumerate(photos)}
    tracked = [(rows[one.image_id], k) for k, (_, p) in enumerate(all_points(model)) for one in p.track.elements]
    photo, point = np.array(tracked, np.int64).reshape(-1, 2).T
    return len(photos) if elimination_width(photo, point) <= OPTIONS.most_tied else OPTIONS.most_tied


def improve_tracks(model: Reconstruction, graph: pycolmap.CorrespondenceGraph) -> int:
    """Continue, merge, triangulate and filter tracks in place; return by how many observations their number changed.

    Observations that are added and filtered again do not count: near the limits they come and go forever.
    """
    before = model.compute_num_observations()
    observations = pycolmap.ObservationManager(model, graph)
    triangulator = pycolmap.IncrementalTriangulator(graph, model, observations)
    options = pycolmap.IncrementalTriangulatorOptions()
    triangulator.complete_all_tracks(options)
    triangulator.merge_all_tracks(options)
    triangulator.retriangulate(options)
    observations.filter_all_points3D(OPTIONS.max_error_px, OPTIONS.min_angle_deg)
    return abs(int(model.compute_num_observations() - before))


def lens_priors(
    model: Reconstruction, ids: list[int], bundle: Bundle, rules: Rules = NO_RULES
) -> lens_parts.LensPriors:
    """Return the priors of the cameras, before any evidence from the bundle."""
    used = photos_per_camera(model)
    sizes = np.array([(model.cameras[camera_id].width, model.cameras[camera_id].height) for camera_id in ids], float)
    many = np.array([used[camera_id] >= OPTIONS.min_photos for camera_id in ids])
    always = [[part.name in ("focal", "k1") for part in lens_parts.PARTS[int(kind)]] for kind in bundle.family]
    estimated = (many[:, None] | np.array(always).reshape(-1, lens_parts.COUNT)) & (bundle.family != PANORAMA)[:, None]
    of_cameras = [rules.get(camera_id, lens_parts.NO_RULE) for camera_id in ids]
    return lens_parts.LensPriors.from_cameras(bundle.params, bundle.family, sizes, estimated, of_cameras)


# The camera model that the photos support: other families of a lens, and the ranking of all models.


@dataclass(frozen=True, slots=True)
class LensRecord:
    """The model of a camera, and its rivals."""

    chosen: LensChoice
    file_model: str
    """COLMAP's name of its model in files."""
    rivals: tuple[LensChoice, ...]
    """The most probable other models, best first; their evidence is what they lose against the chosen model."""
    folding: bool
    """Whether a more probable lens folds inside the photo, and was refused."""

    def to_dict(self) -> dict[str, Json]:
        """Return plain values for the manifest."""
        rivals: list[Json] = [
            {"model": one.model, "free": list(one.free), "log_evidence_lost": round(one.log_evidence, 2)}
            for one in self.rivals
        ]
        record: dict[str, Json] = {"model": self.chosen.model, "free": list(self.chosen.free), "file": self.file_model}
        return record | {"runners_up": rivals} | ({"refused_as_folding": True} if self.folding else {})


@dataclass(frozen=True, slots=True, eq=False)
class Families:
    """A model with cameras of the most probable families."""

    model: Reconstruction
    """The given model where no camera changes its family; else another, to be adjusted again."""
    rivals: Mapping[int, LensChoice] = field(default_factory=dict)
    """By camera id, the best model of the rejected family; its evidence is what it loses."""


def best_families(model: Reconstruction, rounds: Rounds, rules: Rules = NO_RULES) -> Families:
    """Choose the family of every camera that suggests the other one, by the evidence of its observations.

    Both families are adjusted to the same tracks; `model` stays. Rules may require a camera's family.
    """
    rivals = {}
    for row, camera_id in enumerate(rounds.ids):
        family, params = int(rounds.bundle.family[row]), rounds.lenses.params[row]
        reach, best = _observed_reach(rounds.bundle, row), rounds.lenses.ranking[row][0]
        many = np.count_nonzero(rounds.bundle.camera == row) >= OPTIONS.min_photos
        is_open = many and rules.get(camera_id, lens_parts.NO_RULE).family is None
        is_doubtful = is_open and suggests_other_family(params, family, reach, best, bool(rounds.lenses.folding[row]))
        other = convert_lens(params, family, reach) if is_doubtful else None
        if other is None:
            continue
        photos = _spread_photos(model, camera_id)
        part = model if photos is None else submodel(model, photos)
        trial, same = Reconstruction(part), Reconstruction(part)
        write_camera(trial.cameras[camera_id], other, FISHEYE if family == PERSPECTIVE else PERSPECTIVE)
        try:
            adjust_in_rounds(same, None, rules)
            adjust_in_rounds(trial, None, rules)
        except FAILURES as err:
            logger.info("the other family of camera %d could not be tried: %s", camera_id, error_reason(err))
            continue
        (evidence, choice), (other_evidence, rival) = _compare(same, trial, camera_id, rules)
        if other_evidence > evidence:
            model = trial if part is model else _with_camera(model, trial.cameras[camera_id])
            choice, rival = rival, choice
        rivals[camera_id] = replace(rival, log_evidence=abs(other_evidence - evidence))
    return Families(model, rivals)


def _spread_photos(model: Reconstruction, camera_id: int) -> list[int] | None:
    """Return photos of a camera at even steps among all of them; None if the model has few photos."""
    if model.num_reg_images() <= OPTIONS.most_compared:
        return None
    own = sorted(image.image_id for image in posed_images(model) if image.camera_id == camera_id)
    return own[:: -(-len(own) // OPTIONS.most_compared)]


def _with_camera(model: Reconstruction, camera: Camera) -> Reconstruction:
    copy = Reconstruction(model)
    own = copy.cameras[camera.camera_id]
    own.model, own.params = camera.model, camera.params.tolist()
    return copy


def _compare(
    first: Reconstruction, second: Reconstruction, camera_id: int, rules: Rules
) -> tuple[tuple[float, LensChoice], ...]:
    """Return the evidence and the best model of a camera in two models with the same tracks."""
    read = [(model, *read_bundle(model, rules)) for model in (first, second)]
    scale_px = min(bundle_scale(bundle) for _, _, bundle in read)
    reduced = [reduce(bundle, scale_px) for _, _, bundle in read]
    noise_px = min(one.noise_px for one in reduced)
    compared = []
    for (model, ids, bundle), system in zip(read, reduced, strict=True):
        priors = lens_priors(model, ids, bundle, rules)
        ranking = estimate_lenses(bundle.params, replace(system, noise_px=noise_px), priors).ranking
        best = ranking[ids.index(camera_id)][0]
        compared.append((family_evidence(cost(bundle, scale_px), noise_px, best), best))
    return tuple(compared)


def record_lenses(model: Reconstruction, rounds: Rounds, others: Mapping[int, LensChoice]) -> dict[int, LensRecord]:
    """Return the chosen model of each camera and its rivals, by camera id; `others` are rivals of the other family."""
    records = {}
    for row, camera_id in enumerate(rounds.ids):
        best, *rest = rounds.lenses.ranking[row]
        rivals = [replace(one, log_evidence=best.log_evidence - one.log_evidence) for one in rest]
        rivals = rivals[: OPTIONS.runners_up] + ([others[camera_id]] if camera_id in others else [])
        rivals.sort(key=lambda one: one.log_evidence)
        name = model.cameras[camera_id].model.name
        records[camera_id] = LensRecord(best, name, tuple(rivals), bool(rounds.lenses.folding[row]))
    return records


def _observed_reach(bundle: Bundle, row: int) -> float:
    """Return the radius of the outermost observations of a camera, in focal lengths."""
    params = bundle.params[row]
    x = bundle.x[bundle.camera[bundle.photo] == row]
    offsets = (x - params[[CX, CY]]) / params[[FX, FY]]
    return float(np.quantile(np.hypot(*offsets.T), OPTIONS.outermost)) if len(x) else 0.0


def find_cameras(model: Reconstruction) -> dict[int, int]:
    """Return a number of the camera of each photo whose camera others share, but clearly not all with one focal."""
    ids, bundle = read_bundle(model)
    try:
        numbers = divide_by_focal(bundle, lens_priors(model, ids, bundle))
    except FAILURES as err:
        logger.info("the focals of photos could not be compared", exc_info=err)
        return {}
    divided = set(bundle.camera[numbers != bundle.camera].tolist())
    photos = zip(sorted(model.reg_image_ids()), numbers.tolist(), bundle.camera.tolist(), strict=True)
    return {photo: number for photo, number, camera in photos if camera in divided}


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """The refined model, and the uncertainty of its cameras."""

    model: Reconstruction
    refined: dict[int, RefinedCamera]
    """By camera id."""
    failure: str = ""
    """Why the adjustment failed, and left the given model without deviations; empty if it succeeded."""
    held: tuple[int, ...] = ()
    """Ids of cameras whose estimate diverged; they keep their parameters."""
    open_points: int = 0
    """Points that their rays did not determine when the adjustment began."""
    lenses: dict[int, LensRecord] = field(default_factory=dict)
    """The chosen camera model and its rivals, by camera id; empty where the adjustment failed."""
    estimates: dict[int, Calibration] = field(default_factory=dict)
    """Estimates of the cameras that the user gave, by camera id; lacks cameras that the photos do not determine."""


def adjust(
    model: Reconstruction, database: Path, rules: Rules = NO_RULES, *, families_known: bool = False
) -> Adjustment:
    """Refine cameras, poses, points and tracks in turn; only camera parameters that the photos determine are freed.

    In each round, poses and points are eliminated, and the likelihood of the cameras is weighed against their priors.
    The cameras make the resulting step. Poses and points follow linearly; after a long step COLMAP's solver refines
    them. Then tracks are completed and filtered. The given model is not changed; with `families_known`, an earlier
    adjustment has chosen between fisheye and perspective lenses. NumericalError if it diverges.
    """
    model = Reconstruction(model)
    for camera in all_cameras(model):
        write_camera(camera, read_camera(camera), camera_family(camera))
    if rules:
        apply_rules(model, rules)
    drop_infinite_points(model)
    graph = find_correspondences(model, database)
    rounds = adjust_in_rounds(model, graph, rules)
    open_points = rounds.open_points
    families = Families(model) if families_known else best_families(model, rounds, rules)
    if families.model is not model:
        model = families.model
        rounds = adjust_in_rounds(model, graph, rules)
    model.update_point_3d_errors()
    held = tuple(camera_id for camera_id, diverged in zip(rounds.ids, rounds.lenses.held, strict=True) if diverged)
    lenses = record_lenses(model, rounds, families.rivals)
    estimates = given_estimates(model, rounds, rules)
    return Adjustment(
        model, refined_cameras(rounds), held=held, open_points=open_points, lenses=lenses, estimates=estimates
    )


def adjust_or_keep(
    model: Reconstruction, database: Path, rules: Rules = NO_RULES, *, families_known: bool = False
) -> Adjustment:
    """Adjust a model; where that fails numerically, return the given model with the reason."""
    try:
        with translate_errors("adjusting the bundle"):
            return adjust(model, database, rules, families_known=families_known)
    except FAILURES as err:
        logger.info("the last adjustment failed", exc_info=err)
        unknown = RefinedCamera(deviations={}, determined=(), correlations={})
        return Adjustment(model, dict.fromkeys(photos_per_camera(model), unknown), failure=error_reason(err))


def drop_infinite_points(model: Reconstruction) -> None:
    """Remove points at infinity, in place."""
    for point_id in [key for key, point in all_points(model) if not finite_mask(point.xyz)]:
        model.delete_point3D(point_id)


def find_correspondences(model: Reconstruction, database: Path) -> pycolmap.CorrespondenceGraph:
    """Return the graph of all matches between the photos of a model."""
    options = pycolmap.DatabaseCacheOptions()
    options.load_all_images = True  # else photos that no pair in the database connects would be missing
    options.image_names = {model.images[image_id].name for image_id in model.reg_image_ids()}
    with open_database(database) as db:
        return pycolmap.DatabaseCache.create(db, options).correspondence_graph


def refined_cameras(rounds: Rounds) -> dict[int, RefinedCamera]:
    """Return the uncertainty of all cameras, by id."""
    lenses, refined = rounds.lenses, {}
    for row, camera_id in enumerate(rounds.ids):
        names = _adjusted_names(rounds, row)
        places = [INDEX[name] for name in names]
        entries = {name: float(lenses.deviations[row][place]) for name, place in zip(names, places, strict=True)}
        refined[camera_id] = RefinedCamera(
            deviations=finite_entries(entries),
            determined=lens_parts.determined_names(int(rounds.bundle.family[row]), lenses.determined[row]),
            correlations=named_correlations(names, lenses.mean_squares[row][np.ix_(places, places)]),
        )
    return refined


def _adjusted_names(rounds: Rounds, row: int) -> tuple[str, ...]:
    """Return COLMAP's names of the adjusted parameters of a camera; none of a panorama or a fixed camera."""
    family = int(rounds.bundle.family[row])
    is_fixed = rounds.bundle.fixed is not None and bool(rounds.bundle.fixed[row])
    if family not in FILE_MODELS or is_fixed:
        return ()
    return PARAMETERS[file_model(rounds.lenses.params[row], family)]


def apply_rules(model: Reconstruction, rules: Rules) -> None:
    """Give cameras the user's values or model, in place, and adjust poses and points to them."""
    changed = False
    for camera_id, rule in rules.items():
        camera = model.cameras[camera_id]
        family, before = camera_family(camera), read_camera(camera)
        params, new_family = before, family if rule.family is None else rule.family
        if PANORAMA in (family, new_family):
            continue
        if rule.given is not None and rule.is_kept:
            params = row_of_calibration(rule.given)
        elif new_family != family:
            reach = np.hypot(camera.width, camera.height) / (2.0 * np.sqrt(before[FX] * before[FY]))
            other = convert_lens(before, family, float(reach))
            params, new_family = (before, family) if other is None else (other, new_family)
        parts = None if rule.is_kept else rule.parts(new_family)
        if parts is not None:
            params = lens_parts.fit_to_model(params, parts, new_family)
        changed = changed or new_family != family or not np.array_equal(params, before)
        write_camera(camera, params, new_family)
    if changed:
        solve(model)


def given_estimates(model: Reconstruction, rounds: Rounds, rules: Rules) -> dict[int, Calibration]:
    """Return estimates of the user's cameras by id, if the photos determine them; kept ones are adjusted again."""
    if all(rule.given is None for rule in rules.values()):
        return {}
    if any(rule.is_kept for rule in rules.values()):
        try:
            rounds = adjust_in_rounds(Reconstruction(model), None)
        except FAILURES as err:
            logger.info("the user's cameras could not be checked", exc_info=err)
            return {}
    estimates, lenses = {}, rounds.lenses
    for row, camera_id in enumerate(rounds.ids):
        family = int(rounds.bundle.family[row])
        if camera_id not in rules or rules[camera_id].given is None or lenses.held[row] or family == PANORAMA:
            continue
        camera = model.cameras[camera_id]
        determined = lens_parts.determined_names(family, lenses.determined[row])
        estimates[camera_id] = lens_parts.calibration_from_params(
            lenses.params[row], family, (camera.width, camera.height), lenses.deviations[row], determined
        )
    return estimates
