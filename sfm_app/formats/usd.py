"""USD, which Pixar's tools, Blender, Houdini and Apple's Quick Look open, alone or packed as USDZ; needs usd-core.

A stage is y-up and in meters. The texture is the diffuse color of a rough surface, since USD has no unlit material that
all viewers know.
"""

import io
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sfm_app.formats.exporters import check_writable, normal_file, page_files, page_pictures
from sfm_app.formats.frusta import frustum_depth
from sfm_app.formats.gltf import linear_colors, opengl_pose
from sfm_app.geometry.triangles import unit_normals
from sfm_app.types import Model, PosedPhoto, Surface, Texture

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom

ROOT = "/model"
FILM_MM = 36.0
"""Width of 35 mm film in millimeters, by which USD states a field of view. By definition."""


def write_usd(model: Model, name: str) -> Mapping[str, bytes]:
    """Write triangles with a texture or a color per vertex, or points; and the cameras: the stage, a JPEG per page."""
    check_writable(model)
    pages = page_files(model, name)
    with tempfile.TemporaryDirectory(prefix="sfm-app-") as scratch:
        path = Path(scratch) / "model.usdc"
        _write_stage(path, model, pages)
        pictures = page_pictures(model.texture, pages) if model.texture is not None else {}
        return {f"{name}.usd": path.read_bytes(), **pictures}


def write_usdz(model: Model, name: str) -> Mapping[str, bytes]:
    """Write the files of `write_usd` into one uncompressed package."""
    stage, *pages = write_usd(model, "model").items()
    return {f"{name}.usdz": pack({"model.usdc": stage[1], **dict(pages)})}


def pack(files: Mapping[str, bytes]) -> bytes:
    """Return a USDZ package: an uncompressed ZIP of aligned files, the stage first."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as package:
        for name, data in files.items():
            start = stream.tell() + 30 + len(name.encode()) + 4  # after the headers of entry and padding
            gap = -start % 64  # USDZ specification
            entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))  # ZIP's first date: same model, same bytes
            entry.extra = (0x1986).to_bytes(2, "little") + gap.to_bytes(2, "little") + bytes(gap)  # as USD's packer
            package.writestr(entry, data)
    return stream.getvalue()


def _write_stage(path: Path, model: Model, pages: Mapping[int, str]) -> None:
    """Write a stage. Nothing refers to it after this function, so that the file is closed and can be removed."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(path))
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, ROOT).GetPrim())
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    if len(model.surface.faces):
        mesh = add_mesh(stage, model.surface)
        if pages and model.texture is not None:
            add_texture(stage, mesh, model.texture, pages)
    else:
        add_points(stage, model)
    add_cameras(stage, model)
    stage.GetRootLayer().Save()


def add_mesh(stage: "Usd.Stage", surface: Surface) -> "UsdGeom.Mesh":
    """Add triangles with normals and a color per vertex."""
    from pxr import UsdGeom, Vt

    mesh = UsdGeom.Mesh.Define(stage, f"{ROOT}/surface")
    mesh.CreatePointsAttr(_vectors(surface.vertices))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(surface.faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(surface.faces.astype(np.int32).ravel()))
    mesh.CreateNormalsAttr(_vectors(unit_normals(surface)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateExtentAttr(_vectors(np.stack([surface.vertices.min(axis=0), surface.vertices.max(axis=0)])))
    mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(_vectors(linear_colors(surface.colors)))
    return mesh


def add_texture(stage: "Usd.Stage", mesh: "UsdGeom.Mesh", texture: Texture, pages: Mapping[int, str]) -> None:
    """Add texture coordinates, and a material for the triangles of each page."""
    from pxr import Sdf, UsdGeom, UsdShade, Vt

    places = texture.uv.reshape(-1, 2).astype(np.float32) * (1.0, -1.0) + (0.0, 1.0)  # 0 is at the bottom in USD
    kind, name = Sdf.ValueTypeNames.TexCoord2fArray, "st"
    coordinates = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(name, kind, UsdGeom.Tokens.faceVarying)
    coordinates.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(places, np.float32)))
    for page, file in pages.items():
        material = _page_material(stage, f"{ROOT}/materials/page_{page}", file)
        if texture.normal_maps:
            _add_normal_map(material, normal_file(file))
        faces = Vt.IntArray.FromNumpy(np.flatnonzero(texture.page == page).astype(np.int32))
        part = UsdGeom.Subset.CreateGeomSubset(mesh, f"page_{page}", UsdGeom.Tokens.face, faces, "materialBind")
        UsdShade.MaterialBindingAPI.Apply(part.GetPrim()).Bind(material)
    UsdGeom.Subset.SetFamilyType(mesh, "materialBind", UsdGeom.Tokens.partition)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim())


def _page_material(stage: "Usd.Stage", path: str, file: str) -> "UsdShade.Material":  # type: ignore[name-defined]  # noqa: F821
    from pxr import Sdf, UsdShade

    types = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, path)
    surface, picture, reader = (
        UsdShade.Shader.Define(stage, f"{path}/{part}") for part in ("surface", "picture", "coordinates")
    )
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    picture.CreateIdAttr("UsdUVTexture")
    picture.CreateInput("file", types.Asset).Set(Sdf.AssetPath(f"./{file}"))
    picture.CreateInput("sourceColorSpace", types.Token).Set("sRGB")
    for wrap in ("wrapS", "wrapT"):
        picture.CreateInput(wrap, types.Token).Set("clamp")
    places = reader.CreateOutput("result", types.Float2)
    picture.CreateInput("st", types.Float2).ConnectToSource(places)
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", types.Float).Set(1.0)
    surface.CreateInput("metallic", types.Float).Set(0.0)
    color = picture.CreateOutput("rgb", types.Float3)
    surface.CreateInput("diffuseColor", types.Color3f).ConnectToSource(color)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    return material


def _add_normal_map(material: "UsdShade.Material", file: str) -> None:  # type: ignore[name-defined]  # noqa: F821
    """Add a normal map to a material; its texels count from 0 to 1, normals from -1 to 1."""
    from pxr import Gf, Sdf, UsdShade

    types, stage, path = Sdf.ValueTypeNames, material.GetPrim().GetStage(), material.GetPath()
    reader, surface = (UsdShade.Shader.Get(stage, path.AppendChild(part)) for part in ("coordinates", "surface"))
    picture = UsdShade.Shader.Define(stage, path.AppendChild("normals"))
    picture.CreateIdAttr("UsdUVTexture")
    picture.CreateInput("file", types.Asset).Set(Sdf.AssetPath(f"./{file}"))
    picture.CreateInput("sourceColorSpace", types.Token).Set("raw")
    picture.CreateInput("scale", types.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
    picture.CreateInput("bias", types.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
    for wrap in ("wrapS", "wrapT"):
        picture.CreateInput(wrap, types.Token).Set("clamp")
    picture.CreateInput("st", types.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    surface.CreateInput("normal", types.Normal3f).ConnectToSource(picture.CreateOutput("rgb", types.Float3))


def add_points(stage: "Usd.Stage", model: Model) -> None:
    """Add colored points."""
    from pxr import UsdGeom, Vt

    surface = model.surface
    points = UsdGeom.Points.Define(stage, f"{ROOT}/points")
    points.CreatePointsAttr(_vectors(surface.vertices))
    centers = np.array([camera.center for camera in model.cameras] or [np.zeros(3)])
    width = 2e-3 * frustum_depth(centers, surface.vertices)  # by hand
    points.CreateWidthsAttr(Vt.FloatArray([width]))
    points.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    points.CreateExtentAttr(_vectors(np.stack([surface.vertices.min(axis=0), surface.vertices.max(axis=0)])))
    points.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(_vectors(linear_colors(surface.colors)))


def add_cameras(stage: "Usd.Stage", model: Model) -> None:
    """Add a camera with its principal point for every photo."""
    from pxr import Gf, UsdGeom

    for number, camera in enumerate(model.cameras):
        film = film_of(camera)
        lens = UsdGeom.Camera.Define(stage, f"{ROOT}/cameras/photo_{number + 1}")
        lens.GetPrim().SetCustomDataByKey("photo", camera.name)
        lens.CreateProjectionAttr(UsdGeom.Tokens.perspective)
        lens.CreateFocalLengthAttr(film["focal"])
        lens.CreateHorizontalApertureAttr(film["width"])
        lens.CreateVerticalApertureAttr(film["height"])
        lens.CreateHorizontalApertureOffsetAttr(film["right"])
        lens.CreateVerticalApertureOffsetAttr(film["up"])
        matrix = opengl_pose(camera).T  # USD multiplies rows
        UsdGeom.Xformable(lens).AddTransformOp().Set(Gf.Matrix4d(matrix.tolist()))


def film_of(camera: PosedPhoto) -> dict[str, float]:
    """Return the film of a camera in millimeters: focal, width, height, and its middle's offset right and up."""
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    focal = FILM_MM * fx / camera.width
    right, up = focal * (camera.width / 2 - cx) / fx, focal * (cy - camera.height / 2) / fy
    return {"focal": focal, "width": FILM_MM, "height": focal * camera.height / fy, "right": right, "up": up}


def _vectors(values: NDArray[np.generic]) -> "Vt.Vec3fArray":  # type: ignore[name-defined]  # noqa: F821
    from pxr import Vt

    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))
