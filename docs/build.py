"""Make the site: python docs/build.py [FOLDER]. Warnings are errors; the front page is docs/_build/html/index.html."""

import sys
from pathlib import Path

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS / "_ext"))


def build(target: Path) -> int:
    """Lay out the pages and call Sphinx; return its exit code.

    Args:
        target: folder for `pages` and `html`.
    """
    from generated import GENERATORS
    from site_pages import lay_out
    from sphinx.cmd.build import main

    lay_out(target / "pages", GENERATORS)
    strict = ["--fail-on-warning", "--keep-going", "--quiet", "--write-all", "-j", "auto"]
    folders = [target / "pages", target / "html"]
    return main([*strict, "-c", str(DOCS), "-d", str(target / "doctrees"), "-b", "html", *map(str, folders)])


if __name__ == "__main__":
    sys.exit(build(Path(sys.argv[1]) if sys.argv[1:] else DOCS / "_build"))
