"""docs/reference/output-files.md lists what a run leaves, and what its manifest holds."""

import json
import re

import pytest

from sfm_app.runtime.workspace import CHECKSUM, StageRecord
from tests.docs.pages import ROOT

PAGE = (ROOT / "docs" / "reference" / "output-files.md").read_text(encoding="utf-8")
NAMED = {
    name.rstrip("/")
    for row in re.findall(r"^\| (`[^|]+) \|", PAGE, re.MULTILINE)
    for name in re.findall(r"`([^`]+)`", row)
}


def test_every_entry_of_a_record_is_listed():
    assert {*StageRecord.__dataclass_fields__, CHECKSUM} <= NAMED


@pytest.mark.slow
def test_every_file_of_a_run_is_listed(finished):
    left = {path.name for path in (finished / "out").iterdir() if not path.name.startswith(".")}
    assert {"model.glb", "report.html", "manifest.json"} <= left
    assert left <= NAMED


@pytest.mark.slow
def test_every_entry_of_the_manifest_is_listed(finished):
    manifest = json.loads((finished / "out" / "manifest.json").read_text(encoding="utf-8"))
    assert set(manifest) <= NAMED
    assert all(set(record) <= NAMED for record in manifest["stages"].values())
