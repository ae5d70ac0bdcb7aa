"""Links in signatures: a name that a module uses leads to the page of the class that it stands for."""

import re
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
    for full in (
        PUBLIC.get(name),
        *(f"sfm_app.{room}.{name}" for room in ("types", "settings", "progress", "plugins")),
    ):
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


ALIASES = (
    (re.compile(r"[\w.~]*_Buffer \| .*?_NestedSequence\[complex \| bytes \| str\]"), "ArrayLike"),
    (re.compile(r"[\w.~]*ndarray\[tuple\[Any, \.\.\.\], [\w.~]*dtype\[[\w.~]*?(\w+)\]\]"), r"NDArray[\1]"),
)
"""What Python makes of two names of NumPy, and the names."""


def shorten(
    app: "Sphinx", what: str, name: str, obj: object, options: object, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Return a signature and what it returns, with types named as in the source.

    Args:
        app, what, name, obj, options: not used.
        signature: arguments.
        returns: type of the result.
    """
    del app, what, name, obj, options
    for pattern, alias in ALIASES:
        signature, returns = (pattern.sub(alias, text) if text else text for text in (signature, returns))
    return signature, returns


def shorten_attributes(app: "Sphinx", doctree: "Element") -> None:
    """Write NDArray in the types of attributes, which are nodes already.

    Args:
        app: not used.
        doctree: of a page, changed in place.
    """
    from docutils.nodes import Text, inline
    from sphinx.addnodes import desc_annotation

    del app
    for node in doctree.findall(desc_annotation):
        parts = list(node.children)
        while (first := next((k for k in range(len(parts) - 1) if _is_array(parts[k : k + 2])), None)) is not None:
            end, depth = first + 1, 0
            while end == first + 1 or depth:
                depth += {"[": 1, "]": -1}.get(parts[end].astext(), 0)
                end += 1
            kind = next(part.astext() for part in reversed(parts[first:end]) if part.astext() != "]")
            parts[first:end] = [inline("", "", Text(f"NDArray[{kind}]"))]
        node.children = []
        node.extend(parts)


def _is_array(parts: "list[Element]") -> bool:
    return [part.astext() for part in parts] == ["ndarray", "["]


def setup(app: "Sphinx") -> dict[str, bool]:
    """Register with Sphinx."""
    app.connect("missing-reference", resolve)
    app.connect("doctree-read", shorten_attributes)
    app.connect("autodoc-process-signature", shorten)
    app.connect("autodoc-process-docstring", keep, priority=400)  # napoleon has 500
    app.connect("autodoc-process-docstring", restore, priority=600)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
