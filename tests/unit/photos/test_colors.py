"""Color profiles: pictures come out in sRGB, and those that are sRGB already stay as they are."""

import struct

import numpy as np
import pytest
from PIL import Image, ImageCms

from sfm_app.photos.decode import read_picture, upright_image
from sfm_app.photos.probe import describe
from sfm_app.photos.source import lay_out
from sfm_app.settings import PhotoSettings

SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
D65_TO_D50 = np.array([[1.0478, 0.0229, -0.0501], [0.0295, 0.9905, -0.0171], [-0.0092, 0.0150, 0.7521]])
P3 = np.array([[0.4866, 0.2657, 0.1982], [0.2290, 0.6917, 0.0793], [0.0, 0.0451, 1.0439]])
"""Display P3 to XYZ, both with the white D65."""
TO_LINEAR_SRGB = np.array([[3.2405, -1.5371, -0.4985], [-0.9693, 1.8760, 0.0416], [0.0556, -0.2040, 1.0572]])
COLORS = np.random.default_rng(0).integers(90, 160, (60, 80, 3)).astype(np.uint8)
"""None is outside of sRGB."""


def profile(space=b"RGB ", gamma=2.2, matrix=P3):
    """A color profile of three colors or gray with one gamma."""

    def fixed(*values):
        return struct.pack(f">{len(values)}i", *(round(65536 * value) for value in values))

    curve = b"curv" + bytes(4) + struct.pack(">IH", 1, round(gamma * 256)) + bytes(2)
    text = b"wide by hand\0"
    tags = {b"desc": b"desc" + bytes(4) + struct.pack(">I", len(text)) + text + bytes(78 + 3),
            b"wtpt": b"XYZ " + bytes(4) + fixed(0.9642, 1.0, 0.8249)}  # fmt: skip
    if space == b"GRAY":
        tags[b"kTRC"] = curve
    else:
        for letter, column in zip("rgb", (D65_TO_D50 @ matrix).T, strict=True):
            tags |= {f"{letter}XYZ".encode(): b"XYZ " + bytes(4) + fixed(*column), f"{letter}TRC".encode(): curve}
    table, data = struct.pack(">I", len(tags)), b""
    for tag, unpadded in tags.items():
        value = unpadded + bytes(-len(unpadded) % 4)
        table += tag + struct.pack(">II", 132 + 12 * len(tags) + len(data), len(value))
        data += value
    head = struct.pack(">I4sI4s4s4s", 132 + 12 * len(tags) + len(data), b"", 0x02400000, b"mntr", space, b"XYZ ")
    return head + bytes(12) + b"acsp" + bytes(28) + fixed(0.9642, 1.0, 0.8249) + bytes(48) + table + data


def expected(colors):
    linear = (colors / 255.0) ** 2.2 @ (TO_LINEAR_SRGB @ P3).T
    return 255.0 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def read(path):
    picture = read_picture(path)
    return np.asarray(upright_image(picture), int), describe("x.png", picture, PhotoSettings(min_side_px=16)).photo


@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_wide_colors_become_those_of_srgb(tmp_path, mode):
    Image.fromarray(COLORS).convert(mode).save(tmp_path / "x.png", icc_profile=profile())
    seen, photo = read(tmp_path / "x.png")
    assert np.abs(seen - expected(COLORS)).max() < 2.5
    assert photo.notes == ("colors converted from wide by hand to sRGB",) and photo.needs_copy
    lay_out(photo, tmp_path, tmp_path / "out")
    with Image.open(tmp_path / "out" / "x.png") as laid:
        assert np.array_equal(np.asarray(laid), seen) and "icc_profile" not in laid.info


@pytest.mark.parametrize("given", [None, SRGB])
@pytest.mark.parametrize("mode", ["RGB", "L", "P"])
def test_srgb_and_no_profile_change_no_byte(tmp_path, mode, given):
    image = Image.fromarray(COLORS).convert(mode)
    image.save(tmp_path / "x.png", icc_profile=given)
    seen, photo = read(tmp_path / "x.png")
    assert np.array_equal(seen, image.convert("RGB" if mode == "P" else mode))
    assert photo.notes == () and photo.needs_copy == (mode == "P")


@pytest.mark.parametrize("given", [b"no profile at all", profile()[:200], profile(b"GRAY"), SRGB[:-40]])
def test_a_damaged_profile_is_ignored_and_said_so(tmp_path, given):
    Image.fromarray(COLORS).save(tmp_path / "x.png", icc_profile=given)
    seen, photo = read(tmp_path / "x.png")
    if given != SRGB[:-40]:  # what is cut off may not matter
        assert photo.notes == ("its color profile is damaged or of another kind, and ignored",)
    assert np.array_equal(seen, COLORS) and not photo.needs_copy


@pytest.mark.parametrize(("mode", "given"), [("L", profile(b"GRAY", gamma=1.0)), ("L", profile(gamma=1.0))])
def test_gray_pictures_have_curves(tmp_path, mode, given):
    Image.fromarray(COLORS).convert(mode).save(tmp_path / "x.png", icc_profile=given)
    seen, photo = read(tmp_path / "x.png")
    linear = np.asarray(Image.fromarray(COLORS).convert("L")) / 255.0
    assert np.abs(seen[..., 0] - 255.0 * (1.055 * linear ** (1 / 2.4) - 0.055)).max() < 1.5
    assert photo.needs_copy


def test_lab_is_read_without_a_profile(tmp_path):
    gray = np.dstack([np.full((60, 80), 136, np.uint8), np.zeros((60, 80, 2), np.uint8)])
    Image.frombytes("LAB", (80, 60), gray.tobytes()).save(tmp_path / "x.tif")
    seen, _ = read(tmp_path / "x.tif")
    assert seen.shape == (60, 80, 3) and np.ptp(seen) <= 2 and 110 < seen.mean() < 140
