"""JPEG files whose data were lost, though the decoder gives a picture of the full size."""

from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from sfm_app.photos.decode import UnreadableError, is_whole_jpeg, read_picture

SIZE = (240, 320)


def scene(seed):
    blots = Image.fromarray(np.random.default_rng(seed).integers(0, 255, (120, 160, 3), np.uint8))
    return np.asarray(blots.resize(SIZE[::-1], Image.Resampling.BICUBIC))


def jpeg(pixels, kind="JPEG", mode="RGB", **options):
    file = BytesIO()
    Image.fromarray(pixels).convert(mode).save(file, kind, **options)
    return file.getvalue()


WHOLE = jpeg(scene(1), quality=90)
OTHER = jpeg(scene(2), quality=92)
INTERVALS = jpeg(scene(1), quality=90, restart_marker_blocks=5)
AT = len(WHOLE) * 6 // 10


def without(data, first, count):
    """The data after their intervals numbered `first` and following are gone."""
    parts = data.split(b"\xff\xd0")
    return b"\xff\xd0".join(parts[:first] + parts[first + count :])


DAMAGED = {
    "zeros to the end": WHOLE[:AT] + bytes(len(WHOLE) - AT),
    "zeros within": WHOLE[: AT // 2] + bytes(2000) + WHOLE[AT // 2 + 2000 :],
    "a sector of zeros": WHOLE[:AT] + bytes(512) + WHOLE[AT + 512 :],
    "the data of another file": WHOLE[:AT] + OTHER[AT:],
    "cut off, with an end": WHOLE[:AT] + b"\xff\xd9",
    "cut off": WHOLE[:AT],
    "a part is gone": WHOLE[:AT] + WHOLE[AT + 1500 :],
    "a part is there twice": WHOLE[:AT] + WHOLE[AT - 1500 :],
    "intervals are gone": without(INTERVALS, 3, 4),
    "zeros over intervals": INTERVALS[:AT] + bytes(1500) + INTERVALS[AT + 1500 :],
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_photos_that_lost_data_are_left_out(tmp_path, kind):
    (tmp_path / "x.jpg").write_bytes(DAMAGED[kind])
    with pytest.raises(UnreadableError, match=r"^truncated or damaged$"):
        read_picture(tmp_path / "x.jpg")


HALF_WHITE = np.where(np.arange(SIZE[0])[:, None, None] < 120, scene(3), np.uint8(255))
PICTURES = {
    "noise": scene(1),
    "black": np.zeros((*SIZE, 3), np.uint8),
    "half white": HALF_WHITE,
    "tiny": scene(1)[:9, :9],
}
WAYS = {
    "plain": {}, "optimized": {"optimize": True}, "progressive": {"progressive": True}, "coarse": {"quality": 5},
    "gray": {"mode": "L"}, "CMYK": {"mode": "CMYK"}, "fine colors": {"subsampling": 0},
    "progressive intervals": {"progressive": True, "restart_marker_blocks": 7},
    "intervals": {"restart_marker_blocks": 7}, "gray intervals": {"mode": "L", "restart_marker_blocks": 3},
    "two pictures": {"kind": "MPO", "save_all": True, "append_images": [Image.fromarray(scene(2))]},
}  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("picture", PICTURES)
def test_whole_photos_stay(picture, way):
    assert is_whole_jpeg(jpeg(PICTURES[picture], **WAYS[way]))


def test_bytes_that_cameras_add_and_a_missing_end_do_no_harm():
    assert is_whole_jpeg(WHOLE[:-2] + bytes(40) + b"\xff\xd9")
    assert is_whole_jpeg(WHOLE + bytes(5000))
    assert is_whole_jpeg(WHOLE[:2] + b"\xff\xff\xff" + WHOLE[2:])


KINDS = {"baseline": {}, "progressive": {"progressive": True}, "baseline with intervals": {"restart_marker_blocks": 7}}
DAMAGES = {"zeros": bytes, "noise": lambda count: np.random.default_rng(count).bytes(count), "cut off": lambda _: b""}


def damaged_runs(kind, seeds=range(30)):
    """Files of which a run was lost behind their head: zeros, noise, or an end in its place."""
    whole = jpeg(scene(4), quality=90, **KINDS[kind])
    for seed in seeds:
        rng = np.random.default_rng(seed)
        at, count = int(rng.integers(len(whole) // 20, len(whole) - 600)), int(rng.integers(100, 5000))
        name = [*DAMAGES][seed % 3]
        rest = b"\xff\xd9" if name == "cut off" else whole[at + count :]
        yield f"{name} at {at}", whole[:at] + DAMAGES[name](count) + rest


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_photos_are_left_out_or_hardly_differ(tmp_path, kind):
    whole = np.asarray(Image.open(BytesIO(jpeg(scene(4), quality=90, **KINDS[kind]))), float)
    left_out = 0
    for name, data in damaged_runs(kind):
        (tmp_path / "x.jpg").write_bytes(data)
        try:
            found = np.asarray(read_picture(tmp_path / "x.jpg").image, float)
        except UnreadableError as err:
            assert str(err) == "truncated or damaged", name
            left_out += 1
        else:
            assert 10 * np.log10(255**2 / max(np.mean((found - whole) ** 2), 1e-9)) > 25, name
    assert left_out > 20


def test_a_progressive_photo_with_a_part_of_another_is_left_out():
    fine, other = (jpeg(scene(seed), quality=90, progressive=True) for seed in (1, 2))
    assert is_whole_jpeg(fine) and not is_whole_jpeg(fine[:AT] + other[AT:])
