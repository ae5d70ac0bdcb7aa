"""Read the cameras that a user knows, from the files of several programs.

The functions for one program raise ValueError where a file is damaged, or a camera is not supported.
"""

import io
import json
import math
import re
import struct
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from sfm_app.camera.models import PARAMETERS, calibration_from_model
from sfm_app.errors import InputError
from sfm_app.files import decode_text, fingerprint, read_bytes, read_text
from sfm_app.numerical import finite_entries
from sfm_app.types import Calibration, GivenCameras
from sfm_app.types.arrays import FloatArray
from sfm_app.types.camera import GIVEN, PROJECTIONS

Cameras = tuple[dict[str, Calibration], dict[str, str]]
"""Cameras by name, and the name of the camera by photo."""

# Cameras of COLMAP's models on disk: cameras.txt and cameras.bin, and which photo has which camera.
# COLMAP itself ends the process on some damaged models.

CAMERA_FILES = ("cameras.bin", "cameras.txt")
"""Names of COLMAP's files of cameras; COLMAP, too, prefers the first."""
MODEL_IDS = {
    0: "SIMPLE_PINHOLE", 1: "PINHOLE", 2: "SIMPLE_RADIAL", 3: "RADIAL", 4: "OPENCV", 5: "OPENCV_FISHEYE",
    6: "FULL_OPENCV", 8: "SIMPLE_RADIAL_FISHEYE", 9: "RADIAL_FISHEYE", 10: "THIN_PRISM_FISHEYE", 14: "SIMPLE_FISHEYE",
    15: "FISHEYE", 17: "EQUIRECTANGULAR",
}  # fmt: skip
"""COLMAP's numbers of the supported models. By definition."""
DAMAGED = "its bytes are not those of a COLMAP model"


def read_colmap_text(text: str) -> dict[str, Calibration]:
    """Return the cameras of a cameras.txt by their ids."""
    cameras = {}
    for line in (line.strip() for line in text.splitlines()):
        if not line or line.startswith("#"):
            continue
        words = line.split()
        if len(words) < 5 or not words[1].isupper():
            raise ValueError(f"'{line[:60]}' is not a line of COLMAP's cameras.txt")
        try:
            size, params = (int(words[2]), int(words[3])), [float(word) for word in words[4:]]
        except ValueError:
            raise ValueError(f"'{line[:60]}' has something else than numbers after the model") from None
        cameras[words[0]] = calibration_from_model(words[1], params, size)
    return cameras


def read_colmap_binary(data: bytes) -> dict[str, Calibration]:
    """Return the cameras of a cameras.bin by their ids."""
    cameras, stream = {}, io.BytesIO(data)
    (count,) = _take(stream, "<Q")
    if count > 1_000_000:
        raise ValueError(DAMAGED)
    for _ in range(int(count)):
        camera_id, model_id, width, height = _take(stream, "<IiQQ")
        if model_id not in MODEL_IDS:
            raise ValueError(f"camera {camera_id} has a model that is not supported: only {', '.join(PARAMETERS)}")
        model = MODEL_IDS[int(model_id)]
        params = _take(stream, f"<{len(PARAMETERS[model])}d")
        cameras[str(camera_id)] = calibration_from_model(model, params, (int(width), int(height)))
    return cameras


def read_colmap_folder(folder: Path) -> tuple[dict[str, Calibration], dict[str, str]]:
    """Return the cameras of a folder with one of `CAMERA_FILES`, by their ids, and the id by photo if known."""
    if (folder / "cameras.bin").is_file():
        images = folder / "images.bin"
        known = dict(_binary_images(images.read_bytes())) if images.is_file() else {}
        return read_colmap_binary((folder / "cameras.bin").read_bytes()), known
    images = folder / "images.txt"
    known = dict(_text_images(read_text(images, 100 * MOST_BYTES))) if images.is_file() else {}
    return read_colmap_text(read_text(folder / "cameras.txt", MOST_BYTES)), known


def _text_images(text: str) -> Iterator[tuple[str, str]]:
    """Yield photos and the ids of their cameras from images.txt, where each photo has two lines."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    for line in lines[::2]:
        words = line.split(maxsplit=9)
        if words:
            if len(words) < 10:
                raise ValueError(f"'{line[:60]}' is not a line of COLMAP's images.txt")
            yield words[9].strip(), words[8]


def _binary_images(data: bytes) -> Iterator[tuple[str, str]]:
    stream = io.BytesIO(data)
    (count,) = _take(stream, "<Q")
    for _ in range(int(count)):
        *_, camera_id = _take(stream, "<I7dI")
        name = bytearray()
        while (letter := _take(stream, "c")[0]) != b"\0":
            name += letter
        (points,) = _take(stream, "<Q")
        stream.seek(24 * int(points), io.SEEK_CUR)
        yield name.decode("utf-8", "replace"), str(camera_id)


def _take(stream: io.BytesIO, form: str) -> tuple[Any, ...]:
    """Return the next values of a stream, by a format of `struct`; ValueError at its end."""
    data = stream.read(struct.calcsize(form))
    if len(data) < struct.calcsize(form):
        raise ValueError(DAMAGED)
    return struct.unpack(form, data)


# Cameras as OpenCV, ROS (camera_info) and Kalibr write them: camera matrix and distortion coefficients in JSON, YAML or
# XML. They count pixels from the center of the first one, which is (0.5, 0.5) here.

MATRIX = ("cameramatrix", "k", "mtx", "intrinsicmatrix", "intrinsics")
DISTORTION = ("distortion", "distcoef", "dist", "d")
"""Keys of the distortion, in small letters without underscores; longer keys that begin with the second do, too."""
WIDTH, HEIGHT, SIZE = ("imagewidth", "width"), ("imageheight", "height"), ("imagesize", "resolution")
MODEL = ("fisheyemodel", "distortionmodel", "cameramodel", "model", "projection", "lens", "fisheye")
"""Keys of programs around OpenCV for each value, in small letters without underscores."""
FISHEYE_WORDS = ("fisheye", "equidistant", "kannala")
TERMS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
COUNTS = (4, 5, 8, 12, 14)
"""Numbers of OpenCV's coefficients: k1 k2 p1 p2, k3, k4 k5 k6, s1 s2 s3 s4, two of a tilted sensor."""
OTHER_KEYS = ("roi", "validroi", "rectificationmatrix", "projectionmatrix", "r", "p", "t")
"""Keys of values with so many numbers that are no distortion."""


def is_opencv_camera(values: Mapping[str, Any]) -> bool:
    """Return whether there is a camera matrix among the values."""
    return _value(values, MATRIX) is not None


def opencv_camera(values: Mapping[str, Any]) -> Calibration:
    """Return the camera of OpenCV's values: a camera matrix, and optionally distortion, size, and the kind of lens."""
    K = _numbers(_value(values, MATRIX), "the camera matrix").ravel()
    if K.size == 4:  # Kalibr's fx, fy, cx, cy
        K = np.array([K[0], 0.0, K[2], 0.0, K[1], K[3], 0.0, 0.0, 1.0])
    if K.size != 9:
        raise ValueError(f"the camera matrix has {K.size} values instead of 3 x 3")
    (fx, skew, cx), (below, fy, cy), last = K.reshape(3, 3)
    if skew != 0.0 or below != 0.0 or last.tolist() != [0.0, 0.0, 1.0]:
        raise ValueError("the camera matrix is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    words = [word for word in (_value(values, (name,)) for name in MODEL) if word is not None]
    fisheye = any(any(kind in str(word).lower() for kind in FISHEYE_WORDS) or word is True for word in words)
    if unknown := {"omni", "eucm", "ds", "fov"}.intersection(words):
        raise ValueError(f"the camera model {unknown.pop()} is not supported: only pinhole, radtan and equidistant")
    model, terms = _model_and_terms(_distortion(values), fisheye=fisheye)
    params = [fx, fy, cx + 0.5, cy + 0.5, *terms]
    return calibration_from_model(model, params, _size(values))


def _distortion(values: Mapping[str, Any]) -> list[float]:
    """Return the distortion coefficients; ValueError where values of an unknown name may be these."""
    plain = _plain_keys(values)
    for name, value in plain.items():
        if name in DISTORTION or (name.startswith(DISTORTION[:2]) and "model" not in name):
            return [] if value is None else _numbers(value, "the distortion").ravel().tolist()
    if any(name in plain for name in TERMS):
        return [float(plain.get(name) or 0.0) for name in TERMS]
    unknown = [name for name in plain.keys() - {*MATRIX, *SIZE, *OTHER_KEYS} if _length(plain[name]) in COUNTS]
    if unknown:
        raise ValueError(f"'{min(unknown)}' may be the distortion: call it dist_coeffs, or remove it")
    return []


def _length(value: Any) -> int:
    """Return how many numbers a value holds; 0 for other values."""
    try:
        return _numbers(value, "").size if isinstance(value, (Sequence, Mapping)) and not isinstance(value, str) else 0
    except ValueError:
        return 0


def read_yaml(text: str) -> Any:
    """Return the values of YAML, also of OpenCV's, whose matrices become mappings with "data"."""
    text = re.sub(r"!!opencv-[\w-]+", "", text.removeprefix("%YAML:1.0"))  # neither is plain YAML
    try:
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text)):
            raise ValueError("its YAML repeats parts of itself")  # which may grow without bound
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise ValueError("it is no valid YAML") from None


def read_xml(text: str) -> ElementTree.Element:
    """Return the root of XML without entities of its own, which may grow without bound."""
    if "<!" in text.replace("<!--", ""):
        raise ValueError("its XML has declarations")
    try:
        return ElementTree.fromstring(text)  # noqa: S314 -- see above
    except ElementTree.ParseError:
        raise ValueError("it is no valid XML") from None


def xml_values(element: ElementTree.Element) -> Any:
    """Return children by their tags; of an element without any its numbers, or else its text."""
    if len(element):
        return {child.tag: xml_values(child) for child in element}
    words = (element.text or "").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return (element.text or "").strip()
    return numbers[0] if len(numbers) == 1 else numbers


def _model_and_terms(terms: list[float], *, fisheye: bool) -> tuple[str, list[float]]:
    """Return COLMAP's model, and its terms in COLMAP's order, which is OpenCV's."""
    if fisheye:
        if len(terms) not in (0, 4):
            raise ValueError(f"a fisheye of OpenCV has 4 distortion coefficients, not {len(terms)}")
        return "OPENCV_FISHEYE", terms or [0.0] * 4
    if len(terms) not in (0, *COUNTS):
        raise ValueError(f"{len(terms)} distortion coefficients; OpenCV has {', '.join(map(str, COUNTS))}")
    if any(terms[8:]):
        raise ValueError("coefficients of a thin prism or of a tilted sensor are not supported")
    return "FULL_OPENCV", [*terms, *[0.0] * 8][:8]


def _size(values: Mapping[str, Any]) -> tuple[int, int]:
    """Return width and height in pixels; 0 where unknown."""
    both = _value(values, SIZE)
    if isinstance(both, Sequence) and not isinstance(both, str) and len(both) == 2:
        width, height = both
    else:
        width, height = _value(values, WIDTH) or 0, _value(values, HEIGHT) or 0
    if bool(width) != bool(height) or width < 0 or height < 0:
        raise ValueError(f"the size cannot be {width} x {height} pixels")
    return int(width), int(height)


def _plain_keys(values: Mapping[str, Any]) -> dict[str, Any]:
    return {str(key).lower().translate(str.maketrans("", "", "_- ")): value for key, value in values.items()}


def _value(values: Mapping[str, Any], names: Sequence[str]) -> Any:
    plain = _plain_keys(values)
    return next((plain[name] for name in names if plain.get(name) is not None), None)


def _numbers(value: Any, what: str) -> FloatArray:
    """Return numbers from nested lists, or from a mapping with "data", as ROS and OpenCV write matrices."""
    if isinstance(value, Mapping):
        value = value.get("data")
    try:
        numbers = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{what} does not consist of numbers") from None
    if not np.isfinite(numbers).all():
        raise ValueError(f"{what} is not finite")
    return numbers


# Cameras as OpenSfM writes them into camera_models.json, and OpenDroneMap into cameras.json.
# Lengths are in units of the longer side, and the center counts from the middle of the photo.

MODELS = {
    "perspective": ("FULL_OPENCV", ("k1", "k2")),
    "simple_radial": ("FULL_OPENCV", ("k1",)),
    "radial": ("FULL_OPENCV", ("k1", "k2")),
    "brown": ("FULL_OPENCV", ("k1", "k2", "p1", "p2", "k3")),
    "fisheye": ("THIN_PRISM_FISHEYE", ("k1", "k2")),
    "fisheye_opencv": ("THIN_PRISM_FISHEYE", ("k1", "k2", "", "", "k3", "k4")),
}
"""By projection type: COLMAP's model of the same lens, and OpenSfM's names of its terms in COLMAP's order."""
PANORAMAS = ("spherical", "equirectangular")


def opensfm_camera(values: Mapping[str, Any]) -> Calibration:
    """Return the camera of OpenSfM's values, one entry of its file."""
    kind = str(values["projection_type"]).lower()
    width, height = (int(values.get(name, 0)) for name in ("width", "height"))
    if width <= 0 or height <= 0:
        raise ValueError("it has no width and height")
    if kind in PANORAMAS:
        return calibration_from_model("EQUIRECTANGULAR", (width, height), (width, height))
    if kind not in MODELS:
        raise ValueError(f"the projection type {kind[:40]} is not supported: only {', '.join((*MODELS, *PANORAMAS))}")
    if not values.get("focal_x", values.get("focal", 0.0)):
        raise ValueError("it has no focal length")
    side = float(max(width, height))
    fx, fy = (side * float(values.get(name, values.get("focal", 0.0))) for name in ("focal_x", "focal_y"))
    cx = side * float(values.get("c_x", 0.0)) + 0.5 * width
    cy = side * float(values.get("c_y", 0.0)) + 0.5 * height
    model, names = MODELS[kind]
    terms = [float(values.get(name, 0.0)) if name else 0.0 for name in names]
    return calibration_from_model(model, [fx, fy, cx, cy, *terms, *[0.0] * (8 - len(terms))], (width, height))


# Cameras of nerfstudio's and instant-ngp's transforms.json, for all frames or for each. Pixels are as in COLMAP.

NERFSTUDIO = ("fl_x", "fl_y", "camera_angle_x", "cx", "cy", "w", "h", "camera_model", *TERMS)


def nerfstudio_cameras(values: Mapping[str, Any]) -> Cameras:
    """Return the different cameras of all frames, and the number of the camera by photo."""
    names: dict[tuple[Any, ...], str] = {}
    camera_of: dict[str, str] = {}
    for frame in values.get("frames") or [{}]:
        own = {**values, **frame}
        name = names.setdefault(tuple(own.get(key) for key in NERFSTUDIO), str(len(names)))
        path = PurePosixPath(str(own.get("file_path", "")))
        camera_of |= {path.as_posix(): name, path.name: name}
    return {name: _nerfstudio_camera(dict(zip(NERFSTUDIO, key, strict=True))) for key, name in names.items()}, camera_of


def _nerfstudio_camera(values: Mapping[str, Any]) -> Calibration:
    fisheye = "FISHEYE" in str(values["camera_model"])
    number = {key: float(value) for key, value in values.items() if value is not None and key != "camera_model"}
    width, height = number.get("w", 0.0), number.get("h", 0.0)
    fx = number.get("fl_x", 0.0)
    if not fx and number.get("camera_angle_x"):
        fx = 0.5 * width / math.tan(0.5 * number["camera_angle_x"])
    if min(fx, width, height) <= 0.0:
        raise ValueError("it has no focal length, or no width and height in pixels")
    if number.get("k4") and not fisheye:
        raise ValueError("its term k4 is not supported")
    names = TERMS[:2] + TERMS[4:6] if fisheye else TERMS[:5]
    terms = [number.get(name, 0.0) for name in names] + ([] if fisheye else [0.0] * 3)
    center = number.get("cx", 0.5 * width), number.get("cy", 0.5 * height)
    params = [fx, number.get("fl_y", fx), *center, *terms]
    return calibration_from_model("OPENCV_FISHEYE" if fisheye else "FULL_OPENCV", params, (int(width), int(height)))


# Cameras of Metashape's XML, a project's or one camera's. The center counts from the middle of the photo, and p1 and p2
# are OpenCV's p2 and p1.


def metashape_cameras(root: ElementTree.Element) -> dict[str, Calibration]:
    """Return the cameras of a `document` by the labels of their sensors, or that of a `calibration`."""
    if root.tag == "calibration":
        return {"": _metashape_camera(xml_values(root), str(root.findtext("projection")))}
    cameras: dict[str, Calibration] = {}
    for sensor in root.iter("sensor"):
        found = sensor.findall("calibration")
        if found:
            resolution = sensor.find("resolution")
            size = {} if resolution is None else resolution.attrib
            values = {**xml_values(found[-1]), **size}
            cameras[sensor.get("label", str(len(cameras)))] = _metashape_camera(values, found[-1].get("type", "frame"))
    return cameras


def _metashape_camera(values: Mapping[str, Any], kind: str) -> Calibration:
    number = {name: float(values.get(name, 0.0)) for name in ("cx", "cy", "b1", "b2", *TERMS)}
    width, height, f = (float(values[name]) for name in ("width", "height", "f"))
    if kind not in ("frame", "fisheye", "spherical") or number["b2"] or number["k4"]:
        raise ValueError(f"a camera of the type {kind[:40]}, or with a skew b2 or a term k4, is not supported")
    size = int(width), int(height)
    if kind == "spherical":
        return calibration_from_model("EQUIRECTANGULAR", size, size)
    model = "FULL_OPENCV" if kind == "frame" else "THIN_PRISM_FISHEYE"
    terms = [number[name] for name in ("k1", "k2", "p2", "p1", "k3")]
    params = [f + number["b1"], f, 0.5 * width + number["cx"], 0.5 * height + number["cy"], *terms, 0.0, 0.0, 0.0]
    return calibration_from_model(model, params, size)


# Cameras of earlier runs: calibration.json, scene.json, and what `sfm-app calibrate --json` prints.
# Only cameras that the photos of that run determined are used; the others are guesses.


def is_run_camera(values: Mapping[str, Any]) -> bool:
    """Return whether the values are those of one camera of a run."""
    return "K" in values and ("identifiable" in values or "params" in values)


def run_camera(values: Mapping[str, Any]) -> Calibration | None:
    """Return a camera of a run, a `Calibration` or `CameraModel` as plain values; None if it is a guess."""
    if "params" in values:
        size = int(values["width"]), int(values["height"])
        camera = calibration_from_model(str(values["model"]), values["params"], size)
        spread, correlations = (finite_entries(values.get(name, {})) for name in ("deviations", "correlations"))
        return replace(camera, spread=spread, correlations=correlations)
    if not values["identifiable"]:
        return None
    camera = Calibration.from_dict({**values, "evidence": {}, "held": (), "key_pairs": (), "method": GIVEN})
    if camera.projection not in PROJECTIONS or camera.K.shape != (3, 3) or not min(np.diag(camera.K)) > 0.0:
        raise ValueError("its values are not those of a camera")
    if not np.isfinite([*camera.K.ravel(), *camera.distortion]).all() or len(camera.distortion) > 8:
        raise ValueError("its values are not those of a camera")
    return camera


# Recognize the form of a calibration file by its content, and read it.

FORMS = (
    "known are: calibration.json, scene.json or an output folder of sfm-app; COLMAP's cameras.txt or cameras.bin, or a "
    "folder with one; JSON, YAML or XML with camera_matrix and dist_coeffs of OpenCV, ROS and Kalibr; OpenSfM's "
    "camera_models.json and ODM's cameras.json; Metashape's XML; transforms.json of nerfstudio"
)
MOST_BYTES = 10_000_000
"""Most bytes of a calibration file; a camera for each of a thousand photos takes a tenth. Chosen by hand."""
RUN_FILES = ("scene.json", "calibration.json")
"""Files of an output folder, the better one first."""


def read_given_cameras(path: Path) -> GivenCameras:
    """Read a calibration file of any known form, or a folder that holds one; an InputError says what is wrong."""
    try:
        form, (cameras, camera_of) = _read_folder(path) if path.is_dir() else _read_file(path)
        if not cameras:
            raise ValueError("it holds no known camera")
    except OSError as err:
        raise InputError(f"cannot read the calibration file {path}: {err.strerror}", hint=FORMS) from err
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError, RecursionError) as err:
        # Values of other programs may have any type, and any depth.
        reason = str(err) if type(err) is ValueError else "it is of no known form"
        raise InputError(f"{path} is no calibration file: {reason}", hint=FORMS) from err
    known = {name: camera.to_dict() for name, camera in cameras.items()}
    used = {photo: name for photo, name in camera_of.items() if name in cameras}
    return GivenCameras(cameras, used, f"{path} ({form})", fingerprint(known, used))


def _read_folder(folder: Path) -> tuple[str, Cameras]:
    for name in RUN_FILES:
        if (folder / name).is_file():
            return _read_file(folder / name)
    if not any((folder / name).is_file() for name in CAMERA_FILES):
        raise ValueError(f"the folder holds none of {', '.join((*RUN_FILES, *CAMERA_FILES))}")
    return "COLMAP", read_colmap_folder(folder)


def _read_file(path: Path) -> tuple[str, Cameras]:
    data = read_bytes(path, MOST_BYTES)
    if b"\0" in data and not data.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
        return "COLMAP", (read_colmap_binary(data), {})
    text = decode_text(data).strip()
    if text.startswith("<"):
        root = read_xml(text)
        if root.tag in ("document", "calibration"):
            return "Metashape", (metashape_cameras(root), {})
        return _read_values(xml_values(root))
    if text.startswith(("{", "[")):
        try:
            return _read_values(json.loads(text))
        except json.JSONDecodeError as err:
            raise ValueError(f"it is not valid JSON: {err}") from None
    if text.startswith("%YAML") or re.search(r"^\w+:", text, re.MULTILINE):
        return _read_values(read_yaml(text))
    return "COLMAP", (read_colmap_text(text), {})


def _read_values(values: Any) -> tuple[str, Cameras]:
    if not isinstance(values, Mapping):
        raise ValueError("it is not an object with names")
    if "cameras" in values and "camera_of" in values:  # calibration.json or scene.json of a run
        camera_of = {str(photo): str(name) for photo, name in values["camera_of"].items()}
        return "sfm-app", (dict(_read_by_name(values["cameras"], run_camera)), camera_of)
    if {"fl_x", "camera_angle_x", "frames"} & values.keys():
        return "nerfstudio", nerfstudio_cameras(values)
    for form, fits, read in _ENTRIES:
        if fits(values):
            camera = read(values)
            return form, ({"": camera} if camera is not None else {}, {})
    for form, fits, read in _ENTRIES:
        if values and all(isinstance(entry, Mapping) and fits(entry) for entry in values.values()):
            return form, (dict(_read_by_name(values, read)), {})
    raise ValueError("it is of no known form")


_ENTRIES: tuple[tuple[str, Callable[..., bool], Callable[..., Calibration | None]], ...] = (
    ("sfm-app", is_run_camera, run_camera),
    ("OpenSfM", lambda values: "projection_type" in values, opensfm_camera),
    ("OpenCV", is_opencv_camera, opencv_camera),
)
"""Forms of a camera in JSON, alone or by name: the test and the reader."""


def _read_by_name(
    values: Mapping[str, Any], read: Callable[..., Calibration | None]
) -> Iterator[tuple[str, Calibration]]:
    for name, entry in values.items():
        try:
            camera = read(entry)
        except ValueError as err:
            raise ValueError(f"camera '{name[:60]}': {err}") from None
        if camera is not None:
            yield name, camera
