"""Workflows, image, issue forms and versions agree with the project."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

from benchmarks.anywhere.dockerfile import read_stages

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")


pytestmark = pytest.mark.skipif(not WORKFLOWS, reason="an sdist has no workflows")


def jobs(path):
    return yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"]


def runs(path):
    """Every script of a workflow."""
    return [step["run"] for job in jobs(path).values() for step in job["steps"] if "run" in step]


def test_every_promised_python_is_tested():
    promised = [found[1] for line in PROJECT["classifiers"] if (found := re.fullmatch(r".* :: (3\.\d+)", line))]
    assert len(promised) == 3
    found = jobs(ROOT / ".github" / "workflows" / "tests.yml")
    for job in ("linux", "elsewhere"):
        assert found[job]["strategy"]["matrix"]["python"] == promised
    low, high = re.fullmatch(r">=3\.(\d+),<3\.(\d+)", PROJECT["requires-python"]).groups()
    assert [f"3.{minor}" for minor in range(int(low), int(high))] == promised


def test_promised_systems_are_tested():
    found = jobs(ROOT / ".github" / "workflows" / "tests.yml")
    tested = {found["linux"]["runs-on"], *found["elsewhere"]["strategy"]["matrix"]["system"]}
    assert {name.split("-")[0] for name in tested} == {"ubuntu", "macos", "windows"}


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_what_workflows_run_is_there(path):
    targets = set(re.findall(r"^([a-z-]+):", MAKEFILE, re.MULTILINE))
    called = {name for script in runs(path) for name in re.findall(r"\bmake ([a-z-]+)", script)}
    assert called <= targets
    for script in runs(path):
        assert all((ROOT / name).exists() for name in re.findall(r"tests/unit/\S+", script))


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_may_do_little_and_end(path):
    whole = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert whole["permissions"] == {"contents": "read"}
    assert "concurrency" in whole
    for job in whole["jobs"].values():
        assert 0 < job["timeout-minutes"] <= 90
        used = [step["uses"] for step in job["steps"] if "uses" in step]
        assert all(re.fullmatch(r"[\w-]+/[\w-]+@(v\d+|release/v\d+)", name) for name in used)


def test_one_version():
    version = PROJECT["version"]
    headings = re.findall(r"^## (\d\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert headings[0] == version
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["version"] == version
    minor = int(version.split(".")[1])
    for path in (*ROOT.glob("plugins/*/pyproject.toml"), ROOT / "examples" / "plugin_template" / "pyproject.toml"):
        needed = tomllib.loads(path.read_text(encoding="utf-8"))["project"]["dependencies"]
        assert f"sfm-app>=0.{minor},<0.{minor + 1}" in needed


def test_the_image_copies_what_it_may_and_runs_as_nobody_special():
    build, last = read_stages(ROOT / "docker" / "Dockerfile")
    allowed = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    steps = [step for stage in (build, last) for step in stage.steps]
    from_here = (step for step in steps if step.keyword == "COPY" and not step.option("from"))
    copied = {word for step in from_here for word in step.words()[:-1]}
    assert copied == allowed
    assert all((ROOT / name).exists() for name in copied)
    (user,) = (step.text for step in last.steps if step.keyword == "USER")
    assert re.fullmatch(r"[1-9]\d*:[1-9]\d*", user)


def test_compose_starts_every_role_with_the_kernels_of_the_image():
    services = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text(encoding="utf-8"))["services"]
    entries = [service["entrypoint"] for service in services.values() if "entrypoint" in service]
    steps = read_stages(ROOT / "docker" / "Dockerfile")[-1].steps
    (own,) = (step.words() for step in steps if step.keyword == "ENTRYPOINT")
    assert len(entries) == 2
    assert {entry[0] for entry in entries} == {own[0]}
