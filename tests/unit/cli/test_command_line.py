import json
import os
import subprocess
import sys

import pytest
from click.testing import CliRunner
from PIL import Image

from sfm_app.cli import main
from sfm_app.settings import Settings


def call(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def photo(path, size=(128, 96)):
    Image.effect_noise(size, 60).convert("RGB").save(path)


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "photos"
    place.mkdir()
    return place


def make_empty(folder): ...


def make_text_files(folder):
    for name in ("a.txt", "b.md"):
        (folder / name).write_text("not a photo")


def make_one_photo(folder):
    photo(folder / "a.jpg")


def make_truncated(folder):
    for name in ("a.jpg", "b.jpg"):
        photo(folder / name)
        (folder / name).write_bytes((folder / name).read_bytes()[:1000])


@pytest.mark.parametrize(("here", "out"), [("", "photos-model"), ("elsewhere", "{}/photos-model")])
def test_a_run_without_an_output_folder_writes_beside_the_photos_and_names_that_as_people_do(
    folder, tmp_path, monkeypatch, here, out
):
    (tmp_path / here).mkdir(exist_ok=True)
    monkeypatch.chdir(tmp_path / here)
    asked = []
    monkeypatch.setattr("sfm_app.reconstruct", lambda _, place, *__, **___: asked.append(place))

    call("run", folder, "-q")

    assert [str(place) for place in asked] == [out.format(tmp_path.resolve())]


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (make_empty, "the folder is empty"),
        (make_text_files, "2 not a photo"),
        (make_one_photo, "only one usable photo"),
        (make_truncated, "2 truncated or damaged"),
    ],
)
def test_unusable_folders_end_with_one_line_and_exit_code_3(folder, tmp_path, make, says):
    make(folder)

    result = call("run", folder, "-o", tmp_path / "out", "-q")

    assert result.exit_code == 3
    assert says in result.stderr
    error, hint = result.stderr.strip().splitlines()
    assert error.startswith("error: ") and hint.startswith("hint: ")
    assert result.stdout == ""


def test_missing_paths_end_with_exit_code_3(tmp_path):
    result = call("run", tmp_path / "nowhere", "-o", tmp_path / "out", "-q")

    assert (result.exit_code, "no such folder" in result.stderr) == (3, True)


def test_a_name_that_is_nearly_right_is_offered(tmp_path):
    (tmp_path / "Regal 2019 (für Oma)").mkdir()
    (tmp_path / "wheels").mkdir()

    nearly, far = (call("run", tmp_path / name, "-o", tmp_path / "out", "-q").stderr for name in ("Regal 2019", "fox"))

    assert nearly.endswith(f"\nis it {tmp_path / 'Regal 2019 (für Oma)'}?\n")
    assert far.count("\n") == 2 and "is it" not in far


def test_a_folder_of_photos_has_no_run_but_the_one_beside_it(folder, tmp_path):
    before = call("report", folder).stderr
    (tmp_path / "photos-model").mkdir()
    (tmp_path / "photos-model" / "manifest.json").write_text("{}")

    assert "holds no run" in before and "is it" not in before
    assert call("report", folder).stderr.endswith(f"\nis it {folder.resolve()}-model?\n")


def test_an_output_folder_that_is_a_file(folder, tmp_path):
    for name in ("a.jpg", "b.jpg"):
        photo(folder / name)
    (tmp_path / "model.glb").write_text("mine")

    result = call("run", folder, "-o", tmp_path / "model.glb", "-q")

    assert (result.exit_code, "model.glb: it is a file" in result.stderr) == (3, True)
    assert (tmp_path / "model.glb").read_text() == "mine"


@pytest.mark.parametrize(
    ("typed", "says"),
    [
        (("{folder}",), "sfm-app run {folder}"),
        (("run", "photos", "--scale", "24cm"), 'how far apart they are: "measure" in the report prints them.'),
        (("run", "My", "photos", "-o", "out"), '(photos). A name with blanks needs quotes: "My photos"'),
    ],
)
def test_what_newcomers_type_first_is_explained(folder, typed, says):
    result = call(*(word.format(folder=folder) for word in typed))

    assert result.exit_code == 2
    assert says.format(folder=folder) in result.stderr


def test_a_word_that_is_no_folder_is_no_command_either(tmp_path):
    assert "sfm-app run" not in call(tmp_path / "nowhere").stderr.split("Error:")[1]


def test_an_output_folder_that_cannot_be_made_ends_with_exit_code_3(folder, tmp_path):
    for name in ("a.jpg", "b.jpg"):
        photo(folder / name)
    (tmp_path / "file").write_text("in the way")

    result = call("run", folder, "-o", tmp_path / "file" / "out", "-q")

    assert (result.exit_code, "cannot write to" in result.stderr) == (3, True)


@pytest.mark.slow
def test_a_read_only_output_folder_ends_with_exit_code_3(folder, tmp_path, as_ordinary_user):
    for name in ("a.jpg", "b.jpg"):
        photo(folder / name)
    out = tmp_path / "locked"
    out.mkdir(mode=0o500)

    result = as_ordinary_user("-m", "sfm_app", "run", folder, "-o", out, "-q")

    assert (result.returncode, "cannot write to" in result.stderr) == (3, True)


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (("--estimator", "lev"), "no estimator is named 'lev'"),
        (("--calibrator", "zero"), "no calibrator is named 'zero'"),
        (("--set", "epipolar.max_eror_px=2"), "unknown setting 'epipolar.max_eror_px'"),
        (("--set", "epipolar.max_error_px"), "no '=' in it"),
        (("--set", "epipolar.max_error_px=-1"), "greater than 0"),
        (("--workers", "-2"), "'workers'"),
        (("--config", "nowhere.toml"), "cannot read nowhere.toml"),
        (("--from", "nowhere"), "nowhere"),
        (("--quality", "best"), "best"),
        (("--camera-model", "FOV"), "'scene.camera_model'"),
    ],
)
def test_wrong_settings_end_with_exit_code_2_before_any_work(folder, tmp_path, flags, says):
    result = call("run", folder, "-o", tmp_path / "out", *flags)

    assert result.exit_code == 2
    assert says in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_calibration_that_cannot_be_read_ends_with_exit_code_3_before_any_work(folder, tmp_path):
    result = call("run", folder, "-o", tmp_path / "out", "--calibration", tmp_path / "nowhere.json")

    assert (result.exit_code, "cannot read the calibration file" in result.stderr) == (3, True)
    assert "cameras.txt" in result.stderr and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_photos_of_different_places_end_with_exit_code_4(unrelated, tmp_path):
    result = call("run", unrelated, "-o", tmp_path / "out", "-q")

    assert result.exit_code == 4, result.stderr
    assert len(result.stderr.strip().splitlines()) == 2
    assert "Traceback" not in result.output


def test_config_prints_toml_that_loads(tmp_path):
    result = call(
        "config", "--quality", "high", "--set", "mesh.max_gap_triangles=3", "--estimator", "msac", "--faces", "5000"
    )
    path = tmp_path / "run.toml"
    path.write_text(result.stdout, encoding="utf-8")

    loaded = Settings.from_toml(path)
    assert (loaded.quality, loaded.mesh.max_gap_triangles, loaded.epipolar.estimator) == ("high", 3.0, "msac")
    assert loaded.mesh.faces == 5000
    assert loaded.depth.max_image_size_px == Settings.from_mapping({"quality": "high"}).depth.max_image_size_px


@pytest.mark.slow
def test_plugins_and_doctor_answer():
    listing = call("plugins").stdout
    found = json.loads(call("doctor", "--json").stdout)

    assert "lev-ransac-thesis" in listing and "zero-curves-thesis" in listing and "glb" in listing
    assert found["ray casting (Open3D)"].startswith("works")
    assert "pycolmap" in found


@pytest.mark.slow
def test_a_terminal_or_file_without_the_letters_of_a_name_gets_their_numbers(tmp_path):
    command = [sys.executable, "-m", "sfm_app", "markers", "50mm", "-o", str(tmp_path / "\u5199.pdf")]
    known = {**os.environ, "PYTHONIOENCODING": "cp1252"}
    done = subprocess.run(command, env=known, capture_output=True, check=False)

    assert done.returncode == 0, done.stderr
    assert rb"\u5199.pdf" in done.stdout


def test_the_module_runs_as_a_program():
    done = subprocess.run([sys.executable, "-m", "sfm_app", "--version"], capture_output=True, text=True, check=True)

    assert done.stdout.startswith("sfm-app, version ")


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (
            OSError(28, "No space left on device", "out/dense/fused.ply"),
            3,
            "the disk is full (No space left on device)",
        ),
        (ZeroDivisionError("by accident"), 1, "unexpected ZeroDivisionError: by accident"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_whatever_happens_ends_with_one_line(monkeypatch, folder, error, code, says):
    def broken(*_, **__):
        raise error

    monkeypatch.setattr("sfm_app.api.reconstruct", broken)
    result = call("run", folder, "-q")

    assert result.exit_code == code
    assert result.stderr.startswith(f"error: {says}")
    assert len(result.stderr.strip().splitlines()) == 2


def test_a_figure_that_cannot_be_written_is_refused_before_any_work(folder, tmp_path):
    result = call("calibrate", folder, "--figure", tmp_path / "curves.jpg", "-q")

    assert result.exit_code == 2
    assert "cannot write '.jpg'" in result.stderr
    assert ".svg" in result.stderr
