"""What a shell completes that click does not know: names of methods and formats, those of plug-ins included."""

from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import entry_points
from types import MappingProxyType

import click
from click.shell_completion import CompletionItem

Complete = Callable[[click.Context, click.Parameter, str], list[CompletionItem]]

BUILT_IN: Mapping[str, tuple[str, ...]] = MappingProxyType({
    "features": ("sift", "sift-dsp"),
    "estimators": (
        "lev-ransac", "lev-ransac-thesis", "lev-ransac-sprt", "lev-ransac-tdd", "res-ransac", "mlesac", "msac",
        "ransac", "ransac-sprt", "ransac-tdd", "lmeds",
    ),
    "calibrators": (
        "zero-curves", "zero-curves-thesis", "multi-start", "perturbation", "geometric", "huang-faugeras", "kruppa",
    ),
    "exporters": ("ply", "glb", "obj", "stl", "draco", "usdz", "usd"),
    "scene_exporters": (
        "colmap", "colmap-text", "splat", "nerfstudio", "bundler", "cameras", "opencv", "cloud-ply", "laz",
    ),
})  # fmt: skip
"""Names of what ships with the program, by their attribute of `plugins.Plugins`: who presses Tab does not wait for a
second until all methods are imported."""
GROUP = "sfm_app"
"""Of entry points, as in `plugins`."""


def names_of(kind: str) -> tuple[str, ...]:
    """Return the names of methods of a kind; only where plug-ins are installed is everything imported for that.

    Args:
        kind: attribute of `plugins.Plugins`.
    """
    if not entry_points(group=GROUP):
        return BUILT_IN[kind]
    from sfm_app.plugins import load_plugins

    return tuple(getattr(load_plugins(), kind))


def complete_names(*kinds: str) -> Complete:
    """Return what completes the names of methods.

    Args:
        kinds: attributes of `plugins.Plugins`.
    """

    def complete(ctx: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
        names = [name for kind in kinds for name in names_of(kind)]
        return complete_from(names)(ctx, parameter, incomplete)

    return complete


def complete_from(values: Sequence[str]) -> Complete:
    """Return what completes one of some values.

    Args:
        values: all of them.
    """

    def complete(_ctx: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
        return [CompletionItem(value) for value in values if value.startswith(incomplete)]

    return complete


format_names = complete_names("exporters", "scene_exporters")
