"""Plug-ins: typed hooks, and one registry in which the built-ins are registered like any other plug-in.

A plug-in is an installed package with an entry point in the group ``sfm_app``; its module holds functions marked with
`hookimpl` that are named as in `Hooks`.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import MappingProxyType, ModuleType
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np
import pluggy
from numpy.typing import NDArray

from sfm_app.errors import ConfigError, PluginError
from sfm_app.formats.exporters import INSTALL_HINT, Exporter, SceneExporter
from sfm_app.settings import CalibrationSettings, EpipolarSettings, MatchSettings
from sfm_app.types import Calibration, CameraPairs, EpipolarFit, Features, Rejected
from sfm_app.types.arrays import FloatArray

if TYPE_CHECKING:  # OpenCV, which stereo needs, takes longer to load than an estimator to run
    from sfm_app.stereo import DepthTask

GROUP, BUILT_IN = "sfm_app", "sfm_app.built_in"
"""Entry points of plug-ins, and the module with our own methods, which comes through the same door."""
AUTO, CPU = "auto", "cpu"
SIFT, SIFT_DSP = "sift", "sift-dsp"
hookspec = pluggy.HookspecMarker(GROUP)
hookimpl = pluggy.HookimplMarker(GROUP)


class FitFundamental(Protocol):
    """Estimates one fundamental matrix; x1, x2 are finite (N, 2) pixels; the same seed gives the same result."""

    def __call__(
        self, x1: FloatArray, x2: FloatArray, options: EpipolarSettings, seed: int, /
    ) -> EpipolarFit | Rejected: ...


class Calibrate(Protocol):
    """Estimates one camera matrix from the fundamental matrices of pairs that share it; same seed, same result.

    Never raises on data: what is not determined comes back with ``identifiable=False`` and a reason. ValueError on
    malformed arrays; `sfm_app.selfcal.pairs.prepare` checks them.
    """

    def __call__(self, pairs: CameraPairs, options: CalibrationSettings, seed: int, /) -> Calibration: ...


class FindFeatures(Protocol):
    """Finds the features of one picture, the best first; the same picture gives the same bytes, in any thread.

    The picture is (H, W, 3) RGB of 8 bits, at most `max_image_size_px` long. The caller downscales the photo, scales
    the keypoints back to its pixels, and drops masked ones and those beyond `max_features`.
    """

    def __call__(self, picture: NDArray[np.uint8], options: MatchSettings, /) -> Features: ...


class MatchFeatures(Protocol):
    """Matches the features of two pictures: returns (M, 2) rows, each at most once; same features, same result."""

    def __call__(self, first: Features, second: Features, options: MatchSettings, /) -> NDArray[np.integer[Any]]: ...


@dataclass(frozen=True, slots=True)
class Estimator:
    """A named way to estimate fundamental matrices."""

    name: str
    fit: FitFundamental
    summary: str = ""

    def __reduce__(self) -> tuple[Callable[[str, str], "Estimator"], tuple[str, str]]:
        return _part_here, ("estimators", self.name)


@dataclass(frozen=True, slots=True)
class Calibrator:
    """A named way to get from fundamental matrices to the camera matrix."""

    name: str
    calibrate: Calibrate
    summary: str = ""
    together: bool = False
    """Whether the program's own method then splits groups that disagree, and uses pairs between cameras."""


class MakeDepthMaps(Protocol):
    """Writes geometric depth and normal maps to the workspace; returns for every view why it has none, or None."""

    def __call__(self, task: "DepthTask", /) -> list[Rejected | None]: ...


def _no_reason() -> str:
    return ""


@dataclass(frozen=True, slots=True)
class DepthMethod:
    """A named way to make depth maps."""

    name: str
    make: MakeDepthMaps
    summary: str = ""
    unavailable: Callable[[], str] = _no_reason
    """Why it cannot run on this machine; empty where it can."""


@dataclass(frozen=True, slots=True)
class FeatureMethod:
    """A named way to find features and to match them: two functions, or COLMAP's SIFT with other options."""

    name: str
    find: FindFeatures | None = None
    match: MatchFeatures | None = None
    summary: str = ""
    unavailable: Callable[[], str] = _no_reason
    """Why it cannot run on this machine; empty where it can."""
    sift: Mapping[str, bool | int | float] | None = None
    """In place of functions: options of COLMAP's SIFT extraction that differ from its defaults."""

    def __post_init__(self) -> None:
        functions = [self.find, self.match].count(None)
        if functions != (0 if self.sift is None else 2):
            raise PluginError(
                f"the features '{self.name}' have to come with `find` and `match`, or with options of SIFT alone",
                hint="docs/plugins.md shows how",
            )

    def __reduce__(self) -> tuple[Callable[[str, str], "FeatureMethod"], tuple[str, str]]:
        return _part_here, ("features", self.name)


class Hooks:
    """What a plug-in may define, all optional."""

    @hookspec
    def sfm_estimators(self) -> Iterable[Estimator]:  # type: ignore[empty-body]
        """Return estimators of fundamental matrices."""

    @hookspec
    def sfm_calibrators(self) -> Iterable[Calibrator]:  # type: ignore[empty-body]
        """Return calibrators."""

    @hookspec
    def sfm_features(self) -> Iterable[FeatureMethod]:  # type: ignore[empty-body]
        """Return ways to find features and to match them."""

    @hookspec
    def sfm_exporters(self) -> Iterable[Exporter]:  # type: ignore[empty-body]
        """Return file formats for models."""

    @hookspec
    def sfm_scene_exporters(self) -> Iterable[SceneExporter]:  # type: ignore[empty-body]
        """Return formats for cameras, poses, points and photos."""

    @hookspec
    def sfm_depth_methods(self) -> Iterable[DepthMethod]:  # type: ignore[empty-body]
        """Return ways to make depth maps."""


@dataclass(frozen=True, slots=True)
class Plugins:
    """Everything that can be chosen by name."""

    estimators: Mapping[str, Estimator]
    calibrators: Mapping[str, Calibrator]
    exporters: Mapping[str, Exporter]
    scene_exporters: Mapping[str, SceneExporter]
    depth_methods: Mapping[str, DepthMethod]
    features: Mapping[str, FeatureMethod]

    def estimator(self, name: str) -> Estimator:
        """Return the estimator of that name; ConfigError names the known ones."""
        return _look_up(self.estimators, name, "estimator")

    def calibrator(self, name: str) -> Calibrator:
        """Return the calibrator of that name; ConfigError names the known ones."""
        return _look_up(self.calibrators, name, "calibrator")

    def exporter(self, name: str) -> Exporter:
        """Return the file format for models of that name; ConfigError where there is none, or it cannot run here."""
        return _check_available(_look_up(self.exporters, name, "file format"))

    def scene_exporter(self, name: str) -> SceneExporter:
        """Return the format for scenes of that name; ConfigError as in `exporter`."""
        return _check_available(_look_up(self.scene_exporters, name, "format for scenes"))

    def feature_method(self, name: str) -> FeatureMethod:
        """Return the way to find features of that name; ConfigError where there is none, or it cannot run here."""
        method = _look_up(self.features, name, "way to find features")
        if reason := method.unavailable():
            hint = f"'{SIFT}' runs everywhere"
            raise ConfigError(f"the features '{name}' cannot be used here: {reason}", hint=hint)
        return method

    def depth_method(self, name: str) -> tuple[DepthMethod, str]:
        """Return the way to make depth maps of that name, or with "auto" the best that runs here, and why this one.

        Raises:
            ConfigError: no method has that name, or it cannot run on this machine.
        """
        if name != AUTO:
            method = _look_up(self.depth_methods, name, "depth method")
            if reason := method.unavailable():
                raise ConfigError(
                    f"the depth method '{name}' cannot run here: {reason}",
                    hint=f"'{AUTO}' takes what this machine can do, '{CPU}' runs everywhere",
                )
            return method, "asked for"
        # an installed method is meant to be used
        others = [method for method in self.depth_methods.values() if method.name != CPU]
        reasons = {method.name: method.unavailable() for method in others}
        for method in others:
            if not reasons[method.name]:
                return method, "installed and able to run here"
        missing = "; ".join(f"{other} cannot run here: {reason}" for other, reason in reasons.items())
        return self.depth_methods[CPU], missing or "no other method is installed"


def load_plugins(modules: Sequence[ModuleType | object] = (), *, installed: bool = True) -> Plugins:
    """Register the built-ins, the given modules and, if wanted, every installed plug-in.

    Without arguments the result is cached for the process: the search through all installed packages takes
    milliseconds, longer than an estimator needs for an easy pair. `installed_plugins.cache_clear()` resets it.

    Raises:
        PluginError: a hook is misspelt, a plug-in does not import, or two things share a name.
    """
    return installed_plugins() if installed and not modules else _load(modules, installed)


@cache
def installed_plugins() -> Plugins:
    """Return the built-ins and every installed plug-in, as they were at the first call; errors as in `load_plugins`."""
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
        raise PluginError(
            f"a plug-in does not load: {err}", hint="update or uninstall it; hooks: sfm_app.plugins.Hooks"
        ) from err
    exporters = _index_by_name(manager.hook.sfm_exporters())
    return Plugins(
        estimators=_index_by_name(manager.hook.sfm_estimators()),
        calibrators=_index_by_name(manager.hook.sfm_calibrators()),
        exporters=exporters,
        scene_exporters=_index_by_name(manager.hook.sfm_scene_exporters(), exporters),
        depth_methods=_index_by_name(manager.hook.sfm_depth_methods()),
        features=_index_by_name(manager.hook.sfm_features()),
    )


@cache
def _part_here(kind: str, name: str) -> Any:
    """Return a part by its name in another process; no plug-in is loaded for what ships with the program."""
    built_in = getattr(_load((), installed=False), kind)
    return built_in[name] if name in built_in else _look_up(getattr(installed_plugins(), kind), name, kind)


class _NamedPart(Protocol):
    @property
    def name(self) -> str: ...


Part = TypeVar("Part", bound=_NamedPart)


def _index_by_name(results: Iterable[Iterable[Part]], taken: Iterable[str] = ()) -> Mapping[str, Part]:
    # pluggy calls the last registered first; reversed, the built-ins lead every listing
    found: dict[str, Part] = {}
    for part in (part for parts in reversed(list(results)) for part in parts):
        if part.name in found or part.name in taken:
            raise PluginError(f"two plug-ins offer '{part.name}'", hint="uninstall one of them")
        found[part.name] = part
    return MappingProxyType(found)


Format = TypeVar("Format", Exporter, SceneExporter)


def _check_available(part: Format) -> Format:
    if reason := part.unavailable():
        raise ConfigError(f"the file format '{part.name}' cannot be written here: {reason}", hint=INSTALL_HINT)
    return part


def _look_up(parts: Mapping[str, Part], name: str, kind: str) -> Part:
    if name not in parts:
        raise ConfigError(f"no {kind} is named '{name}'", hint=f"known: {', '.join(parts)}")
    return parts[name]
