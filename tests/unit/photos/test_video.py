"""Videos: reading frame by frame, motion of the camera, and the choice of frames."""

import os
import struct
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from sfm_app.photos.decode import UnreadableError
from sfm_app.photos.files import is_video, read_head
from sfm_app.photos.video import CornerTracker, TrackedFrame, open_video, select_keyframes
from tests.fuzz.mutations import damaged
from tests.unit.photos.tables import check_table

SIZE = WIDTH, HEIGHT = 160, 96
COUNT = 24


def pictures(count=COUNT, size=SIZE):
    """Frames of a growing gray; the left half is darker."""
    for k in range(count):
        picture = np.full((size[1], size[0], 3), 80 + 6 * (k % COUNT), np.uint8)
        picture[:, : size[0] // 2] //= 2
        yield picture


def write(path, codec="mjpeg", kind=None, *, frames=None, rate=30, pts=None, **values):
    """A video; `values` are of the encoder, its `options`, and those of the `muxer`."""
    frames = list(pictures() if frames is None else frames)
    options = values.pop("options", {})
    with av.open(str(path), "w", format=kind, options=values.pop("muxer", {})) as made:
        stream = made.add_stream(codec, rate=rate, options=options)
        height, width = getattr(frames[0], "shape", (0, 0))[:2]
        stream.width, stream.height = width or frames[0].width, height or frames[0].height
        stream.pix_fmt = values.pop("pix_fmt", "yuvj420p" if codec == "mjpeg" else "yuv420p")
        if codec != "libsvtav1":  # which refuses it
            stream.bit_rate = 4_000_000
        for name, value in values.items():
            setattr(stream, name, value)
        unit = Fraction(1, rate) if pts is None else Fraction(1, 1000)
        if pts is not None:
            stream.codec_context.time_base = unit
        for k, picture in enumerate(frames):
            frame = picture if isinstance(picture, av.VideoFrame) else av.VideoFrame.from_ndarray(picture, "rgb24")
            frame.pts, frame.time_base = (k if pts is None else pts[k]), unit
            made.mux(stream.encode(frame))
        made.mux(stream.encode())
    return path


def numbers_of(path):
    with open_video(path) as found:
        return [number for number, _ in found.small_frames()]


def read(path, numbers=range(COUNT)):
    """The frames of a video, in RGB, and the notes, which do not wait for the frames to be chosen."""
    with open_video(path) as found:
        list(found.small_frames())
        notes = [*found.notes]
    with open_video(path) as found:
        return [decoded(data)[..., ::-1] for _, data in found.jpegs(numbers)], notes


def decoded(data):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)


def psnr(one, other):
    return -10 * np.log10(np.mean((one.astype(np.float64) - other) ** 2) / 255**2 + 1e-9)


MPEG4 = {"H.264": "libx264", "HEVC": "libx265", "AV1": "libsvtav1", "VP9": "libvpx-vp9", "MPEG-4": "mpeg4"}
FORMATS = {
    "MP4": ("mp4", MPEG4 | {"MPEG-2": "mpeg2video", "MJPEG": "mjpeg"}),
    "QuickTime": ("mov", {"H.264": "libx264", "HEVC": "libx265", "MPEG-4": "mpeg4", "ProRes": "prores_ks",
                          "CineForm": "cfhd", "DNxHR": "dnxhd", "Animation": "qtrle", "uncompressed": "v210",
                          "PNG": "png", "MJPEG": "mjpeg", "DV": "dvvideo"}),
    "3GP": ("3gp", {"H.263": "h263", "MPEG-4": "mpeg4", "H.264": "libx264"}),
    "Matroska": ("matroska", MPEG4 | {"VP8": "libvpx", "FFV1": "ffv1", "MPEG-2": "mpeg2video", "ProRes": "prores_ks"}),
    "WebM": ("webm", {"VP8": "libvpx", "VP9": "libvpx-vp9", "AV1": "libsvtav1"}),
    "AVI": ("avi", {"MJPEG": "mjpeg", "MPEG-4": "mpeg4", "H.264": "libx264", "MS MPEG-4": "msmpeg4",
                    "Huffyuv": "huffyuv", "Ut Video": "utvideo", "MagicYUV": "magicyuv", "Cinepak": "cinepak",
                    "DV": "dvvideo", "uncompressed": "rawvideo"}),
    "MPEG-PS": ("vob", {"MPEG-1": "mpeg1video", "MPEG-2": "mpeg2video"}),
    "MPEG-TS": ("mpegts", {"MPEG-2": "mpeg2video", "H.264": "libx264", "HEVC": "libx265"}),
    "Windows Media": ("asf", {"WMV 7": "wmv1", "WMV 8": "wmv2", "MS MPEG-4": "msmpeg4"}),
    "Flash Video": ("flv", {"Sorenson": "flv", "H.264": "libx264", "HEVC": "libx265", "AV1": "libsvtav1"}),
    "Ogg": ("ogg", {"VP8": "libvpx"}),
    "MXF": ("mxf", {"MPEG-2": "mpeg2video", "H.264": "libx264", "ProRes": "prores_ks", "DNxHR": "dnxhd"}),
    "WTV": ("wtv", {"MPEG-2": "mpeg2video", "H.264": "libx264"}),
    "RealMedia": ("rm", {"RV 1": "rv10", "RV 2": "rv20"}),
    "NUT": ("nut", {"H.264": "libx264", "FFV1": "ffv1"}),
    "IVF": ("ivf", {"VP8": "libvpx", "VP9": "libvpx-vp9", "AV1": "libsvtav1"}),
    "without container": ("", {"H.264": "libx264", "HEVC": "libx265", "AV1": "libsvtav1", "DV": "dvvideo",
                               "MPEG-1": "mpeg1video", "MPEG-2": "mpeg2video", "YUV4MPEG": "wrapped_avframe"}),
    "pictures that move": ("", {"GIF": "gif", "APNG": "apng"}),
}  # fmt: skip
BARE = {"libx264": "h264", "libx265": "hevc", "libsvtav1": "obu", "dvvideo": "dv", "wrapped_avframe": "yuv4mpegpipe"}
PIXELS = {
    "prores_ks": "yuv422p10le", "cfhd": "yuv422p10le", "v210": "yuv422p10le", "dnxhd": "yuv422p", "qtrle": "rgb24",
    "png": "rgb24", "rawvideo": "bgr24", "cinepak": "rgb24", "gif": "rgb8", "apng": "rgb24", "libsvtav1": "yuv420p10le",
    "huffyuv": "yuv422p",
}  # fmt: skip
CASES = [(form, codec) for form, (_, codecs) in FORMATS.items() for codec in codecs]


@pytest.mark.parametrize(("form", "codec"), CASES)
def test_every_format_gives_the_frames_that_were_written(tmp_path, form, codec):
    kind, codecs = FORMATS[form]
    encoder = codecs[codec]
    size = {"dvvideo": (720, 576), "dnxhd": (256, 128), "h263": (176, 144)}.get(encoder, SIZE)
    values = {"options": {"profile": "dnxhr_sq"}} if encoder == "dnxhd" else {}
    values |= {"pix_fmt": PIXELS[encoder]} if encoder in PIXELS else {}
    frames = list(pictures(12, size))
    write(
        tmp_path / "x", encoder, kind or BARE.get(encoder, encoder), frames=frames,
        rate=25 if encoder == "dvvideo" else 30, **values,
    )  # fmt: skip

    with open_video(tmp_path / "x") as found:
        small = [number for number, _ in found.small_frames()]
    full, _ = read(tmp_path / "x")

    assert found.frames == len(full) == 12 and len(small) >= 10 and not found.is_cut_short
    assert found.seconds == pytest.approx(11 / 30, abs=0.08)
    for one, other in zip(full, frames, strict=True):
        assert psnr(cv2.resize(one, size), other) > (23 if encoder == "gif" else 38)


def test_the_table_of_formats_is_up_to_date():
    rows = [("container", "codecs"), *((form, ", ".join(codecs)) for form, (_, codecs) in FORMATS.items())]
    check_table("video formats", rows)


def test_large_frames_are_looked_at_small_and_kept_whole(tmp_path):
    write(tmp_path / "a.avi", frames=[np.full((720, 960, 3), 90, np.uint8)] * 9, rate=120)

    with open_video(tmp_path / "a.avi") as found:
        small = list(found.small_frames())
    full, _ = read(tmp_path / "a.avi", [5])

    assert [number for number, _ in small] == [0, 4, 8]  # 30 in a second
    assert {picture.shape for _, picture in small} == {(360, 480)}
    assert [picture.shape for picture in full] == [(720, 960, 3)]


def test_times_are_those_of_the_file(tmp_path):
    """A phone in the dark: the rate changes."""
    pts = [0, 10, 20, 40, 140, 240, 340, 440]
    write(tmp_path / "a.mkv", "libx264", frames=pictures(8), pts=pts, rate=100)
    with open_video(tmp_path / "a.mkv") as found:
        times = {number: found.seconds for number, _ in found.small_frames()}
    assert times == pytest.approx({0: 0, 3: 0.04, 4: 0.14, 5: 0.24, 6: 0.34, 7: 0.44}, abs=1e-3)


ONE = 1 << 16
TURNS = {
    "none": ((ONE, 0, 0, ONE), lambda one: one),
    "90": ((0, ONE, -ONE, 0), lambda one: np.rot90(one, -1)),
    "180": ((-ONE, 0, 0, -ONE), lambda one: np.rot90(one, 2)),
    "270": ((0, -ONE, ONE, 0), np.rot90),
    "mirror": ((-ONE, 0, 0, ONE), np.fliplr),
    "upside down": ((ONE, 0, 0, -ONE), np.flipud),
    "transposed": ((0, ONE, ONE, 0), lambda one: one.swapaxes(0, 1)),
    "transposed the other way": ((0, -ONE, -ONE, 0), lambda one: np.rot90(one.swapaxes(0, 1), 2)),
}


@pytest.mark.parametrize("turn", TURNS)
def test_frames_are_upright_as_the_display_matrix_says(tmp_path, turn):
    (a, b, c, d), expected = TURNS[turn]
    corner = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    corner[: HEIGHT // 2, : WIDTH // 2], corner[: HEIGHT // 2, WIDTH // 2 :] = 220, 120
    path = write(tmp_path / "a.mp4", "libx264", frames=[corner] * 3)
    data = bytearray(path.read_bytes())
    matrix = data.index(b"tkhd") + 4 + 40
    data[matrix : matrix + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(data)

    (found, *_), _ = read(path)

    assert found.shape == expected(corner).shape
    assert psnr(found, expected(corner)) > 30


@pytest.mark.parametrize(("ratio", "size"), [(Fraction(4, 3), (213, 96)), (Fraction(1, 2), (160, 192))])
def test_pixels_are_made_square(tmp_path, ratio, size):
    write(tmp_path / "a.mkv", "libx264", sample_aspect_ratio=ratio)
    (found, *_), notes = read(tmp_path / "a.mkv", [0])
    assert found.shape[1::-1] == size
    assert ["square" in note for note in notes] == [True]


@pytest.mark.parametrize(("codec", "kind"), [("libx264", "mp4"), ("mpeg2video", "mpegts")])
def test_interlaced_frames_are_deinterlaced(tmp_path, codec, kind):
    wall = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (288, 600, 3)).astype(np.uint8), (0, 0), 3)
    fields = [(wall[:, 16 * k : 16 * k + 352], wall[:, 16 * k + 8 : 16 * k + 360]) for k in range(10)]
    woven = [np.where(np.arange(288)[:, None, None] % 2, late, early) for early, late in fields]
    write(tmp_path / "a", codec, kind, frames=woven, options={"flags": "+ildct+ilme", "x264-params": "tff=1"})

    found, notes = read(tmp_path / "a")

    assert notes == ["interlaced frames were deinterlaced"]
    assert len(found) == len(numbers_of(tmp_path / "a")) == 10
    comb = [np.abs(one[1:-1:2].astype(float) - one[:-2:2]).mean() for one in (found[5], woven[5], fields[5][0])]
    assert comb[0] < 1.2 * comb[2] < 0.5 * comb[1]
    assert max(psnr(found[5], field) for field in fields[5]) > psnr(woven[5], fields[5][0]) + 3


def colored(values, **tags):
    """A frame of bars with these 16-bit values, as 10-bit video with these tags."""
    bars = np.tile(np.repeat(np.asarray(values, np.uint16), 16, axis=0)[None], (64, 1, 1))
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(bars), "rgb48le")
    frame = frame.reformat(format="yuv444p10le", dst_colorspace=tags["colorspace"], dst_color_range=tags["color_range"])
    for name, value in tags.items():
        setattr(frame, name, value)
    return frame


def bars_of(path):
    (found, *_), notes = read(path, [0])
    return found[32, 8::16].astype(int), notes


HLG, PQ, GRAYS = 18, 16, np.repeat(np.linspace(0, 65535, 9)[:, None], 3, axis=1)


@pytest.mark.parametrize("curve", [HLG, PQ])
def test_hdr_is_toned(tmp_path, curve):
    tags = {"colorspace": 9, "color_range": 1, "color_trc": curve, "color_primaries": 9}
    write(tmp_path / "a.mkv", "ffv1", frames=[colored(GRAYS, **tags)] * 2, pix_fmt="yuv444p10le", **tags)
    bars, notes = bars_of(tmp_path / "a.mkv")
    assert notes == [f"{'HLG' if curve == HLG else 'PQ'} colors were converted to sRGB"]
    assert np.ptp(bars, axis=1).max() <= 4  # gray
    levels = bars.mean(axis=1)
    assert levels[0] < 4 and levels[-1] > 250 and (np.diff(levels) > 3).all()
    # 75 % of HLG and 58 % of PQ are the white of a sheet of paper: bright, with room for lights above
    assert 130 < np.interp(0.75 if curve == HLG else 0.58, np.linspace(0, 1, 9), levels) < 220


def test_wide_colors_keep_their_saturation(tmp_path):
    """Red of BT.709 is a mixture in BT.2020."""
    tags = {"colorspace": 9, "color_range": 1, "color_trc": 1, "color_primaries": 9}
    red = 65535 * np.array([[0.6274, 0.0691, 0.0164]]) ** (1 / 2.4)
    write(tmp_path / "a.mkv", "ffv1", frames=[colored(red.repeat(8, 0), **tags)], pix_fmt="yuv444p10le", **tags)
    bars, _ = bars_of(tmp_path / "a.mkv")
    assert bars[4][0] > 245 and bars[4][1:].max() < 40  # 210, 84 and 46 if that were ignored


@pytest.mark.parametrize("matrix", [1, 5, 9, 2])
@pytest.mark.parametrize("full_range", [1, 2])
def test_the_matrix_and_the_range_of_colors_are_honored(tmp_path, matrix, full_range):
    values = [[65535, 0, 0], [0, 50000, 0], [10000, 20000, 60000], [65535] * 3, [0] * 3]
    tags = {"colorspace": 5 if matrix == 2 else matrix, "color_range": full_range}
    frame = colored(values, **tags)
    frame.colorspace = matrix  # 2: not said, and small, as before HDTV
    write(tmp_path / "a.mkv", "ffv1", frames=[frame], pix_fmt="yuv444p10le", colorspace=matrix, color_range=full_range)
    bars, _ = bars_of(tmp_path / "a.mkv")
    assert np.abs(bars - np.array(values) / 257).max() < 12  # JPEG has coarse colors


def test_a_large_picture_that_does_not_say_its_matrix_is_hdtv(tmp_path):
    green = np.tile(np.array([20, 200, 40], np.uint8), (720, 64, 1))
    frame = av.VideoFrame.from_ndarray(green, "rgb24").reformat(format="yuv444p", dst_colorspace=1, dst_color_range=1)
    frame.colorspace = 2
    write(tmp_path / "a.mkv", "ffv1", frames=[frame], pix_fmt="yuv444p")
    (found, *_), _ = read(tmp_path / "a.mkv", [0])
    assert found[300, 30].astype(int) == pytest.approx([20, 200, 40], abs=4)


def test_threads_do_not_change_pixels(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (12, 24, 40, 3)).astype(np.uint8)
    path = write(tmp_path / "a.mp4", "libx265", frames=[cv2.resize(one, (640, 384)) for one in noise])
    results = []
    for threads in (1, 5):
        with open_video(path) as found:
            found._stream.codec_context.thread_count = threads
            results.append(list(found.jpegs(range(12))))
    assert len(results[0]) == 12 and results[0] == results[1]


def cut(path):
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 6 // 10])


@pytest.mark.parametrize(("name", "codec"), [("a.avi", "mjpeg"), ("a.mkv", "mjpeg"), ("a.webm", "libvpx")])
def test_what_comes_before_the_damage_is_read(tmp_path, capfd, name, codec):
    path = write(tmp_path / name, codec)
    cut(path)
    with open_video(path) as found:
        frames = len(list(found.small_frames()))
    assert 5 <= frames <= 20
    assert found.is_cut_short
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "name", ["img%03d.avi", "concat:a.avi", "http:a.avi", "-i.avi", "*.avi", "\u00e4 b.avi", "\udcff.avi"]
)
def test_a_name_is_but_a_name(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "plain.avi").rename(tmp_path / name)
    assert len(numbers_of((tmp_path / name).relative_to(tmp_path))) == COUNT


LISTS = {
    "ffconcat": "ffconcat version 1.0\nfile {}\n",
    "m3u8": "#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{}\n#EXT-X-ENDLIST\n",
    "sdp": "v=0\no=- 0 0 IN IP4 127.0.0.1\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n",
}


@pytest.mark.parametrize("kind", LISTS)
@pytest.mark.parametrize("ending", ["mp4", "list"])
@pytest.mark.parametrize("begin", ["", "\0\0\0\x18ftypisom", "\0\0\1\xba"])
def test_lists_of_other_files_are_not_followed(tmp_path, kind, ending, begin):
    write(tmp_path / "a.ts", "mpeg4")
    path = tmp_path / f"x.{kind if ending == 'list' else ending}"
    path.write_text(begin + LISTS[kind].format("a.ts"), encoding="latin-1")
    with pytest.raises(UnreadableError), open_video(path) as found:
        assert not list(found.small_frames())
        raise UnreadableError("no frames")


def test_nothing_but_regular_files_is_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe.mp4")
    assert not is_video(read_head(tmp_path / "pipe.mp4"))
    assert not is_video(read_head(tmp_path))
    assert not is_video(read_head(tmp_path / "nothing.mp4"))


def test_recordings_that_begin_within_a_packet_are_videos(tmp_path):
    path = write(tmp_path / "a.ts", "mpeg2video", "mpegts", frames=pictures(60))
    path.write_bytes(path.read_bytes()[100:])
    assert len(numbers_of(path)) > 50


@pytest.mark.parametrize(("kind", "codec"), [("matroska", "aac"), ("flv", "aac"), ("ipod", "aac"), ("asf", "aac")])
def test_sound_is_no_video(tmp_path, kind, codec):
    sound(tmp_path / "x", kind, codec)
    assert not is_video(read_head(tmp_path / "x"))


@pytest.mark.parametrize("kind", ["mp4", "avi", "mpegts"])
def test_sound_without_a_video_is_named(tmp_path, kind):
    sound(tmp_path / "x", kind, "aac")
    with pytest.raises(UnreadableError, match="sound, but no video in this"), open_video(tmp_path / "x"):
        pass


def sound(path, kind, codec):
    with av.open(str(path), "w", format=kind) as made:
        stream = made.add_stream(codec, rate=44100, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.sample_rate = 44100
        made.mux(stream.encode(frame))
        made.mux(stream.encode())


@pytest.mark.parametrize(
    ("code", "reason"), [("xyz1", "its codec, xyz1, cannot be decoded"), ("drmi", "encrypted"), ("encv", "encrypted")]
)
def test_a_codec_that_cannot_be_decoded_is_named(tmp_path, code, reason):
    path = write(tmp_path / "a.mp4", "libx264")
    data = path.read_bytes()
    at = data.index(b"avc1", data.index(b"stsd"))
    path.write_bytes(data[:at] + code.encode() + data[at + 4 :])
    with pytest.raises(UnreadableError, match=reason), open_video(path):
        pass


def test_the_cover_of_an_album_is_no_video(tmp_path):
    with av.open(str(tmp_path / "a.mp4"), "w") as made:
        cover = made.add_stream("mjpeg", rate=1)
        cover.width, cover.height, cover.pix_fmt = *SIZE, "yuvj420p"
        cover.disposition = av.stream.Disposition.attached_pic
        stream = made.add_stream("aac", rate=44100, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.sample_rate = 44100
        made.mux(cover.encode(av.VideoFrame.from_ndarray(next(pictures()), "rgb24")))
        made.mux(stream.encode(frame))
        made.mux(stream.encode())
    with pytest.raises(UnreadableError, match="sound, but no video"), open_video(tmp_path / "a.mp4"):
        pass


def test_an_encrypted_video_says_so(tmp_path):
    path = write(
        tmp_path / "a.mp4",
        "libx264",
        muxer={"encryption_scheme": "cenc-aes-ctr", "encryption_key": "12" * 16, "encryption_kid": "34" * 16},
    )
    with pytest.raises(UnreadableError, match="encrypted"):
        numbers_of(path)


def test_a_bomb_of_pixels_is_refused(tmp_path):
    path = write(tmp_path / "a.mkv", "ffv1", frames=pictures(2, (1000, 1000)))
    data = path.read_bytes()
    for side in (b"\xb0\x82", b"\xba\x82"):
        assert side + b"\x03\xe8" in data
        data = data.replace(side + b"\x03\xe8", side + b"\xea\x60")
    path.write_bytes(data)
    assert numbers_of(path) == []


@pytest.mark.parametrize("kind", ["gif", "png"])
def test_a_picture_that_does_not_move_is_no_video(tmp_path, kind):
    Image.fromarray(next(pictures())).save(tmp_path / "x", kind)
    assert not is_video(read_head(tmp_path / "x"))


FUZZED = [("libx264", "mp4"), ("libvpx-vp9", "matroska"), ("mjpeg", "avi"), ("mpeg2video", "mpegts"), ("wmv2", "asf"),
          ("flv", "flv"), ("gif", "gif"), ("mpeg2video", "mxf")]  # fmt: skip


@pytest.mark.parametrize(("codec", "kind"), FUZZED)
def test_damage_gives_frames_or_a_reason(tmp_path, codec, kind):
    whole = write(
        tmp_path / "x", codec, kind, frames=pictures(8), **({"pix_fmt": PIXELS[codec]} if codec in PIXELS else {})
    ).read_bytes()
    readable = 0
    for seed in range(40):
        data, how = damaged(whole, seed)
        (tmp_path / "x").write_bytes(data)
        try:
            numbers = numbers_of(tmp_path / "x")
        except UnreadableError:
            continue
        readable += 1
        with open_video(tmp_path / "x") as found:
            assert [number for number, _ in found.jpegs(numbers)] == numbers, how
    assert readable >= 3


pytestmark = pytest.mark.slow

VIEW = VIEW_WIDTH, VIEW_HEIGHT = 240, 160
STEP_PX = 0.05 * VIEW_WIDTH


@pytest.fixture(scope="module")
def wall():
    """A wide texture."""
    blots = np.random.default_rng(1).integers(0, 255, (VIEW_HEIGHT, 2400)).astype(np.uint8)
    return cv2.GaussianBlur(blots, (0, 0), 2.0)


def film(wall, places, blurred=(), noise=0.0):
    """What frames from these places show."""
    rng = np.random.default_rng(2)
    for k, at in enumerate(places):
        shift = np.array([[1.0, 0.0, -at], [0.0, 1.0, 0.0]])
        frame = cv2.warpAffine(wall, shift, VIEW, flags=cv2.INTER_LINEAR).astype(np.float64)
        if k in blurred:
            frame = cv2.GaussianBlur(frame, (0, 0), 3.0)
        yield np.clip(frame + rng.normal(0, noise, frame.shape), 0, 255).astype(np.uint8)


def looks_at(frames):
    follower = CornerTracker()
    return [follower.track(k, frame) for k, frame in enumerate(frames)]


@pytest.fixture(scope="module")
def slide(wall):
    """FaceViews at 600 pixels of the way, three for each frame."""
    return looks_at(film(wall, np.arange(0, 600, 3.0)))


def chosen_from(frames, most=100):
    return list(select_keyframes(looks_at(frames), most).frames)


@pytest.mark.parametrize("speed_px", [0.7, 2.5, 5.0])
def test_frames_are_one_step_apart(wall, speed_px):
    places = np.arange(0, 60 + 100 * speed_px, speed_px)
    gaps = np.diff(places[chosen_from(film(wall, places))])
    assert gaps.min() >= 0.5 * STEP_PX - speed_px
    assert gaps.max() <= 1.5 * STEP_PX + speed_px
    assert 0.9 * STEP_PX < gaps.mean() < 1.1 * STEP_PX


@pytest.mark.parametrize(
    ("speed_px", "blurred"), [(2.0, range(1, 400, 2)), (2.0, range(40, 44)), (9.0, range(1, 99, 2))]
)
def test_a_blurred_frame_is_not_chosen_beside_a_sharp_one(wall, speed_px, blurred):
    places = np.arange(0, 300, speed_px)
    chosen = chosen_from(film(wall, places, blurred))
    assert not set(chosen) & set(blurred)
    assert len(chosen) >= 0.9 * 300 / max(STEP_PX, 2 * speed_px)


def test_where_all_is_blurred_the_overlap_is_kept(wall):
    places = np.arange(0, 400, 4.0)
    blurred = range(30, 75)
    chosen = chosen_from(film(wall, places, blurred))
    assert any(k in blurred for k in chosen)
    assert np.diff(places[chosen]).max() < 2.5 * STEP_PX


@pytest.mark.parametrize("noise", [0.0, 10.0])
def test_a_camera_that_stands_gives_one_frame(wall, noise):
    shaking = 300 + np.random.default_rng(3).uniform(-2.0, 2.0, 150)
    assert len(chosen_from(film(wall, shaking, range(40, 60), noise))) == 1


def test_a_rest_adds_nothing(wall):
    ways = np.arange(0, 200, 4.0), np.arange(200, 400, 4.0)
    rest = np.full(120, 200.0)
    without = chosen_from(film(wall, np.concatenate(ways)))
    resting = chosen_from(film(wall, np.concatenate([ways[0], rest, ways[1]]), noise=3.0))
    assert abs(len(resting) - len(without)) <= 1
    assert sum(len(ways[0]) <= k < len(ways[0]) + len(rest) for k in resting) <= 1


@pytest.mark.parametrize("most", [2, 5, 17])
def test_no_more_than_wanted_and_evenly(slide, most):
    places = np.arange(0, 600, 3.0)
    choice = select_keyframes(slide, most)
    gaps = np.diff(places[list(choice.frames)])
    assert len(choice.frames) == most
    assert gaps.max() < 600 / (most - 1) + STEP_PX + 3
    assert gaps.min() > 0.5 * 600 / (most - 1) - STEP_PX
    assert choice.rejected["more than max_frames"] == pytest.approx(
        len(select_keyframes(slide, 2000).frames) - most, abs=most
    )


def test_every_shot_of_a_cut_video_is_seen(wall):
    shots = np.repeat([0.0, 700.0, 1400.0], 20)
    chosen = chosen_from(film(wall, shots))
    assert [k // 20 for k in chosen] == [0, 1, 2]


def test_where_every_frame_shows_something_else_all_are_taken(wall):
    assert chosen_from(film(wall, np.arange(0, 2000, 130.0))) == list(range(16))


def test_forward_and_back_counts_both_ways(wall):
    there = np.arange(0, 240, 3.0)
    chosen = chosen_from(film(wall, np.concatenate([there, there[::-1]])))
    assert 2 * 240 / STEP_PX - 3 <= len(chosen) <= 2 * 240 / STEP_PX + 1


@pytest.mark.parametrize("value", [0, 255])
def test_an_empty_picture_shows_nothing_to_follow(value):
    follower = CornerTracker()
    looks = [follower.track(k, np.full((VIEW_HEIGHT, VIEW_WIDTH), value, np.uint8)) for k in range(5)]
    assert not follower.has_texture
    assert [look.path_steps for look in looks] == [0.0] * 5


@given(st.lists(st.tuples(st.floats(0, 1e5), st.floats(-0.9, 1.2)), min_size=1, max_size=60), st.integers(2, 20))
def test_any_looks_give_a_choice_in_order(steps, most):
    way = np.maximum(0.0, np.cumsum([step for _, step in steps]) - steps[0][1])
    looks = [TrackedFrame(3 * k, sharp, float(at)) for k, ((sharp, _), at) in enumerate(zip(steps, way, strict=True))]
    choice = select_keyframes(looks, most)
    assert 1 <= len(choice.frames) <= most
    assert list(choice.frames) == sorted(set(choice.frames))
    assert set(choice.frames) <= {look.frame for look in looks}
    assert len(choice.frames) + sum(choice.rejected.values()) == len(looks)
    assert min(choice.rejected.values(), default=1) > 0
