"""A rendered walk with a camera that films: chosen frames are placed, and a run in a moved folder goes on."""

import json

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from sfm_app.cli.program import main
from sfm_app.synthetic.cameras import look_at, make_camera
from sfm_app.synthetic.photo_folder import PhotoOptions, develop
from sfm_app.synthetic.render import prepare, render_scene
from sfm_app.synthetic.scenes import courtyard

SIZE = 320, 240
FRAMES = 28


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Every seventh frame is blurred; the last four show the same."""
    path = tmp_path_factory.mktemp("video") / "clip.avi"
    camera, scene, options = make_camera(*SIZE), prepare(courtyard()), PhotoOptions(supersampling=1)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"MJPG"), 30.0, SIZE)
    for k in range(FRAMES):
        if k < FRAMES - 3:
            u = k / (FRAMES - 4)
            turn, distance, height = np.radians(44.0 * (u - 0.5)), 5.4 + 0.8 * np.sin(5 * u), 1.6 + 0.8 * np.sin(7 * u)
            center = np.array([distance * np.sin(turn), height, distance * np.cos(turn)])
            aim = np.array([0.3 * np.sin(4 * u), 1.3 + 0.3 * np.cos(6 * u), -0.2])
            image = render_scene(scene, camera, look_at(center, aim, 10 * np.sin(3 * u)), 1)
        picture = develop(image, options, np.random.default_rng(k))
        if k % 7 == 3:
            picture = cv2.GaussianBlur(picture, (0, 0), 2.5)
        writer.write(np.ascontiguousarray(picture[..., ::-1]))
    writer.release()
    return path


def call(*arguments):
    return CliRunner().invoke(main, [*map(str, arguments), "--workers", "2", "-q"])


def test_a_video_becomes_cameras_and_points(clip, tmp_path):
    command = ("run", clip, "-o", tmp_path / "out", "--quality", "draft", "--until", "scene")
    result = call(*command, "--json")

    assert result.exit_code == 0, result.stderr
    assert result.stderr == ""
    found = json.loads(result.stdout)
    chosen = [int(path.stem.removeprefix("clip_")) for path in sorted((tmp_path / "out" / "frames").iterdir())]
    assert found["video"]["frames"] == FRAMES
    assert found["video"]["chosen"] == found["photos"]["usable"] == len(chosen) and 6 <= len(chosen) <= 12
    assert not [number for number in chosen if number % 7 == 3]
    assert len(set(chosen) & set(range(FRAMES - 4, FRAMES))) <= 1
    assert found["scene"]["registered"] == len(chosen)
    (camera,) = found["scene"]["cameras"].values()
    assert camera["K"][0][0] == pytest.approx(make_camera(*SIZE).K[0, 0], rel=0.03)

    (tmp_path / "out").rename(tmp_path / "moved")
    photos = list((tmp_path / "moved" / "photos").iterdir())
    assert len(photos) == len(chosen) and all(path.exists() for path in photos)
    photos[0].unlink()
    (tmp_path / "moved" / "frames" / photos[1].name).unlink()  # the stage is done again
    again = call("run", clip, "-o", tmp_path / "moved", "--until", "match_graph")

    assert again.exit_code == 0, again.stderr
    assert f"video       {FRAMES} frames, {len(chosen)} chosen" in again.stdout
    assert all(path.exists() for path in photos)
    fewer = json.loads(
        call("run", clip, "-o", tmp_path / "moved", "--until", "photos", "--max-frames", 3, "--json").stdout
    )
    assert fewer["video"]["chosen"] == len(list((tmp_path / "moved" / "frames").iterdir())) == 3
