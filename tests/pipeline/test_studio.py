"""Runs of the studio in processes of their own: to the end, interrupted, and refused."""

import asyncio
import json
import shutil
import stat
import zipfile

import cv2
import numpy as np
import pytest
import trimesh

import sfm_app
from sfm_app.studio import jobs as studio_jobs
from sfm_app.studio.jobs import Jobs
from sfm_app.studio.projects import IDLE, PAUSED, QUEUED, RUNNING, Projects

pytestmark = pytest.mark.slow


@pytest.fixture
def jobs(tmp_path):
    return Jobs(Projects(tmp_path / "models"))


@pytest.fixture
def project(jobs, rendered):
    project = jobs.projects.create("court")
    shutil.copytree(rendered[0], project.source)
    project.change("", "quality", "draft")
    return project


def work_until(jobs, happens):
    """Let the queue work until something happens, for two minutes at most; end it as Ctrl-C would."""

    async def work():
        task = asyncio.create_task(jobs.work())
        async with asyncio.timeout(120):
            while not happens():
                await asyncio.sleep(0.02)
        task.cancel()
        await asyncio.wait([task])

    asyncio.run(work())


def test_photos_become_a_model_that_the_command_line_goes_on_with(jobs, project):
    asyncio.run(jobs.check(project))
    result = project.result()
    assert {row["state"] for row in result["photos"]} == {"usable"} and not result["has_view"]
    assert set(result["minutes"]) == {"draft", "normal", "high"}

    views = []
    jobs.start(project)

    def is_done():
        found = project.result()
        views.append((found["has_view"], found["has_model"]))
        return project.wanted == IDLE

    work_until(jobs, is_done)
    assert [*dict.fromkeys(views)] == [(False, False), (True, False), (True, True)]  # the points came first
    placed = [row["name"] for row in project.result()["photos"] if row["state"] == "placed"]
    assert len(placed) == len(project.result()["names"])
    data = json.loads((project.view / "view.json").read_text())
    assert len(data["view"]["cameras"]) == len(placed) and (project.view / "points" / "0").stat().st_size % 15 == 0

    before = (project.out / "model.glb").read_bytes()
    steps = []
    sfm_app.reconstruct(
        project.source, project.out, sfm_app.Settings.from_toml(project.root / "settings.toml"), progress=steps.append
    )
    assert (project.out / "model.glb").read_bytes() == before
    assert all(step.label == "up to date" for step in steps if step.stage and not step.total)

    pictures = sorted(path.name for path in (project.view / "depths").iterdir())
    assert len(pictures) == jobs.progress["court"].depths > 0 and pictures[0] == "0.jpg"

    exported = asyncio.run(jobs.export(project, "obj", None))
    with zipfile.ZipFile(project.exports / exported["file"]) as archive:
        assert {name.rpartition(".")[2] for name in archive.namelist()} == {"obj", "mtl", "jpg"}
    part = asyncio.run(jobs.export(project, "ply", [[-0.2, -9, -9], [9, 9, 9]]))
    assert min(trimesh.load(project.exports / part["file"]).vertices[:, 0]) >= -0.2
    refused = asyncio.run(jobs.export(jobs.projects.create("empty"), "obj", None))
    assert refused["end"] == "failed" and refused["hint"]


def test_a_killed_studio_goes_on_and_a_paused_run_waits(jobs, project):
    jobs.start(project)
    work_until(jobs, lambda: jobs.progress.get("court") and jobs.progress["court"].stage == "match_graph")
    assert project.wanted == RUNNING  # as after a kill: nobody has said otherwise

    again = Jobs(jobs.projects)
    work_until(again, lambda: again.progress.get("court") and again.progress["court"].stage == "view_graph")
    again.stop(project, PAUSED)
    after = Jobs(jobs.projects)
    work_until(after, lambda: True)
    assert project.wanted == PAUSED and not after.progress
    after.start(project)
    assert project.wanted == QUEUED
    stages = json.loads((project.out / "manifest.json").read_text())["stages"]
    assert "match_graph" in stages


def test_a_run_that_is_stopped_before_its_process_starts_does_not_run(jobs, project):
    jobs.start(project)

    def stop():
        if project.wanted != RUNNING:
            return False
        jobs.stop(project, PAUSED)
        return True

    work_until(jobs, stop)
    work_until(Jobs(jobs.projects), lambda: True)
    assert project.wanted == PAUSED and not (project.out / "manifest.json").exists()


def test_photos_of_an_archive_have_their_states_and_pictures(jobs, project):
    photos = sorted(project.source.iterdir())
    with zipfile.ZipFile(project.source / "rest.zip", "w") as archive:
        for photo in photos[3:]:
            archive.write(photo, photo.name)
            photo.unlink()
    asyncio.run(jobs.check(project))
    (project.source / "late.jpg").write_bytes(b"a photo")
    rows = {row["name"]: (row["state"], row.get("number")) for row in project.rows()}
    assert rows.pop("rest.zip")[0] == "read" and rows.pop("late.jpg")[0] == "new"
    assert {state for state, _ in rows.values()} == {"usable"} and len(rows) == len(photos)
    names = project.result()["names"]
    for photo in photos[3:]:
        assert names[rows[f"rest.zip: {photo.name}"][1]] == f"rest/{photo.name}"


def test_frames_of_a_video_have_their_states_and_pictures(jobs):
    project = jobs.projects.create("film")
    project.source.mkdir()
    writer = cv2.VideoWriter(str(project.source / "film.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 5.0, (320, 240))
    texture = cv2.resize(np.random.default_rng(0).integers(0, 255, (60, 120, 3), np.uint8), (960, 480))
    for shift in range(0, 600, 30):
        writer.write(texture[100:340, shift : shift + 320])
    writer.release()
    asyncio.run(jobs.check(project))
    rows = {row["name"]: row for row in project.rows()}
    assert rows.pop("film.avi")["state"] == "read" and len(rows) > 1
    assert {(row["file"], row["can_mask"]) for row in rows.values()} == {("film.avi", False)}
    assert {project.result()["names"][row["number"]] for row in rows.values() if row["state"] == "usable"} <= set(rows)


def test_checks_that_wait_are_one(jobs, project):
    seen = []

    async def count(follow, job, project, *rest):
        seen.append(job)
        await asyncio.sleep(0.05)

    async def ask_often():
        await asyncio.gather(*(jobs.check(project) for _ in range(20)))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(studio_jobs, "_work", count)
        asyncio.run(ask_often())
    assert seen == ["check", "check"]  # the one at work, and one for all that came later


def bomb(archive):
    archive.writestr("a.jpg", bytes(10**6), zipfile.ZIP_DEFLATED)


def link(archive):
    info = zipfile.ZipInfo("a.jpg")
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    archive.writestr(info, "/etc/passwd")


@pytest.mark.parametrize(
    ("fill", "words"),
    [
        (bomb, "would unpack to"),
        (link, "no usable photo"),
        (lambda archive: archive.writestr("../a.jpg", b"x"), "leads out of it"),
    ],
)
def test_dangerous_archives_are_refused_with_a_reason(jobs, fill, words):
    project = jobs.projects.create("trap")
    project.source.mkdir()
    with zipfile.ZipFile(project.source / "x.zip", "w") as archive:
        fill(archive)
    asyncio.run(jobs.check(project))
    assert words in jobs.progress["trap"].failure and jobs.progress["trap"].hint
    assert not any(b"root:" in path.read_bytes() for path in project.root.rglob("*") if path.is_file())


def test_a_process_that_crashes_is_a_failure_of_its_project_alone(jobs):
    project = jobs.projects.create("broken")
    (project.root / "settings.toml").write_text("quality = [")
    asyncio.run(jobs.check(project))
    assert "settings.toml cannot be read" in jobs.progress["broken"].failure
