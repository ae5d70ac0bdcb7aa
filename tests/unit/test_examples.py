"""Every example runs as it stands: scripts, notebooks, and the plug-in to copy."""

import ast
import csv
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest

from sfm_app.camera_files import read_given_cameras
from sfm_app.synthetic.correspondences import PairOptions, make_pair

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
NOTEBOOKS = sorted((EXAMPLES / "notebooks").glob("*.ipynb"))
RENDERED = {"COUNT": 7, "WIDTH": 480, "RADIAL": 0.0}
"""As the fixture `rendered` has it."""
PHOTOS = "photos_7_480_0.0"
"""Their folder."""
MOST_BYTES = 200_000
"""Of a notebook with its outputs."""
CONTRACT = "finds_the_truth or cross_process or memory_is_linear or random"
"""What of the contract is tried on the template: seconds of it; the whole takes three times as long."""


def call(name, *arguments):
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def folder_run(rendered, tmp_path_factory):
    """The output folder of examples/reconstruct_folder.py, and what it said."""
    out = tmp_path_factory.mktemp("example") / "out"
    return out, call("reconstruct_folder.py", rendered[0], out)


@pytest.mark.slow
def test_one_estimator():
    done = call("one_estimator.py")
    assert done.returncode == 0, done.stderr
    assert "identifiable: True" in done.stdout


@pytest.mark.slow
def test_reconstruct_folder(folder_run):
    out, done = folder_run
    assert done.returncode == 0, done.stderr
    assert "7 photos placed" in done.stdout
    assert (out / "model.glb").exists()


@pytest.mark.slow
def test_export_model(folder_run, tmp_path):
    done = call("export_model.py", folder_run[0], tmp_path / "files")
    assert done.returncode == 0, done.stderr
    names = {path.name for path in (tmp_path / "files").iterdir()}
    assert {"model.obj", "model.mtl", "points.ply"} < names and any(name.endswith(".jpg") for name in names)
    assert {line.split(":")[0] for line in done.stdout.splitlines()} == names


def read_table(path):
    with path.open(encoding="utf-8", newline="") as file:
        return {row["folder"]: row for row in csv.DictReader(file)}


def stages(out):
    return json.loads((out / "manifest.json").read_text(encoding="utf-8"))["stages"]


@pytest.fixture
def begun_batch(folder_run, rendered, tmp_path):
    """A folder with a good and a bad folder of photos; the good one is done, and so is one that is gone."""
    folders, out = tmp_path / "folders", tmp_path / "out"
    shutil.copytree(rendered[0], folders / "good")
    (folders / "bad").mkdir()
    shutil.copytree(folder_run[0], out / "good", symlinks=True)
    (out / "table.csv").write_text("folder,state,placed\ngone,done,12\n", encoding="utf-8")
    return folders, out


@pytest.mark.slow
def test_batch_goes_on_after_a_failure_and_does_nothing_again(begun_batch):
    folders, out = begun_batch
    before = stages(out / "good")

    done = call("batch_folders.py", folders, out, "--quality", "draft", "--set", "report=false")

    assert done.returncode == 1, done.stderr
    rows = read_table(out / "table.csv")
    assert {name: row["state"] for name, row in rows.items()} == {"gone": "done", "bad": "failed", "good": "done"}
    assert "the folder is empty" in rows["bad"]["reason"] and rows["gone"]["placed"] == "12"
    good = rows["good"]
    assert (good["photos"], good["placed"], good["reason"]) == ("7", "7", "")
    assert float(good["focal_px"]) == pytest.approx(504, rel=0.01) and 0.1 < float(good["deviation_px"]) < 10
    assert int(good["triangles"]) > 1000
    after = stages(out / "good")
    assert float(good["seconds"]) == pytest.approx(sum(stage["seconds"] for stage in after.values()), abs=0.1)
    del before["photos"], after["photos"]  # those of another folder are read, and found to be the same
    assert len(after) > 5 and after == before
    assert done.stdout.startswith("[1/2] bad: state failed, reason ") and not (out / "bad" / "report.html").exists()


@pytest.mark.slow
def test_batch_stops_at_a_wrong_option_and_where_there_is_nothing(begun_batch):
    folders, out = begun_batch
    before = (out / "table.csv").read_bytes()
    wrong = call("batch_folders.py", folders, out, "--quality", "best")
    nothing = call("batch_folders.py", folders / "good", out)
    assert wrong.returncode == 1 and "'best' is not one of" in wrong.stderr and not wrong.stdout
    assert nothing.returncode == 2 and "holds no folders of photos" in nothing.stderr
    assert (out / "table.csv").read_bytes() == before


def cells(path, kind):
    found = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return [cell | {"source": "".join(cell["source"])} for cell in found if cell["cell_type"] == kind]


def is_parameters(cell):
    return "parameters" in cell["metadata"].get("tags", ())


def execute(name, **changed):
    """Run a notebook in one namespace, with other parameters, and return it; show what a cell ends with as Jupyter."""
    path, names = EXAMPLES / "notebooks" / f"{name}.ipynb", {"__name__": "__main__"}
    for number, cell in enumerate(cells(path, "code")):
        tree = ast.parse(cell["source"])
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, f"{path.name}[{number}]", "exec"), names)  # noqa: S102 - our own notebook
        if last is not None:
            shown = eval(compile(ast.Expression(last.value), f"{path.name}[{number}]", "eval"), names)  # noqa: S307
            for show in ("_repr_html_", "_repr_png_"):
                assert getattr(shown, show, lambda: "nothing of that kind")()
        if is_parameters(cell):
            assert set(changed) <= set(names), "a parameter is gone"
            names.update(changed)
    return names


@pytest.fixture
def work(folder_run, rendered, tmp_path):
    """A folder in which most of a notebook's work is done: photos but one, and the finished run of all."""
    shutil.copytree(rendered[0], tmp_path / PHOTOS)
    (tmp_path / PHOTOS / "view_06.jpg").unlink()
    shutil.copytree(folder_run[0], tmp_path / "out", symlinks=True)
    return tmp_path


@pytest.fixture
def no_screen():
    matplotlib.use("Agg")
    yield
    plt.close("all")


@pytest.mark.slow
def test_calibrate_folder(work, rendered, capsys):
    names = execute("calibrate_folder", WORK=str(work), QUALITY="draft", **RENDERED)
    assert (work / PHOTOS / "view_06.jpg").read_bytes() == (rendered[0] / "view_06.jpg").read_bytes()
    camera, deviation = names["camera"], names["camera"].spread["fx"]
    assert camera.identifiable and 0.1 < deviation < 10
    assert abs(camera.K[0, 0] - 504) < 4 * deviation
    said = capsys.readouterr().out
    assert f"7 files in {PHOTOS}\nthe photos determine K\n" in said
    line = re.search(r"^fx +([\d.]+) +([\d.]+) +504\.000 +(-?[\d.]+)$", said, re.MULTILINE)
    assert float(line[3]) == pytest.approx((float(line[1]) - 504) / float(line[2]), abs=0.06)
    assert (work / "camera.png").stat().st_size > 50_000
    (given,) = read_given_cameras(work / "out" / "calibration.json").cameras.values()  # what --calibration takes
    np.testing.assert_allclose(given.K, camera.K)


@pytest.mark.slow
def test_photos_to_splats_with_photos_of_ones_own(work, rendered, capsys):
    names = execute("photos_to_splats", PHOTOS=str(rendered[0]), WORK=str(work), QUALITY="draft")
    assert names["folder"] == work / "out" / "export" / "splat"
    assert len(list((names["folder"] / "images").iterdir())) == 7
    said = capsys.readouterr().out
    assert "7 photos placed, 0 not" in said
    assert re.search(r"^images/view_06.jpg +\d{4,} bytes$", said, re.MULTILINE)
    assert re.search(r"^sparse/0/points3D.bin +\d{4,} bytes$", said, re.MULTILINE)


@pytest.mark.slow
def test_compare_estimators(tmp_path, no_screen, capsys):
    own = make_pair(PairOptions(points=300, outliers=0.4), 3)
    heading = "x1,y1,x2,y2"
    np.savetxt(tmp_path / "mine.csv", np.hstack([own.x1, own.x2]), delimiter=",", header=heading, comments="")
    methods = ["lev-ransac", "lev-ransac-thesis", "not-installed"]
    sizes = {"METHODS": methods, "SHARES": [0.2, 0.5], "PAIRS": 3, "POINTS": 200}

    names = execute("compare_estimators", CSV=str(tmp_path / "mine.csv"), **sizes)

    said = capsys.readouterr().out
    assert names["methods"] == methods[:2] and "left out: no estimator is named 'not-installed'" in said
    pairs = {(name, share) for name in methods[:2] for share in (0.2, 0.5)}
    assert set(names["errors"]) == set(names["seconds"]) == pairs
    for share in (0.2, 0.5):
        ours, thesis = (np.median(names["errors"][name, share]) for name in methods[:2])
        assert 0.01 < ours < 0.4 and ours < thesis < 1.0
    assert len(names["axes"].lines) == 2
    assert "300 matches" in said
    for fit in names["own"].values():
        assert fit.inliers[own.is_inlier].mean() > 0.7 and fit.inliers[~own.is_inlier].mean() < 0.1


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_what_a_notebook_shows_is_of_one_run_of_it(path):
    assert path.stat().st_size < MOST_BYTES
    found = cells(path, "code")
    assert [cell["execution_count"] for cell in found] == list(range(1, len(found) + 1))
    assert [is_parameters(cell) for cell in found] == [True] + [False] * (len(found) - 1)
    outputs = [output for cell in found for output in cell["outputs"]]
    assert outputs
    for output in outputs:
        assert output["output_type"] != "error" and output.get("name") != "stderr"
    places = re.findall(r"(?<![\w.:/])/(?:tmp|home|root|work|usr|Users|opt)\b|[A-Z]:\\\\", json.dumps(outputs))
    assert places == []


@pytest.fixture
def installed_template(tmp_path):
    """The template, copied and installed as pip does it, without a network: module and metadata side by side."""
    place = tmp_path / "site"
    shutil.copytree(EXAMPLES / "plugin_template", place, ignore=shutil.ignore_patterns("__pycache__", ".*"))
    project = tomllib.loads((place / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    about = place / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    about.mkdir()
    head = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (about / "METADATA").write_text(head, encoding="utf-8")
    (name, module), *others = project["entry-points"]["sfm_app"].items()
    (about / "entry_points.txt").write_text(f"[sfm_app]\n{name} = {module}\n", encoding="utf-8")
    assert (place / f"{module}.py").exists() and not others
    return place


@pytest.mark.slow
def test_the_template_keeps_the_contract_of_estimators(installed_template):
    paths = os.pathsep.join(filter(None, [str(installed_template), os.environ.get("PYTHONPATH")]))
    tests = ["tests/contract/test_estimators.py", str(installed_template)]
    chosen = f"test_sfm_app_example or (example-msac and ({CONTRACT}))"
    options = ["-q", "-c", "pyproject.toml", "--rootdir", ".", "-p", "no:cacheprovider", "-p", "no:xdist", "-k", chosen]
    environment = {**os.environ, "PYTHONPATH": paths}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, *tests], cwd=ROOT, env=environment, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    # 11 of the contract, one on Linux only, and 6 of its own
    assert int(re.search(r"(\d+) passed", done.stdout)[1]) >= 16
