"""Links in signatures: a name that a module uses leads to the page of the class that it stands for."""

from typing import TYPE_CHECKING, Any

import sfm_app
from sfm_app import api, errors, progress, settings, types

if TYPE_CHECKING:
    from docutils.nodes import Element
    from sphinx.addnodes import pending_xref
    from sphinx.application import Sphinx
    from sphinx.environment import BuildEnvironment

PUBLIC = {name: f"sfm_app.{name}" for name in sfm_app.__all__}
"""Where the page of a public name is."""


def resolve(app: "Sphinx", env: "BuildEnvironment", node: "pending_xref", contnode: "Element") -> "Element | None":
    """Find the page of a class under its public name.

    Args:
        app: Sphinx.
        env: of the build.
        node: the link.
        contnode: its text.
    """
    if node.get("refdomain") != "py":
        return None
    name = str(node["reftarget"]).rpartition(".")[2]
    domain: Any = env.domains["py"]
    for full in (PUBLIC.get(name), *(f"sfm_app.{room}.{name}" for room in ("types", "settings", "progress", "plugins"))):
        if full in domain.objects:
            kind = domain.objects[full].objtype
            role = {"function": "func", "data": "data", "exception": "exc", "attribute": "attr"}.get(kind, "class")
            return domain.resolve_xref(env, node["refdoc"], app.builder, role, full, node, contnode)  # type: ignore[no-any-return]
    return contnode if name in vars(api) or any(name in vars(m) for m in (errors, progress, settings, types)) else None


KEPT: dict[str, list[str]] = {}


def keep(app: "Sphinx", what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Remember what is said of an attribute before napoleon takes all up to the first colon for its type.

    Args:
        app, obj, options: not used.
        what: kind of object.
        name: its name.
        lines: of its docstring.
    """
    del app, obj, options
    if what in ("attribute", "data", "property"):
        KEPT[name] = list(lines)


def restore(app: "Sphinx", what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Put back what `keep` has remembered.

    Args:
        app, what, obj, options: not used.
        name: as for `keep`.
        lines: changed in place.
    """
    del app, what, obj, options
    if name in KEPT:
        lines[:] = KEPT.pop(name)


def setup(app: "Sphinx") -> dict[str, bool]:
    """Register with Sphinx."""
    app.connect("missing-reference", resolve)
    app.connect("autodoc-process-docstring", keep, priority=400)  # napoleon has 500
    app.connect("autodoc-process-docstring", restore, priority=600)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
