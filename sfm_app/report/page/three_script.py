"""three.js, out of the viewer that trimesh's wheel carries, so that no third-party code lies in this project.

The script of that viewer has three.js with a loader of GLB files, and then its own page, which is cut off.
"""

import zipfile
from functools import cache
from importlib import resources

BEGIN, END, OWN_PART = "<script>", "</script>", "var camera,controls,scene"
NEEDED = ("THREE={}", "THREE.GLTFLoader=GLTFLoader")
"""Without these the wheel carries something else."""


@cache
def three_script() -> str:
    """Return three.js with its loader of GLB files as one script; empty where trimesh does not carry it."""
    packed = resources.files("trimesh") / "resources" / "templates" / "viewer.zip"
    try:
        with packed.open("rb") as file, zipfile.ZipFile(file) as archive:
            page = archive.read("viewer.html.template").decode("utf-8")
    except (OSError, KeyError, zipfile.BadZipFile):
        return ""
    script = page.partition(BEGIN)[2].rpartition(END)[0].partition(OWN_PART)[0]
    return script if all(part in script for part in NEEDED) and END not in script else ""
