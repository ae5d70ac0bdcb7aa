"""Every form of a calibration file is recognized by its content, and gives COLMAP's own rays."""

import contextlib
import json
import struct

import cv2
import numpy as np
import pytest
from hypothesis import given as given_values
from hypothesis import settings
from hypothesis import strategies as st

from sfm_app.camera.bearings import bearings
from sfm_app.camera.models import PARAMETERS, calibration_from_model
from sfm_app.camera.projection import RAY
from sfm_app.camera_files import MODEL_IDS, read_given_cameras
from sfm_app.colmap.backend import pycolmap
from sfm_app.errors import InputError
from sfm_app.formats.scenes import transforms
from sfm_app.types import Calibration, CameraModel, Intrinsics
from sfm_app.types.scene import PerspectivePhoto

WIDTH, HEIGHT = 1000, 800
OPENCV = [900.0, 910.0, 510.0, 390.0, -0.1, 0.02, 0.001, -0.002]
FISHEYE = [400.0, 410.0, 510.0, 390.0, -0.02, 0.01, -0.001, 0.002]
K = [[900.0, 0.0, 509.5], [0.0, 910.0, 389.5], [0.0, 0.0, 1.0]]
PIXELS = np.random.default_rng(0).uniform((60, 40), (WIDTH - 60, HEIGHT - 40), (200, 2))
"""COLMAP sees nothing behind the camera."""


def given(path, data):
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return read_given_cameras(path)


def only(path, data):
    [camera] = given(path, data).cameras.values()
    assert camera.method == "given" and camera.identifiable
    return camera


def same_rays(camera, model, params, tolerance=1e-8):
    """Whether a camera sees what COLMAP's camera of this model sees."""
    theirs = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params)
    rays = bearings(PIXELS, camera)[:, RAY]
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return np.abs(rays - np.asarray(theirs.cam_ray_from_img(PIXELS))).max() < tolerance


def test_models_and_their_numbers_are_those_of_colmap():
    for number, name in MODEL_IDS.items():
        assert int(pycolmap.CameraModelId.__members__[name]) == number
        camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId.__members__[name], 50.0, 100, 80)
        theirs = [word.strip() for word in camera.params_info.split(",")]
        assert ["k1" if word == "k" else word for word in theirs] == list(PARAMETERS[name])
    assert set(MODEL_IDS.values()) == set(PARAMETERS)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_PINHOLE", [900.0, 510.0, 390.0]), ("PINHOLE", [900.0, 910.0, 510.0, 390.0]),
        ("SIMPLE_RADIAL", [900.0, 510.0, 390.0, -0.1]), ("RADIAL", [900.0, 510.0, 390.0, -0.1, 0.02]),
        ("OPENCV", OPENCV), ("FULL_OPENCV", [*OPENCV, 0.01, 0.02, -0.01, 0.01]),
        ("SIMPLE_RADIAL_FISHEYE", [400.0, 510.0, 390.0, -0.02]), ("OPENCV_FISHEYE", FISHEYE),
        ("THIN_PRISM_FISHEYE", [400.0, 400.0, 510.0, 390.0, -0.02, 0.01, 0.001, -0.002, 0.01, 0.02, 0.001, -0.001]),
    ],
)  # fmt: skip
def test_colmap_text_and_binary(tmp_path, model, params):
    text = f"# Camera list\n7 {model} {WIDTH} {HEIGHT} {' '.join(map(str, params))}\n"
    number = next(number for number, name in MODEL_IDS.items() if name == model)
    data = struct.pack(f"<QIiQQ{len(params)}d", 1, 7, number, WIDTH, HEIGHT, *params)
    for camera in (only(tmp_path / "cameras.txt", text), only(tmp_path / "cameras.bin", data)):
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        assert same_rays(camera, model, params)


@pytest.mark.parametrize("binary", [False, True])
def test_a_folder_of_colmap_says_which_photo_has_which_camera(tmp_path, binary):
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 2, 1, 3, 20
    model = pycolmap.synthesize_dataset(options)
    for camera in model.cameras.values():
        camera.params = [900.0 + camera.camera_id, *camera.params[1:]]
    (model.write_binary if binary else model.write_text)(tmp_path)
    found = read_given_cameras(tmp_path)
    assert {name: camera.K[0, 0] for name, camera in found.cameras.items()} == {"1": 901.0, "2": 902.0}
    assert found.camera_of == {image.name: str(image.camera_id) for image in model.images.values()}
    assert len(found.digest) > 10 and "COLMAP" in found.source


@pytest.mark.parametrize(
    "values",
    [
        {"camera_matrix": K, "dist_coeffs": [OPENCV[4:]], "width": WIDTH, "height": HEIGHT},
        {"K": K, "distortion_coefficients": OPENCV[4:], "image_size": [WIDTH, HEIGHT]},
        {
            "image_width": WIDTH, "image_height": HEIGHT, "distortion_model": "plumb_bob",
            "camera_matrix": {"rows": 3, "cols": 3, "data": np.ravel(K).tolist()},
            "distortion_coefficients": {"rows": 1, "cols": 5, "data": [*OPENCV[4:], 0.0]},
        },
    ],
)  # fmt: skip
def test_json_of_opencv_counts_pixels_from_their_centers(tmp_path, values):
    camera = only(tmp_path / "cameras.json", json.dumps(values))
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    assert same_rays(camera, "OPENCV", OPENCV)


def test_a_size_may_be_missing_and_a_fisheye_needs_to_be_called_one(tmp_path):
    values = {"mtx": [[400, 0, 509.5], [0, 410, 389.5], [0, 0, 1]], "dist": FISHEYE[4:], "model": "fisheye"}
    camera = only(tmp_path / "fisheye.json", json.dumps(values))
    assert (camera.width, camera.height, camera.projection) == (0, 0, "fisheye")
    assert same_rays(camera, "OPENCV_FISHEYE", FISHEYE)
    assert only(tmp_path / "plain.json", json.dumps(values | {"model": "pinhole"})).projection == "perspective"


@pytest.mark.parametrize("suffix", ["yml", "xml"])
def test_what_opencv_writes_itself(tmp_path, suffix):
    path = tmp_path / f"camera.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", WIDTH), ("image_height", HEIGHT), ("flags", 0), ("grid", "a b")):
        storage.write(name, value)
    storage.write("camera_matrix", np.array(K))
    storage.write("distortion_coefficients", np.array([*OPENCV[4:], 0.0]))
    storage.release()
    assert same_rays(only(path, path.read_bytes()), "OPENCV", OPENCV)


@pytest.mark.parametrize(
    ("kind", "terms", "model", "params"),
    [
        ("perspective", {"focal": 0.9, "k1": -0.1, "k2": 0.02}, "RADIAL", [900.0, 500.0, 400.0, -0.1, 0.02]),
        ("brown", {"focal_x": 0.9, "focal_y": 0.91, "c_x": 0.01, "c_y": -0.01, "k1": -0.1, "k2": 0.02, "p1": 0.001,
                   "p2": -0.002, "k3": 0.0}, "OPENCV", OPENCV),
        ("fisheye", {"focal": 0.4, "k1": -0.02, "k2": 0.01}, "RADIAL_FISHEYE", [400.0, 500.0, 400.0, -0.02, 0.01]),
        ("fisheye_opencv", {"focal_x": 0.4, "focal_y": 0.41, "c_x": 0.01, "c_y": -0.01, "k1": -0.02, "k2": 0.01,
                            "k3": -0.001, "k4": 0.002}, "OPENCV_FISHEYE", FISHEYE),
    ],
)  # fmt: skip
def test_opensfm_measures_in_longer_sides_from_the_middle(tmp_path, kind, terms, model, params):
    values = {"v2 some phone 1000 800": {"projection_type": kind, "width": WIDTH, "height": HEIGHT, **terms}}
    assert same_rays(only(tmp_path / "camera_models.json", json.dumps(values)), model, params)


def test_a_panorama_of_opensfm(tmp_path):
    values = {"a": {"projection_type": "spherical", "width": 1000, "height": 500}}
    camera = only(tmp_path / "cameras.json", json.dumps(values))
    assert (camera.projection, camera.width, camera.height) == ("equirectangular", 1000, 500)


SIZE = {"image_width": WIDTH, "image_height": HEIGHT}


@pytest.mark.parametrize(
    "name",
    [
        "dist_coeff",
        "distCoef",
        "dist_coefs",
        "DistortionCoefficients",
        "distortion-coefficient",
        "dist",
        "D",
        "distCoeffs",
    ],
)
def test_common_names_of_the_distortion_are_known(tmp_path, name):
    values = SIZE | {"camera_matrix": K, name: [OPENCV[4:]], "distortion_model": "plumb_bob"}
    assert same_rays(only(tmp_path / "cameras.json", json.dumps(values)), "OPENCV", OPENCV)


def test_distortion_may_be_in_terms_of_its_own(tmp_path):
    values = SIZE | {"camera_matrix": K, "k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.002}
    assert same_rays(only(tmp_path / "cameras.json", json.dumps(values)), "OPENCV", OPENCV)


def test_numbers_of_an_unknown_name_may_be_the_distortion_and_are_refused(tmp_path):
    values = SIZE | {"camera_matrix": K, "coefs": OPENCV[4:]}
    with pytest.raises(InputError, match=r"'coefs' may be the distortion"):
        given(tmp_path / "cameras.json", json.dumps(values))
    harmless = {"rvecs": [[1, 2, 3]] * 5, "rms": 0.3, "roi": [0, 0, 9, 9], "R": np.eye(3).tolist(), "P": [0.0] * 12}
    assert same_rays(only(tmp_path / "a.json", json.dumps(SIZE | {"K": K} | harmless)), "PINHOLE", OPENCV[:4])


def test_yaml_of_ros(tmp_path):
    text = f"""image_width: {WIDTH}
image_height: {HEIGHT}
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: {np.ravel(K).tolist()}
distortion_model: {{}}
distortion_coefficients:
  rows: 1
  cols: 5
  data: {{}}
projection_matrix:
  rows: 3
  cols: 4
  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]
"""
    camera = only(tmp_path / "left.yaml", text.format("plumb_bob", [*OPENCV[4:], 0.0]))
    assert (camera.width, camera.height) == (WIDTH, HEIGHT) and same_rays(camera, "OPENCV", OPENCV)
    assert only(tmp_path / "wide.yaml", text.format("equidistant", FISHEYE[4:])).projection == "fisheye"


def test_yaml_of_kalibr(tmp_path):
    text = f"""cam0:
  T_cam_imu:
  - [0.0, 1.0, 0.0, 0.1]
  camera_model: {{}}
  distortion_coeffs: {OPENCV[4:]}
  distortion_model: radtan
  intrinsics: [900.0, 910.0, 509.5, 389.5]
  resolution: [{WIDTH}, {HEIGHT}]
cam1:
  camera_model: pinhole
  distortion_coeffs: {FISHEYE[4:]}
  distortion_model: equidistant
  intrinsics: [400.0, 410.0, 509.5, 389.5]
  resolution: [{WIDTH}, {HEIGHT}]
"""
    cameras = given(tmp_path / "camchain.yaml", text.format("pinhole")).cameras
    assert same_rays(cameras["cam0"], "OPENCV", OPENCV) and same_rays(cameras["cam1"], "OPENCV_FISHEYE", FISHEYE)
    with pytest.raises(InputError, match="camera 'cam0': the camera model eucm is not supported"):
        given(tmp_path / "camchain.yaml", text.format("eucm"))


METASHAPE = (
    "<calibration><projection>{kind}</projection><width>1000</width><height>800</height><f>910</f><cx>10</cx>"
    "<cy>-10</cy><b1>-10</b1><k1>-0.1</k1><k2>0.02</k2><p1>-0.002</p1><p2>0.001</p2>{more}</calibration>"
)
"""The camera `OPENCV`: Metashape's p1 and p2 are OpenCV's p2 and p1."""


def test_xml_of_metashape(tmp_path):
    alone = '<?xml version="1.0" encoding="UTF-8"?>\n' + METASHAPE.format(kind="frame", more="<date>2026</date>")
    assert same_rays(only(tmp_path / "a.xml", alone), "OPENCV", OPENCV)
    inner = METASHAPE.format(kind="frame", more="").replace(
        "<calibration>", '<calibration type="frame" class="adjusted">'
    )
    project = (
        '<document version="2.0"><chunk><sensors><sensor id="0" label="X100" type="frame">'
        f'<resolution width="1000" height="800"/>{inner}</sensor><sensor id="1" label="none"/></sensors></chunk>'
        "</document>"
    )
    cameras = given(tmp_path / "b.xml", project).cameras
    assert cameras.keys() == {"X100"} and same_rays(cameras["X100"], "OPENCV", OPENCV)
    for kind, more in (("frame", "<b2>0.5</b2>"), ("frame", "<k4>0.5</k4>"), ("cylindrical", "")):
        with pytest.raises(InputError, match="not supported"):
            given(tmp_path / "c.xml", METASHAPE.format(kind=kind, more=more))


def nerfstudio(**values):
    keys = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
    return dict(zip(keys, OPENCV, strict=True)) | {"w": WIDTH, "h": HEIGHT, "camera_model": "OPENCV"} | values


def test_transforms_of_nerfstudio(tmp_path):
    frames = [{"file_path": f"./images/{name}.jpg", "transform_matrix": np.eye(4).tolist()} for name in "ab"]
    assert same_rays(only(tmp_path / "transforms.json", json.dumps(nerfstudio(frames=frames))), "OPENCV", OPENCV)
    own = [frames[0] | nerfstudio(), frames[1] | nerfstudio(fl_x=905.0)]
    found = given(tmp_path / "transforms.json", json.dumps({"frames": own}))
    assert [found.cameras[found.camera_name(photo)].K[0, 0] for photo in ("a.jpg", "images/b.jpg")] == [900.0, 905.0]
    angle = {"camera_angle_x": 2 * np.arctan(500 / 900), "w": WIDTH, "h": HEIGHT, "frames": frames}
    assert same_rays(only(tmp_path / "blender.json", json.dumps(angle)), "SIMPLE_PINHOLE", [900.0, 500.0, 400.0])
    with pytest.raises(InputError, match="no width and height"):
        given(tmp_path / "blender.json", json.dumps({"camera_angle_x": 0.7, "frames": []}))


def test_our_own_export_for_nerfstudio_is_read(tmp_path):
    Ks = {name: np.array([[f, 0, 509.0], [0, f, 391.0], [0, 0, 1]]) for name, f in (("a", 900.0), ("b", 950.0))}
    photos = [PerspectivePhoto(f"{name}.jpg", K, np.eye(3, 4), WIDTH, HEIGHT, name) for name, K in Ks.items()]
    found = given(tmp_path / "transforms.json", json.dumps(transforms(tuple(photos))))
    assert [found.cameras[found.camera_name(photo.name)].K.tolist() for photo in photos] == [
        photo.K.tolist() for photo in photos
    ]


@pytest.mark.parametrize("text", [
    "a: &a [1, 1]\nb: &b [*a, *a]\ncamera_matrix: [*b, *b]",
    '<!DOCTYPE x [<!ENTITY a "aaaa">]><calibration><f>&a;</f></calibration>',
])  # fmt: skip
def test_files_that_grow_while_they_are_read_are_refused(tmp_path, text):
    with pytest.raises(InputError, match=r"repeats parts of itself|has declarations"):
        given(tmp_path / "bomb", text)


KEYS = st.sampled_from([
    "a", "K", "camera_matrix", "dist", "width", "height", "data", "projection_type", "focal", "focal_x", "k1",
    "cameras", "camera_of", "identifiable", "projection", "fisheye", "spread", "params", "model", "image_size",
    "distortion", "dist_coeff", "intrinsics", "fl_x", "frames", "camera_angle_x", "k4", "w", "h", "cx",
])  # fmt: skip
"""Keys of all forms."""
KNOWN = Calibration(
    np.array([[900.5, 0, 501.25], [0, 901.5, 373.0], [0, 0, 1]]), 1000, 750, "zero-curves", True, distortion=(-0.0625,),
    spread={"fx": 3.5, "k1": 0.01}, held=("aspect",), key_pairs=((1, 4),), evidence={"pairs": 12.0},
)  # fmt: skip
GUESS = Calibration(np.diag([1200.0, 1200.0, 1.0]), 1000, 750, "guess", False, "an orbit")


def test_a_run_gives_the_cameras_that_its_photos_determined(tmp_path):
    known = Intrinsics({"one": KNOWN, "two": GUESS}, {"a.jpg": "one", "b.jpg": "two"})
    (tmp_path / "calibration.json").write_text(json.dumps(known.to_dict()))
    for found in (read_given_cameras(tmp_path), read_given_cameras(tmp_path / "calibration.json")):
        assert list(found.cameras) == ["one"] and found.camera_of == {"a.jpg": "one"}
        assert np.array_equal(found.cameras["one"].K, KNOWN.K) and found.cameras["one"].radial == KNOWN.radial
        assert found.cameras["one"].spread == KNOWN.spread and found.cameras["one"].key_pairs == ()


def test_refined_cameras_of_a_run_come_first(tmp_path):
    refined = CameraModel("OPENCV", tuple(OPENCV), np.array(K), WIDTH, HEIGHT, {"fx": 1.5}, ("k1",))
    scene = {"cameras": {"one": refined.to_dict()}, "camera_of": {"a.jpg": "one"}, "unregistered": {}}
    (tmp_path / "calibration.json").write_text(json.dumps(Intrinsics({"one": KNOWN}).to_dict()))
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    camera = read_given_cameras(tmp_path).cameras["one"]
    assert same_rays(camera, "OPENCV", OPENCV) and camera.spread == {"fx": 1.5}


def test_what_calibrate_prints_as_json_is_read(tmp_path):
    printed = {"1000x750": {"field_of_view_deg": [58.1, 45.2], **KNOWN.to_dict(), "key_pairs": [["a.jpg", "b.jpg"]]}}
    assert only(tmp_path / "printed.json", json.dumps(printed)).radial == KNOWN.radial


def test_a_single_camera_of_a_run_is_no_camera_of_opencv(tmp_path):
    assert only(tmp_path / "one.json", json.dumps(KNOWN.to_dict())).radial == KNOWN.radial
    with pytest.raises(InputError, match="holds no known camera"):
        given(tmp_path / "guess.json", json.dumps(GUESS.to_dict()))
    with pytest.raises(InputError, match="not those of a camera"):
        given(tmp_path / "nan.json", json.dumps(KNOWN.to_dict() | {"distortion": [float("nan")]}))


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-9, 9000)
    | st.floats()
    | st.sampled_from(["brown", "OPENCV", "fisheye", ""]),
    lambda inner: st.lists(inner, max_size=9) | st.dictionaries(KEYS, inner, max_size=6),
    max_leaves=20,
)


@settings(max_examples=40)
@given_values(st.dictionaries(KEYS, VALUES, min_size=1, max_size=6))
def test_values_of_any_kind_end_in_cameras_or_in_one_error(tmp_path_factory, values):
    path = tmp_path_factory.getbasetemp() / "any.json"
    try:
        assert all(camera.focal_px > 0 for camera in given(path, json.dumps(values)).cameras.values())
    except InputError as err:
        assert err.hint


@settings(max_examples=60)
@given_values(st.binary(max_size=200))
def test_bytes_of_any_kind_end_in_cameras_or_in_one_error(tmp_path_factory, data):
    with contextlib.suppress(InputError):
        given(tmp_path_factory.getbasetemp() / "any", data)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ("hello", "is not a line of COLMAP's cameras.txt"),
        ("1 FOV 10 10 5 5 5 5 1", "the camera model FOV is not supported"),
        ("1 PINHOLE 10 10 5 5 5", "PINHOLE has 4 parameters"),
        ("1 PINHOLE 10 10 5 -5 5 5", "not those of a camera"),
        ("1 PINHOLE 10 10 5 5 five 5", "something else than numbers"),
        ("", "holds no known camera"),
        ("{", "not valid JSON"),
        ("[1]", "not an object"),
        ('{"a": 3}', "of no known form"),
        ('{"a": {"projection_type": "dual", "width": 9, "height": 9}}', "camera 'a': the projection type dual"),
        ('{"a": {"projection_type": "brown", "width": 9, "height": 9}}', "no focal length"),
        ('{"K": [[1, 2, 3], [0, 1, 2], [0, 0, 1]]}', "the camera matrix is not"),
        ('{"K": [1, 2]}', "2 values instead of 3 x 3"),
        ('{"K": [[9, 0, 3], [0, 9, 2], [0, 0, 1]], "dist": [1, 2, 3]}', "3 distortion coefficients"),
        ('{"K": [[9, 0, 3], [0, 9, 2], [0, 0, 1]], "dist": [0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0]}', "thin prism"),
        ('{"K": [[9, 0, 3], [0, 9, 2], [0, 0, 1]], "width": 5}', "5 x 0 pixels"),
        ('{"cameras": {"a": {"K": 3}}, "camera_of": {}}', "no known form"),
        ("%YAML:1.0\n---\n{[", "no valid YAML"),
        (b"\0\0\0\0", "not those of a COLMAP model"),
        (struct.pack("<QIiQQ", 1, 1, 7, 9, 9), "a model that is not supported"),
        (b"\xff\xfe\x31", "it is no text in UTF-8 or UTF-16"),
    ],
)
def test_what_is_no_calibration_says_why_and_which_forms_are_known(tmp_path, data, says):
    with pytest.raises(InputError) as caught:
        given(tmp_path / "cameras", data)
    assert says in str(caught.value)
    assert "cameras.txt" in caught.value.hint and "OpenSfM" in caught.value.hint


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_text_of_powershell_is_read(tmp_path, encoding):
    text = "1 SIMPLE_PINHOLE 1000 800 900 500 400\n"
    assert only(tmp_path / "cameras.txt", text.encode(encoding)).K[0, 0] == 900.0
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 ä.jpg\n\n", encoding)
    assert read_given_cameras(tmp_path).camera_of == {"ä.jpg": "1"}


def test_missing_files_and_folders_without_cameras_are_named(tmp_path):
    with pytest.raises(InputError, match="cannot read the calibration file"):
        read_given_cameras(tmp_path / "nowhere.json")
    with pytest.raises(InputError, match=r"the folder holds none of scene\.json"):
        read_given_cameras(tmp_path)


def test_terms_that_are_not_estimated_are_known():
    plain = calibration_from_model("FULL_OPENCV", [900, 900, 500, 400, -0.1, *[0.0] * 7], (WIDTH, HEIGHT))
    fisheye = calibration_from_model("THIN_PRISM_FISHEYE", [400, 400, 500, 400, 0.1, *[0.0] * 7], (WIDTH, HEIGHT))
    bent = calibration_from_model("RADIAL", [900, 500, 400, -0.1, 0.01], (WIDTH, HEIGHT))
    prism = calibration_from_model("THIN_PRISM_FISHEYE", [400, 400, 500, 400, *[0.0] * 7, 1e-3], (WIDTH, HEIGHT))
    assert (plain.radial, fisheye.radial, fisheye.distortion[0]) == (-0.1, 0.0, 0.1)
    assert [one.has_more_terms for one in (plain, fisheye, bent, prism)] == [False, False, True, True]


def test_older_files_of_a_run_have_k1_or_the_terms_of_a_fisheye(tmp_path):
    older = {name: value for name, value in KNOWN.to_dict().items() if name != "distortion"}
    assert only(tmp_path / "k1.json", json.dumps(older | {"radial": -0.25, "fisheye": []})).radial == -0.25
    wide = older | {"radial": 0.0, "fisheye": [0.1, 0.2, 0.3, 0.4], "projection": "fisheye"}
    assert only(tmp_path / "wide.json", json.dumps(wide)).distortion == (0.1, 0.2, 0.0, 0.0, 0.3, 0.4)
