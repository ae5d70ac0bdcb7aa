"""The program starts quickly, lists its commands, and ends every error with a line, a hint and an exit code."""

import contextlib
import io
import json
import os
import re
import subprocess
import sys

import click
import pytest
from click.shell_completion import BashComplete
from click.testing import CliRunner
from PIL import Image

from sfm_app.cli import commands
from sfm_app.cli.program import SECTIONS, fail, main
from sfm_app.settings import Settings
from tests.unit.cli.test_terminal import LONG, Screen, check_text

HEAVY = ("numba", "scipy", "cv2", "pycolmap", "open3d", "trimesh", "matplotlib", "PIL", "rich", "sfm_app.api")
"""Modules that take most of the second and a half that all of the program needs to be imported."""
SUMMARIES = {name: summary for section in SECTIONS.values() for name, summary in section.items()}


def call(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def loaded_by(*arguments, **environment):
    """The modules in `HEAVY` that a process imports, and its stdout."""
    code = (
        "import sys; from sfm_app.cli.program import main\n"
        "try: main(prog_name='sfm-app')\n"
        f"finally: print([name for name in {HEAVY} if name in sys.modules], file=sys.stderr)"
    )
    command, known = [sys.executable, "-c", code, *arguments], {**os.environ, **environment}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=known)
    return done.stderr.strip().splitlines()[-1], done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((), "sfm-app run PHOTOS"),
        (("--help",), "Use a finished run:"),
        (("--version",), "sfm-app, version "),
        (("completion", "zsh"), "#compdef sfm-app"),
        (("run", "--help"), "--quality"),
        (("markers", "--help"), "apriltag-36h11"),
        (("demo", "--help"), "--scene"),
        (("config",), "[matching]"),
    ],
)
def test_commands_without_photos_import_little(arguments, text):
    loaded, stdout = loaded_by(*arguments)
    assert loaded == ("['pycolmap']" if arguments == ("config",) else "[]") and text in stdout


@pytest.mark.slow
@pytest.mark.parametrize(("words", "completed"), [("sfm-app me", "measure"), ("sfm-app run --from int", "intrinsics")])
def test_completion_imports_little(words, completed):
    count = str(len(words.split()) - 1)
    loaded, stdout = loaded_by(_SFM_APP_COMPLETE="bash_complete", COMP_WORDS=words, COMP_CWORD=count)
    assert (loaded, stdout.split()) == ("[]", [f"plain,{completed}"])


@pytest.mark.slow
def test_the_list_of_commands_imports_none():
    code = "import sys; from sfm_app.cli.program import main; main(['--help'], standalone_mode=False); "
    code += "sys.exit('sfm_app.cli.commands' in sys.modules or 'pydantic' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


def test_without_arguments_it_lists_the_first_commands():
    result = call()
    lines = result.stdout.splitlines()
    assert result.exit_code == 0 and result.stderr == "" and len(lines) <= 12 and max(map(len, lines)) <= 80
    assert [line.split()[1] for line in lines if line.startswith("  sfm-app")] == ["run", "studio", "demo", "doctor"]


def test_help_has_every_command():
    text = call("--help").stdout
    listed = [line.split()[0] for line in text.split("Make a model:")[1].splitlines() if line.startswith("  ")]
    assert listed == main.list_commands(click.Context(main)) == list(SUMMARIES)
    functions = {name for name, value in vars(commands).items() if isinstance(value, click.Command)}
    assert functions == set(SUMMARIES)


@pytest.mark.parametrize("name", SUMMARIES)
def test_every_command_has_a_summary_and_a_help_that_fit(name):
    command = main.get_command(click.Context(main), name)
    result = call(name, "--help")
    assert command is getattr(commands, name) and command.name == name
    assert 15 < len(SUMMARIES[name]) <= 62 and SUMMARIES[name].endswith(".") and result.exit_code == 0
    check_text(result.stdout)
    check_text(call("--help").stdout)


@pytest.mark.parametrize("shell", commands.SHELLS)
def test_a_script_for_each_shell_calls_the_program(monkeypatch, shell):
    monkeypatch.setattr(BashComplete, "_check_version", lambda *_: None)  # starts bash
    result = call("completion", shell)
    assert result.exit_code == 0 and f"_SFM_APP_COMPLETE={shell}_complete" in result.stdout
    assert "sfm-app" in result.stdout and call("completion", "tcsh").exit_code == 2


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_config_prints_toml_that_loads(tmp_path, encoding):
    flags = ("--quality", "high", "--set", "mesh.min_island=0.25", "--estimator", "msac", "--faces", "5000")
    result = call("config", *flags)
    path = tmp_path / "run.toml"
    path.write_text(result.stdout, encoding=encoding)  # PowerShell writes UTF-16
    loaded = Settings.from_toml(path)
    assert (loaded.quality, loaded.mesh.min_island, loaded.epipolar.estimator) == ("high", 0.25, "msac")
    assert loaded.mesh.faces == 5000
    assert loaded.depth.max_image_size_px == Settings.from_mapping({"quality": "high"}).depth.max_image_size_px


@pytest.mark.slow
def test_plugins_and_doctor_answer():
    listing = call("plugins").stdout
    state = json.loads(call("doctor", "--json").stdout)
    assert "lev-ransac-thesis" in listing and "zero-curves-thesis" in listing and "glb" in listing
    assert "depth methods:\n" in listing and state["ray casting (Open3D)"].startswith("works")
    assert "pycolmap" in state


@pytest.mark.slow
def test_output_without_the_letters_of_a_name_gets_their_numbers(tmp_path):
    command = [sys.executable, "-m", "sfm_app", "markers", "50mm", "-o", str(tmp_path / "\u5199.pdf")]
    environment = {**os.environ, "PYTHONIOENCODING": "cp1252"}
    done = subprocess.run(command, env=environment, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert rb"\u5199.pdf" in done.stdout


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "photos"
    path.mkdir()
    return path


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("ran",), "No such command 'ran'"),
        (("{folder}",), "sfm-app run {folder}"),
        (("run", "photos", "--scale", "24cm"), 'two points and their distance: "measure" in the report prints them.'),
        (("view", "My", "photos"), '(photos). Put quotes around a name with spaces: "My photos"'),
    ],
)
def test_mistyped_commands_are_explained(folder, words, text):
    result = call(*(word.format(folder=folder) for word in words))
    assert result.exit_code == 2 and text.format(folder=folder) in result.stderr


@pytest.mark.parametrize("command", ["run", "calibrate"])
def test_a_name_with_spaces_wants_quotes(command):
    result = call(command, "My", "photos", "-o", "out")
    assert result.exit_code == 3 and "My" in result.stderr and "quotes around a name with spaces" in result.stderr


def test_only_a_folder_that_exists_is_suggested_for_a_run(tmp_path):
    assert "sfm-app run" not in call(tmp_path / "nowhere").stderr.split("Error:")[1]


def test_a_figure_that_cannot_be_written_is_refused_before_any_work(folder, tmp_path):
    result = call("calibrate", folder, "--figure", tmp_path / "curves.jpg", "-q")
    assert result.exit_code == 2 and "cannot write '.jpg'" in result.stderr and ".svg" in result.stderr


def write_photos(folder, *names):
    for name in names:
        Image.effect_noise((128, 96), 60).convert("RGB").save(folder / name)


def test_a_missing_folder_ends_with_exit_code_3_and_a_similar_name_is_offered(tmp_path):
    (tmp_path / "Regal 2019 (für Oma)").mkdir()
    (tmp_path / "wheels").mkdir()
    similar, other = (call("run", tmp_path / name, "-o", tmp_path / "out", "-q") for name in ("Regal 2019", "fox"))
    assert similar.exit_code == other.exit_code == 3 and "not found" in other.stderr
    assert similar.stderr.endswith(f"\nis it {tmp_path / 'Regal 2019 (für Oma)'}?\n")
    assert other.stderr.count("\n") == 2 and "is it" not in other.stderr


def test_for_a_folder_of_photos_the_run_beside_it_is_offered(folder, tmp_path):
    before = call("report", folder).stderr
    (tmp_path / "photos-model").mkdir()
    (tmp_path / "photos-model" / "manifest.json").write_text("{}")
    assert "holds no run" in before and "is it" not in before
    assert call("report", folder).stderr.endswith(f"\nis it {folder.resolve()}-model?\n")


@pytest.mark.parametrize(("here", "out"), [("", "photos-model"), ("elsewhere", "{}/photos-model")])
def test_a_run_without_an_output_folder_writes_beside_the_photos(folder, tmp_path, monkeypatch, here, out):
    (tmp_path / here).mkdir(exist_ok=True)
    monkeypatch.chdir(tmp_path / here)
    folders = []
    monkeypatch.setattr("sfm_app.reconstruct", lambda _, place, *__, **___: folders.append(place))
    call("run", folder, "-q")
    assert [str(path) for path in folders] == [out.format(tmp_path.resolve())]


@pytest.mark.slow
def test_a_read_only_output_folder_ends_with_exit_code_3(folder, tmp_path, as_ordinary_user):
    write_photos(folder, "a.jpg", "b.jpg")
    out = tmp_path / "locked"
    out.mkdir(mode=0o500)
    result = as_ordinary_user("-m", "sfm_app", "run", folder, "-o", out, "-q")
    assert (result.returncode, "cannot write to" in result.stderr) == (3, True)


def test_a_calibration_that_cannot_be_read_ends_with_exit_code_3_before_any_work(folder, tmp_path):
    result = call("run", folder, "-o", tmp_path / "out", "--calibration", tmp_path / "nowhere.json")
    assert (result.exit_code, "cannot read the calibration file" in result.stderr) == (3, True)
    assert "cameras.txt" in result.stderr and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (OSError(28, "No space left on device", "out/a.ply"), 3, "the disk is full (No space left on device)"),
        (FileNotFoundError(2, "No such file", "out/a.npz"), 3, "No such file: out/a.npz"),
        (ZeroDivisionError("by accident"), 1, "unexpected ZeroDivisionError: by accident"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_every_exception_ends_with_one_line_and_a_hint(monkeypatch, folder, error, code, text):
    def fail_with_error(*_, **__):
        raise error

    monkeypatch.setattr("sfm_app.api.reconstruct", fail_with_error)
    result = call("run", folder, "-q")

    assert result.exit_code == code and result.stderr.startswith(f"error: {text}\nhint: ")
    assert len(result.stderr.strip().splitlines()) == 2


def stderr_of_fail(stream, *arguments):
    with contextlib.redirect_stderr(stream), pytest.raises(SystemExit) as ended:
        fail(*arguments)
    assert ended.value.code == arguments[-1]
    return stream.getvalue()


def test_errors_are_one_line_each_in_a_pipe():
    text = stderr_of_fail(io.StringIO(), LONG, f"{LONG}\nsecond", 3)
    assert text.splitlines() == [f"error: {LONG}", f"hint: {LONG}", "second"]


def test_errors_fit_on_a_terminal(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = stderr_of_fail(Screen(), f"\x1b[31m{LONG}", LONG, 3)
    check_text(text)
    assert len(re.findall(r"^(error|hint): ", text, re.MULTILINE)) == 2


@pytest.mark.slow
def test_a_warning_of_python_reaches_no_terminal():
    code = (
        "import warnings; from sfm_app.cli.program import main; main([], standalone_mode=False); warnings.warn('of -1')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "sfm-app run PHOTOS" in done.stdout and done.stderr == ""


@pytest.mark.parametrize(
    "words",
    [("run", ""), ("run", "HERE", "-o", ""), ("run", "HERE", "--images", ""), ("run", "HERE", "--masks", ""),
     ("calibrate", ""), ("export", "", "ply"), ("view", ""), ("report", ""), ("measure", "", "1,2,3", "4,5,6"),
     ("config", "--config", "")],
)  # fmt: skip
def test_empty_paths_are_refused_before_any_work(tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    result = call(*(str(tmp_path) if word == "HERE" else word for word in words))
    assert result.exit_code == 2 and "it is empty: name a path" in " ".join(result.stderr.split())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "says"),
    [(("1,2,3",), "name two points, or the corners of a polygon"),
     (("1,2,3", "--volume", "0,0,0 1,0,0 1,0,1"), "name two points, or the corners of a polygon"),
     (("--volume", "0,0,0 1,0"), "'1,0' is no point"), (("--volume", ""), "each corner is three finite numbers")],
)  # fmt: skip
def test_a_measurement_says_what_it_needs(tmp_path, words, says):
    result = call("measure", tmp_path, *words)
    assert result.exit_code == 2 and says in " ".join(result.stderr.split()), result.stderr


def run_in_shell(script):
    return subprocess.run(
        ["sh", "-c", script.replace("APP", f"{sys.executable} -m sfm_app")], capture_output=True, text=True, check=False
    )


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows has no such shell")
@pytest.mark.parametrize("words", ["config", "plugins", "--help", "doctor"])
def test_nobody_needs_to_read_the_output(words):
    done = run_in_shell(f"exec 3>&1 >&- 2>&-; APP {words}; echo $? >&3")
    assert done.stdout in ("0\n", "1\n" if words == "doctor" else "0\n")  # the doctor may find faults
    done = run_in_shell(f"(APP {words}; echo rc=$? >&2) | true")
    assert re.fullmatch(r"rc=[01]\n", done.stderr), done.stderr
