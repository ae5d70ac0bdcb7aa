"""What a stage depends on, and why it is done again."""

from dataclasses import replace

from sfm_app.engine.stage import (
    Stage,
    manifest_head,
    nested_value,
    rerun_reason,
    settings_and_versions,
    stage_fingerprint,
)
from sfm_app.runtime.context import GIVEN_CAMERAS
from sfm_app.runtime.workspace import StageRecord
from sfm_app.settings import Settings
from sfm_app.types import GivenCameras

STAGE = Stage("match_graph", (), ("matching", "photos.cameras", "seed"), ("x.txt",), None, None, None)


def set_to(run, **values):
    return replace(run, settings=Settings.from_mapping(values))


def finished(run):
    """A stage that was finished with what is in force."""
    run.workspace.create()
    (run.workspace.root / "x.txt").write_text("12")
    made_from, used = stage_fingerprint(STAGE, ["abc"], run), settings_and_versions(STAGE, run)
    record = StageRecord(made_from, 1.0, {}, run.workspace.manifest.sizes(STAGE.files), made_with=used)
    run.workspace.manifest.finish("match_graph", record, manifest_head(run))


def why(run, inputs="abc"):
    return rerun_reason(STAGE, stage_fingerprint(STAGE, [inputs], run), run)


def test_a_stage_that_was_never_done_needs_no_reason(run):
    assert why(run) == ""


def test_settings_of_other_stages_change_nothing(run):
    finished(run)
    set_to(run, mesh={"faces": 1000}, photos={"keep_low_quality": True}, workers=2)
    assert why(run) is None


def test_a_setting_that_changed_is_named_with_both_values(run):
    finished(run)
    assert why(set_to(run, matching={"max_features": 500})) == "matching.max_features 8192 -> 500"
    assert why(set_to(run, photos={"cameras": "single"}, seed=3)) == 'photos.cameras "auto" -> "single", seed 0 -> 3'


def test_other_contents_of_a_calibration_file_are_a_change(run):
    stage = replace(STAGE, settings=(GIVEN_CAMERAS,))
    one, other = (replace(run, given=GivenCameras(digest=digest)) for digest in ("x", "y"))
    assert stage_fingerprint(stage, [], one) != stage_fingerprint(stage, [], other)
    assert settings_and_versions(stage, one)["settings"] == {GIVEN_CAMERAS: "x"}


def test_no_more_than_three_are_named(run):
    finished(run)
    said = why(set_to(run, quality="high", photos={"cameras": "each"}, seed=1, matching={"max_ratio": 0.7}))
    assert said.count("->") == 3 and said.endswith("and 3 more")


def test_photos_files_and_versions(run, monkeypatch):
    finished(run)
    assert why(run, "other photos") == "the photos have changed"
    monkeypatch.setattr("sfm_app.engine.stage.versions", lambda: {"numpy": "1.0"})
    assert "-> " in why(run)
    (run.workspace.root / "x.txt").unlink()
    assert why(run) == "x.txt is gone or was changed"


def test_values_are_found_by_dotted_names():
    assert nested_value({"a": {"b": 3}}, "a.b") == 3
    assert nested_value({"a": 1}, "a.b") is None
