"""The part of the viewers' check that needs no browser."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.viewers import command as viewers
from sfm_app.formats.gltf import write_glb
from sfm_app.formats.meshes import write_ply

SILENT = {
    "validator": {"errors": 0, "warnings": 0, "messages": [], "triangles": 5120},
    "three": {
        "triangles": 5120, "points": 0, "textures": 2, "finite": True, "covered": 0.5, "said": [],
        "most": [0xC85A3C, 0x285AC8],
    },
}  # fmt: skip


def subject(model, place):
    for name, data in {**write_glb(model, viewers.SAMPLE), **write_ply(model, viewers.SAMPLE)}.items():
        (place / name).write_bytes(data)
    return viewers.Subject(viewers.SAMPLE, place / "sample.glb", place / "sample.ply")


def test_the_sample_is_as_it_should_be(tmp_path):
    row = viewers.check_model(subject(viewers.sample_model(), tmp_path), SILENT)
    assert row["ok"] == "yes"
    assert (row["Open3D"], row["trimesh"]) == ("5120 triangles + 2 pages", "5120 triangles")
    assert (row["open edges"], row["outward"], row["off center"]) == (0, 1.0, pytest.approx(0, abs=0.02))


STANDING = {
    "up": "camera roll", "up_deviation_deg": 1.0, "up_sign_odds": 900.0, "up_axis_odds": 30.0, "photos_turned_deg": 0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("run", "found", "ok"),
    [
        ("castle", {}, "yes"), ("castle", {"up_deviation_deg": 4.0}, "vertical not sure"),
        ("castle", {"up_sign_odds": 3.0}, "up not sure"), ("castle", {"up_axis_odds": 3.0}, "up not sure"),
        ("castle", {"photos_turned_deg": 180}, "on its head or side"), ("temple16", {"photos_turned_deg": 270}, "yes"),
        ("temple16", {"photos_turned_deg": 90}, "on its head or side"),
    ],
)  # fmt: skip
def test_a_model_stands_upright_when_people_would_turn_its_photos_alike(tmp_path, run, found, ok):
    stands = replace(subject(viewers.sample_model(), tmp_path), orientation=STANDING | found, run=run)
    assert viewers.check_model(stands, SILENT)["ok"] == ok


def changed(**parts):
    model = viewers.sample_model()
    return replace(model, surface=replace(model.surface, **{key: make(model.surface) for key, make in parts.items()}))


@pytest.mark.parametrize(
    ("model", "fault"),
    [
        (changed(faces=lambda surface: surface.faces[:, ::-1]), "normals"),
        (changed(vertices=lambda surface: surface.vertices + np.array([2.0, 0, 0])), "off center"),
        (changed(faces=lambda surface: np.concatenate([surface.faces[:-1], [[0, 0, 1]]])), "degenerate triangles"),
        (changed(faces=lambda surface: np.concatenate([surface.faces[1:], surface.faces[1:2]])), "not manifold"),
    ],
    ids=["inside out", "far away", "a line", "twice"],
)
def test_what_is_wrong_with_a_surface_is_named(tmp_path, model, fault):
    assert fault in viewers.check_model(subject(model, tmp_path), SILENT)["ok"].split("; ")


@pytest.mark.parametrize(
    ("part", "value", "fault"),
    [
        ("validator", {"warnings": 1, "messages": ["ODD"]}, "the validator objects: ODD"),
        ("validator", {"triangles": 5119}, "readers count other triangles"),
        ("three", {"said": ["no texture"]}, "three.js complains"),
        ("three", {"covered": 0.0}, "nothing to see"),
        ("three", {"textures": 1}, "Open3D misses pages"),
        ("three", {"most": [0xC85A3C, 0x000000]}, "other colors"),
    ],
)
def test_what_viewers_do_not_like_is_named(tmp_path, part, value, fault):
    seen = {**SILENT, part: {**SILENT[part], **value}}
    assert viewers.check_model(subject(viewers.sample_model(), tmp_path), seen)["ok"] == fault


def test_normals_that_look_at_no_camera_count(cloud, ball):
    vertices = ball.surface.vertices
    assert viewers.facing_share(vertices, vertices, cloud.cameras) == pytest.approx(0.6, abs=0.15)
    assert viewers.facing_share(vertices, vertices, ()) == 0
