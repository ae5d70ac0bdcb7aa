"""Steps of Dockerfiles, Pythons and platforms, as `benchmarks.anywhere` reads them."""

import sys

import pytest

from benchmarks.anywhere import image as image_command
from benchmarks.anywhere import wheels
from benchmarks.anywhere.dockerfile import read_stages
from benchmarks.anywhere.pythons import find_pythons, minor_versions

FILE = """
# a comment
FROM debian:trixie-slim AS build
RUN apt-get update \\
    && echo "$(date)" \\
    # a comment inside
    && true
ENV A=1 PATH=/opt/bin:$PATH
FROM debian:trixie-slim
COPY --from=build /opt /opt
ENTRYPOINT ["one", "two words"]
"""


def test_steps_are_read(tmp_path):
    path = tmp_path / "Dockerfile"
    path.write_text(FILE)
    build, last = read_stages(path)
    assert (build.base, build.name) == ("debian:trixie-slim", "build")
    assert [step.keyword for step in build.steps] == ["RUN", "ENV"]
    assert build.steps[0].text == 'apt-get update && echo "$(date)" && true'
    assert build.steps[1].assignments() == {"A": "1", "PATH": "/opt/bin:$PATH"}
    assert last.steps[0].option("from") == "build" and last.steps[0].words() == ["/opt", "/opt"]
    assert last.steps[1].words() == ["one", "two words"]


@pytest.mark.parametrize("line", ["ADD a b", "COPY $(ls) b"])
def test_a_step_that_is_not_understood_is_an_error(line, tmp_path):
    path = tmp_path / "Dockerfile"
    path.write_text(f"FROM debian:trixie-slim\n{line}\n")
    with pytest.raises(ValueError, match="not understood"):
        read_stages(path)


def test_what_is_wrong_with_an_image_is_said(tmp_path):
    good = {"MB": 1600, "exit code": 0, "lines": 24, "files of others": 0}
    assert image_command.problems(good, tmp_path) == ["no model.glb"]
    (tmp_path / "model.glb").touch()
    assert image_command.problems(good, tmp_path) == []
    bad = {"MB": 1601, "exit code": 2, "lines": 25, "files of others": 1}
    assert len(image_command.problems(bad, tmp_path)) == 4


def test_a_python_that_does_not_start_is_missing(tmp_path):
    broken = tmp_path / "python"
    broken.write_text("#!/bin/sh\nexit 127\n")
    broken.chmod(0o755)
    assert find_pythons([str(broken), str(tmp_path / "none"), sys.executable]) == {
        f"{sys.version_info.major}.{sys.version_info.minor}": sys.executable
    }
    assert minor_versions() == ["3.11", "3.12", "3.13"]


def test_what_is_needed_depends_on_the_platform():
    found = {}
    for system, processor in (("linux", "x86_64"), ("darwin", "arm64")):
        found[system] = {"sfm-app": set()}
        wheels.needed("sfm-app", wheels.markers("3.12", system, processor), found[system])
    assert {"open3d-cpu", "numpy", "contourpy"} <= set(found["linux"]) and "open3d" not in found["linux"]
    assert {"open3d", "numpy", "dash"} <= set(found["darwin"]) and "open3d-cpu" not in found["darwin"]
