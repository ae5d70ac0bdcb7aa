"""File formats for models and whole scenes, offered like plug-ins.

A new built-in format is a writing function in a module of this package, and a row of `_MODELS` or `_SCENES` below.
"""

from functools import partial

from sfm_app.formats.draco import write_draco
from sfm_app.formats.exporters import CLOUD, Exporter, SceneExporter, missing_package
from sfm_app.formats.gltf import write_glb, write_gltf
from sfm_app.formats.meshes import write_cloud_ply, write_las, write_obj, write_ply, write_stl
from sfm_app.formats.scenes import write_bundler, write_cameras, write_colmap, write_nerfstudio, write_opencv
from sfm_app.formats.usd import write_usd, write_usdz

_no_usd = partial(missing_package, "usd-core", "pxr")
_no_draco = partial(missing_package, "DracoPy", "DracoPy")
_no_laz = partial(missing_package, "laspy[lazrs]", "lazrs")

_MODELS = (
    Exporter("ply", write_ply, "ply", "binary PLY, colors and normals per vertex; MeshLab, CloudCompare, Blender"),
    Exporter("glb", write_glb, "glb", "binary glTF 2.0, textured, all in one file; web viewers, game engines, Blender"),
    Exporter("gltf", write_gltf, "gltf", "the same as JSON, with arrays and pictures in a file beside it"),
    Exporter("obj", write_obj, "obj", "Wavefront OBJ with MTL and JPEG pages, textured; everything else"),
    Exporter(
        "stl",
        write_stl,
        "stl",
        "binary STL in millimeters, z up, no colors; programs for 3D printers",
        holds_points=False,
    ),
    Exporter("draco", write_draco, "glb", "GLB compressed by Draco, a quarter of the size; web viewers", _no_draco),
    Exporter("usdz", write_usdz, "usdz", "USD and its texture in one file; Apple's Quick Look, Blender", _no_usd),
    Exporter("usd", write_usd, "usd", "binary USD with JPEG pages; Blender, Houdini, Omniverse", _no_usd),
)
_SCENES = (
    SceneExporter("colmap", write_colmap, "folder images/, sparse/0: undistorted photos, COLMAP's binary model"),
    SceneExporter(
        "openmvs", partial(write_colmap, place="sparse"), "the same with the model in sparse/; OpenMVS, trainers"
    ),
    SceneExporter("colmap-text", partial(write_colmap, text=True), "the same with COLMAP's model as text"),
    SceneExporter(
        "splat",
        partial(write_colmap, centered=True),
        "as colmap, optical centers in the middle, which some splat trainers expect",
    ),
    SceneExporter("nerfstudio", write_nerfstudio, "folder with transforms.json, images/ and the points; nerfstudio"),
    SceneExporter(
        "bundler", write_bundler, "folder with bundle.out, list.txt and photos as in splat, by COLMAP's writer"
    ),
    SceneExporter(
        "cameras", write_cameras, "JSON: K, lens and standard deviations, pose of each photo", "cameras.json"
    ),
    SceneExporter("opencv", write_opencv, "folder with a YAML file per camera, with its photos' poses, for OpenCV"),
    SceneExporter("cloud-ply", write_cloud_ply, "the dense cloud as PLY; CloudCompare, MeshLab", "cloud.ply", CLOUD),
    SceneExporter("las", write_las, "the dense cloud as LAS; PDAL, QGIS", "cloud.las", CLOUD, _no_laz),
    SceneExporter("laz", partial(write_las, compressed=True), "the same, compressed", "cloud.laz", CLOUD, _no_laz),
)
EXPORTERS = {exporter.name: exporter for exporter in _MODELS}
SCENE_EXPORTERS = {exporter.name: exporter for exporter in _SCENES}

__all__ = ["EXPORTERS", "SCENE_EXPORTERS"]
