"""Plug-ins: typed hooks, and one registry for built-in and installed methods.

A plug-in is an installed package with an entry point in the group ``sfm_app``; its module holds functions marked with
`hookimpl` and named as in `Hooks`.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import MappingProxyType, ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import pluggy
from numpy.typing import NDArray

from sfm_app.errors import ConfigError, PluginError
from sfm_app.formats.exporters import INSTALL_HINT, Exporter, SceneExporter
from sfm_app.settings import CalibrationSettings, EpipolarSettings, MatchSettings
from sfm_app.types import Calibration, CameraPairs, CameraPrior, EpipolarFit, Features, Rejected
from sfm_app.types.arrays import FloatArray

if TYPE_CHECKING:  # OpenCV, which stereo needs, takes longer to load than an estimator to run
    from sfm_app.stereo.view import DepthTask

GROUP, BUILT_IN = "sfm_app", "sfm_app.built_in"
"""Entry points of plug-ins, and the module of the built-in methods."""
AUTO, CPU, NONE = "auto", "cpu", "none"
SIFT, SIFT_AFFINE = "sift", "sift-affine"
hookspec = pluggy.HookspecMarker(GROUP)
hookimpl = pluggy.HookimplMarker(GROUP)


FitFundamental = Callable[[FloatArray, FloatArray, EpipolarSettings, int], EpipolarFit | Rejected]
"""Estimates one fundamental matrix; x1, x2 are finite (N, 2) pixels; the same seed, the last, gives the same result."""
Calibrate = Callable[[CameraPairs, CalibrationSettings, int], Calibration]
"""Estimates one camera matrix from the fundamental matrices of pairs that share it; same seed, same result.

Never raises on data: an undetermined camera has ``identifiable=False`` and a reason. ValueError on malformed arrays;
`sfm_app.selfcal.pairs.prepare` checks them."""
FindFeatures = Callable[[NDArray[np.uint8], MatchSettings], Features]
"""Finds the features of one picture, the best first; the same picture gives the same bytes, in any thread.

The picture is (H, W, 3) RGB of 8 bits, at most `max_image_size_px` long. The caller downscales the photo, scales the
keypoints back to its pixels, and drops masked ones and those beyond `max_features`."""
MatchFeatures = Callable[[Features, Features, MatchSettings], NDArray[np.integer[Any]]]
"""Matches the features of two pictures: returns (M, 2) rows, each at most once; same features, same result."""
FindCamera = Callable[[NDArray[np.uint8]], CameraPrior | None]
"""Estimates the camera of one upright photo, (H, W, 3) RGB of 8 bits; None for no idea. Pixels are those of the photo.

Deviations must cover the errors. The source is what users read as the author of the claim."""
MakeDepthMaps = Callable[["DepthTask"], list[Rejected | None]]
"""Writes geometric depth and normal maps to the workspace; returns None per view, or why it has no map."""


@dataclass(frozen=True, slots=True)
class Estimator:
    """A named estimator of fundamental matrices."""

    name: str
    fit: FitFundamental
    summary: str = ""

    def __reduce__(self) -> tuple[Callable[[str, str], "Estimator"], tuple[str, str]]:
        return _part_here, ("estimators", self.name)


@dataclass(frozen=True, slots=True)
class Calibrator:
    """A named method from fundamental matrices to the camera matrix."""

    name: str
    calibrate: Calibrate
    summary: str = ""
    together: bool = False
    """Whether the program's own method then splits groups that disagree, and uses pairs between cameras."""


@dataclass(frozen=True, slots=True)
class DepthMethod:
    """A named method for depth maps."""

    name: str
    make: MakeDepthMaps
    summary: str = ""
    unavailable: Callable[[], str] = str
    """Reason why it cannot run on this machine; empty if it can."""


@dataclass(frozen=True, slots=True)
class FeatureMethod:
    """A named method for features and matches: two functions, or COLMAP's SIFT with other options."""

    name: str
    find: FindFeatures | None = None
    match: MatchFeatures | None = None
    summary: str = ""
    unavailable: Callable[[], str] = str
    sift: Mapping[str, bool | int | float] | None = None
    """In place of functions: options of COLMAP's SIFT extraction that differ from its defaults."""

    def __post_init__(self) -> None:
        functions = [self.find, self.match].count(None)
        if functions != (0 if self.sift is None else 2):
            raise PluginError(
                f"the feature method '{self.name}' needs `find` and `match`, or only options of SIFT",
                hint="docs/plugins.md shows how",
            )

    def __reduce__(self) -> tuple[Callable[[str, str], "FeatureMethod"], tuple[str, str]]:
        return _part_here, ("features", self.name)


@dataclass(frozen=True, slots=True)
class CameraPriorMethod:
    """A named method that estimates the camera of a photo from its content, such as a neural network."""

    name: str
    find: FindCamera
    summary: str = ""
    unavailable: Callable[[], str] = str


class Hooks:
    """The hooks of a plug-in, all optional."""

    @hookspec
    def sfm_estimators(self) -> Iterable[Estimator]:  # type: ignore[empty-body]
        """Return estimators of fundamental matrices."""

    @hookspec
    def sfm_calibrators(self) -> Iterable[Calibrator]:  # type: ignore[empty-body]
        """Return calibrators."""

    @hookspec
    def sfm_features(self) -> Iterable[FeatureMethod]:  # type: ignore[empty-body]
        """Return methods for features and matches."""

    @hookspec
    def sfm_camera_priors(self) -> Iterable[CameraPriorMethod]:  # type: ignore[empty-body]
        """Return methods for priors on cameras."""

    @hookspec
    def sfm_exporters(self) -> Iterable[Exporter]:  # type: ignore[empty-body]
        """Return file formats for models."""

    @hookspec
    def sfm_scene_exporters(self) -> Iterable[SceneExporter]:  # type: ignore[empty-body]
        """Return formats for cameras, poses, points and photos."""

    @hookspec
    def sfm_depth_methods(self) -> Iterable[DepthMethod]:  # type: ignore[empty-body]
        """Return methods for depth maps."""


@dataclass(frozen=True, slots=True)
class Plugins:
    """All methods and formats by name."""

    estimators: Mapping[str, Estimator]
    calibrators: Mapping[str, Calibrator]
    exporters: Mapping[str, Exporter]
    scene_exporters: Mapping[str, SceneExporter]
    depth_methods: Mapping[str, DepthMethod]
    features: Mapping[str, FeatureMethod]
    camera_priors: Mapping[str, CameraPriorMethod]

    def estimator(self, name: str) -> Estimator:
        """Return an estimator; ConfigError names the known ones."""
        return _look_up(self.estimators, name, "estimator")

    def calibrator(self, name: str) -> Calibrator:
        """Return a calibrator; ConfigError names the known ones."""
        return _look_up(self.calibrators, name, "calibrator")

    def exporter(self, name: str) -> Exporter:
        """Return a file format for models; ConfigError where it is unknown or cannot be used here."""
        return _look_up_available(self.exporters, name, "file format", INSTALL_HINT)

    def scene_exporter(self, name: str) -> SceneExporter:
        """Return a format for scenes; ConfigError as in `exporter`."""
        return _look_up_available(self.scene_exporters, name, "format for scenes", INSTALL_HINT)

    def feature_method(self, name: str) -> FeatureMethod:
        """Return a feature method; ConfigError as in `exporter`."""
        return _look_up_available(self.features, name, "feature method", f"'{SIFT}' runs everywhere")

    def camera_prior_method(self, name: str) -> CameraPriorMethod | None:
        """Return a method for camera priors, or with "auto" the first that runs here; None without one.

        ConfigError as in `exporter`.
        """
        if name == AUTO:
            return next((one for one in self.camera_priors.values() if not one.unavailable()), None)
        hint = f"'{AUTO}' takes an installed one, '{NONE}' takes none"
        return None if name == NONE else _look_up_available(self.camera_priors, name, "method for camera priors", hint)

    def depth_method(self, name: str) -> tuple[DepthMethod, str]:
        """Return a depth method, or with "auto" the best that runs here, and why; ConfigError as in `exporter`."""
        if name != AUTO:
            hint = f"'{AUTO}' chooses the best method of this machine, '{CPU}' runs everywhere"
            return _look_up_available(self.depth_methods, name, "depth method", hint), "chosen in the settings"
        # an installed method has preference
        others = [method for method in self.depth_methods.values() if method.name != CPU]
        reasons = {method.name: method.unavailable() for method in others}
        for method in others:
            if not reasons[method.name]:
                return method, "installed and able to run here"
        missing = "; ".join(f"{other} cannot run here: {reason}" for other, reason in reasons.items())
        return self.depth_methods[CPU], missing or "no other method is installed"


def load_plugins(modules: Sequence[ModuleType | object] = (), *, installed: bool = True) -> Plugins:
    """Register the built-ins, the given modules and, if `installed`, every installed plug-in.

    Without arguments the result is cached for the process: the search through all packages takes longer than an easy
    pair. `installed_plugins.cache_clear()` resets it. Raise a PluginError if a hook is misspelt, a plug-in does not
    import, or two methods share a name.
    """
    return installed_plugins() if installed and not modules else _load(modules, installed)


@cache
def installed_plugins() -> Plugins:
    """Return the built-ins and every plug-in installed at the first call; errors as in `load_plugins`."""
    return _load((), installed=True)


def _load(modules: Sequence[ModuleType | object], installed: bool) -> Plugins:
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(Hooks)
    try:
        for module in (import_module(BUILT_IN), *modules):
            manager.register(module)
        if installed:
            manager.load_setuptools_entrypoints(GROUP)
        manager.check_pending()
    except Exception as err:  # a plug-in may raise anything on import
        raise PluginError(f"a plug-in does not load: {err}", hint="update or uninstall it") from err
    exporters = _index_by_name(manager.hook.sfm_exporters())
    return Plugins(
        estimators=_index_by_name(manager.hook.sfm_estimators()),
        calibrators=_index_by_name(manager.hook.sfm_calibrators()),
        exporters=exporters,
        scene_exporters=_index_by_name(manager.hook.sfm_scene_exporters(), exporters),
        depth_methods=_index_by_name(manager.hook.sfm_depth_methods()),
        features=_index_by_name(manager.hook.sfm_features()),
        camera_priors=_index_by_name(manager.hook.sfm_camera_priors()),
    )


@cache
def _part_here(kind: str, name: str) -> Any:
    """Return a method by name in another process; built-in ones load no plug-in."""
    built_in = getattr(_load((), installed=False), kind)
    return built_in[name] if name in built_in else _look_up(getattr(installed_plugins(), kind), name, kind)


Part = TypeVar("Part", Estimator, Calibrator, Exporter, SceneExporter, DepthMethod, FeatureMethod, CameraPriorMethod)


def _index_by_name(results: Iterable[Iterable[Part]], others: Iterable[str] = ()) -> Mapping[str, Part]:
    # pluggy calls the last registered first; reversed, the built-ins lead every listing
    by_name: dict[str, Part] = {}
    for part in (part for parts in reversed(list(results)) for part in parts):
        if part.name in by_name or part.name in others:
            raise PluginError(f"two plug-ins offer '{part.name}'", hint="uninstall one of them")
        by_name[part.name] = part
    return MappingProxyType(by_name)


Available = TypeVar("Available", Exporter, SceneExporter, DepthMethod, FeatureMethod, CameraPriorMethod)


def _look_up_available(parts: Mapping[str, Available], name: str, kind: str, hint: str) -> Available:
    part = _look_up(parts, name, kind)
    if reason := part.unavailable():
        raise ConfigError(f"the {kind} '{name}' cannot be used here: {reason}", hint=hint)
    return part


def _look_up(parts: Mapping[str, Part], name: str, kind: str) -> Part:
    if name not in parts:
        raise ConfigError(f"no {kind} is named '{name}'", hint=f"known: {', '.join(parts)}")
    return parts[name]
