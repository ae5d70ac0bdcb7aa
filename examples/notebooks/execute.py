#!/usr/bin/env python3
"""Run notebooks from top to bottom and keep what they show: python examples/notebooks/execute.py NOTEBOOK...

It needs `pip install nbclient ipykernel` besides sfm-app. What the notebooks make goes into a temporary folder.
"""

import os
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient


def main() -> None:
    """Execute each notebook, and write it with the new outputs."""
    os.environ["OPEN3D_DISABLE_WEB_VISUALIZER"] = "true"  # or Open3D says in every notebook that it could show things
    for path in map(Path, sys.argv[1:]):
        notebook = nbformat.read(path, as_version=4)
        with tempfile.TemporaryDirectory() as folder:
            kernel = {"kernel_name": "python3", "resources": {"metadata": {"path": folder}}}
            NotebookClient(notebook, timeout=1800, coalesce_streams=True, record_timing=False, **kernel).execute()
        for cell in notebook.cells:
            for output in cell.get("outputs", ()):
                if len(output.get("data", ())) > 1:  # a picture or a table says it better
                    del output["data"]["text/plain"]
        notebook.metadata.get("language_info", {}).pop("version", None)
        nbformat.write(notebook, path)


if __name__ == "__main__":
    main()
