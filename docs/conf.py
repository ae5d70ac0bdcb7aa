"""How Sphinx makes the site; `make docs` calls docs/build.py, which lays out the pages first."""

import sys
from importlib import metadata
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "sfm_app"
copyright = "the authors of sfm_app, BSD-3-Clause"  # noqa: A001 - Sphinx's name
version = release = metadata.version("sfm-app")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "type_names"]
root_doc = "index"
exclude_patterns = ["_ext/**", "figures/**", "build.py", "conf.py"]

myst_heading_anchors = 4
myst_enable_extensions = ["attrs_inline", "colon_fence", "deflist"]
myst_url_schemes = ("http", "https", "mailto")

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 88
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_preprocess_types = False

html_theme = "furo"
html_title = f"sfm_app {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
html_theme_options = {"top_of_page_buttons": []}
pygments_style, pygments_dark_style = "friendly", "monokai"
highlight_language = "none"
"""Most blocks are what one types into a terminal, or what it answers."""

default_role = "code"
"""Of docstrings: what stands between single backquotes."""

nitpicky = True
nitpick_ignore_regex = [
    (r"py:.*", r"(ArrayLike|NDArray|numpy|np|pathlib|collections|typing|os|click|pydantic|pluggy|types|functools)\b.*")
]
suppress_warnings = ["myst.xref_ambiguous"]
