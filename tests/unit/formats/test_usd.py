"""USD as pxr, its own library, reads it."""

import io
import zipfile

import numpy as np
import pytest
from PIL import Image
from pxr import Ar, Gf, Usd, UsdGeom, UsdShade

from sfm_app.camera.models import camera_matrix
from sfm_app.formats.usd import write_usd, write_usdz
from sfm_app.types import Model, PosedPhoto


def open_stage(files, folder):
    """Write the files and open the first; the stage is kept alive by the caller."""
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return Usd.Stage.Open(str(folder / next(iter(files))))


def bounds(stage):
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeWorldBound(stage.GetDefaultPrim())
    found = box.ComputeAlignedRange()
    return np.array([found.GetMin(), found.GetMax()])


@pytest.mark.parametrize("write", [write_usd, write_usdz])
def test_a_stage_stands_upright_in_meters_and_has_the_model_s_bounds(textured_ball, write, tmp_path):
    stage = open_stage(write(textured_ball, "a ball"), tmp_path)
    vertices = textured_ball.surface.vertices
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    np.testing.assert_allclose(bounds(stage), [vertices.min(axis=0), vertices.max(axis=0)], rtol=1e-6, atol=1e-7)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/model/surface"))
    np.testing.assert_allclose(np.array(mesh.GetPointsAttr().Get()), vertices, rtol=1e-6, atol=1e-7)
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    np.testing.assert_array_equal(faces, textured_ball.surface.faces)
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none"


@pytest.mark.parametrize("write", [write_usd, write_usdz])
def test_every_triangle_has_the_picture_and_the_place_of_its_texture(textured_ball, write, tmp_path):
    stage = open_stage(write(textured_ball, "ball"), tmp_path)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/model/surface"))
    places = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get()).reshape(-1, 3, 2)

    parts = UsdShade.MaterialBindingAPI(mesh.GetPrim()).GetMaterialBindSubsets()
    covered = []
    for part in parts:
        material = UsdShade.MaterialBindingAPI(part.GetPrim()).ComputeBoundMaterial()[0]
        shader = material.ComputeSurfaceSource()[0]
        picture = UsdShade.Shader(shader.GetInput("diffuseColor").GetConnectedSource()[0].GetPrim())
        asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(picture.GetInput("file").Get().resolvedPath))
        pixels = np.asarray(Image.open(io.BytesIO(bytes(asset.GetBuffer()))))
        faces = np.array(part.GetIndicesAttr().Get())
        covered += faces.tolist()
        true = textured_ball.texture.pages[textured_ball.texture.page[faces[0]]]
        assert pixels.shape == true.shape and np.abs(pixels.astype(int) - true).max() <= 3
        assert set(textured_ball.texture.page[faces]) == {textured_ball.texture.page[faces[0]]}
    assert len(parts) == 2 and sorted(covered) == list(range(len(places)))
    # 0 is at the bottom in USD, at the top here
    np.testing.assert_allclose(places, textured_ball.texture.uv * (1, -1) + (0, 1), atol=1e-6)


@pytest.mark.parametrize("write", [write_usd, write_usdz])
def test_a_normal_map_is_read_raw_and_counts_from_minus_1_to_1(lit_ball, write, tmp_path):
    stage = open_stage(write(lit_ball, "ball"), tmp_path)
    for number, relief in enumerate(lit_ball.texture.normal_maps):
        shader = UsdShade.Material(stage.GetPrimAtPath(f"/model/materials/page_{number}")).ComputeSurfaceSource()[0]
        picture = UsdShade.Shader(shader.GetInput("normal").GetConnectedSource()[0].GetPrim())
        asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(picture.GetInput("file").Get().resolvedPath))
        pixels = np.asarray(Image.open(io.BytesIO(bytes(asset.GetBuffer()))))
        np.testing.assert_allclose(pixels, relief, atol=4)
        assert picture.GetInput("sourceColorSpace").Get() == "raw"
        assert picture.GetInput("scale").Get() == Gf.Vec4f(2, 2, 2, 1)
        assert picture.GetInput("bias").Get() == Gf.Vec4f(-1, -1, -1, 0)
        assert picture.GetInput("st").HasConnectedSource()


def test_files_in_a_package_are_plain_and_aligned(textured_ball):
    data = write_usdz(textured_ball, "ball")["ball.usdz"]
    with zipfile.ZipFile(io.BytesIO(data)) as package:
        assert package.testzip() is None
        entries = package.infolist()
    assert [entry.filename for entry in entries] == ["model.usdc", "model_0.jpg", "model_1.jpg"]
    for entry in entries:
        assert entry.compress_type == zipfile.ZIP_STORED
        head = data[entry.header_offset :]
        start = entry.header_offset + 30 + int.from_bytes(head[26:28], "little") + int.from_bytes(head[28:30], "little")
        assert start % 64 == 0 and data[start:].startswith((b"PXR-USDC", b"\xff\xd8"))


def test_a_camera_shows_points_where_the_photo_does(cloud, tmp_path):
    K = camera_matrix(800.0, 820.0, 290.0, 255.0)
    cameras = tuple(PosedPhoto(f"sub/ä {c.name}", K, c.cam_from_world, 640, 480) for c in cloud.cameras)
    stage = open_stage(write_usd(Model(cloud.surface, cameras=cameras), "points"), tmp_path)

    points = UsdGeom.Points(stage.GetPrimAtPath("/model/points"))
    np.testing.assert_allclose(np.array(points.GetPointsAttr().Get()), cloud.surface.vertices, atol=1e-6)
    assert 1e-4 < points.GetWidthsAttr().Get()[0] < 0.1
    for number, camera in enumerate(cameras, start=1):
        prim = stage.GetPrimAtPath(f"/model/cameras/photo_{number}")
        assert prim.GetCustomDataByKey("photo") == camera.name
        frustum = UsdGeom.Camera(prim).GetCamera(Usd.TimeCode.Default()).frustum
        project = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        for X in cloud.surface.vertices[::10]:
            at = camera.cam_from_world[:, :3] @ X + camera.cam_from_world[:, 3]
            x = (K @ at)[:2] / at[2]
            found = project.Transform(Gf.Vec3d(*X))
            pixel = 320 * (1 + found[0]), 240 * (1 - found[1])
            np.testing.assert_allclose(pixel, x, atol=1e-3)  # USD states the film in single precision


def test_colors_without_a_texture_are_linear(ball, tmp_path):
    stage = open_stage(write_usd(ball, "ball"), tmp_path)
    colors = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/model/surface")).GetDisplayColorPrimvar().Get())
    shown = np.where(colors <= 0.0031308, 12.92 * colors, 1.055 * colors ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(255 * shown, ball.surface.colors, atol=0.01)
