"""Frames of a video: read, tracked and chosen."""

import re
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.photos.decode import UnreadableError
from sfm_app.photos.files import container, read_head
from sfm_app.types.arrays import BoolArray, Float32Array, FloatArray, IndexArray

if TYPE_CHECKING:  # PyAV takes a tenth of a second to load
    from av import VideoFrame, VideoStream
    from av.container import InputContainer
    from av.filter import Graph

Picture = NDArray[np.uint8]

BLURRED = 0.5
"""A frame with less than this share of its neighbors' sharpness is blurred."""
MIN_CORNERS = 20
"""Motion is not estimated from fewer corners."""
MOST_PIXELS = 8192**2
"""Largest frame that is decoded: the square of 8K, as domes have it. A decoder holds a dozen of them."""
THREADS = 4
"""Threads of a decoder on every machine: after damage, their number decides which frames it gives."""
SAMPLES_PER_S = 30
SD_ROWS = 576
"""A picture with more rows has the colors of HDTV (BT.709) where the file does not say, as players take it."""
UNKNOWN = 2
"""Colors that are not stated, in ITU-T H.273."""
HDR = {16: "PQ", 18: "HLG"}
"""Transfer functions of H.273 whose white is brighter than that of a photo."""
WIDE = (9, 11, 12)
"""Primaries of H.273 beyond those of sRGB: BT.2020, DCI-P3 and Display P3."""
ENCRYPTED = "encrypted: no program but a player with its license reads it"


@contextmanager
def open_video(path: Path) -> Iterator["Video"]:
    """Provide a video that is open for one pass; raise an UnreadableError, also later, if it cannot be read.

    FFmpeg is told the container and may open files alone: it never follows playlists, URLs or patterns of names.
    """
    import av

    kind = container(read_head(path))
    if not kind:
        raise UnreadableError("not a video")
    options = {"protocol_whitelist": "file", "max_pixels": str(MOST_PIXELS)}
    try:
        with av.open(f"file:{path.resolve()}", "r", kind, options=options, metadata_errors="replace") as opened:
            yield Video(opened)
    except av.FFmpegError as err:
        raise UnreadableError(f"damaged, cut off, or no {av.ContainerFormat(kind).long_name} at all") from err


class Video:
    """An open video; frames are numbered from 0, progressive, upright, and in 8-bit sRGB with square pixels."""

    def __init__(self, opened: "InputContainer") -> None:
        self._opened, self._stream = opened, _find_stream(opened)
        context = self._stream.codec_context
        context.options = {"max_pixels": str(MOST_PIXELS)}
        context.thread_type, context.thread_count = "AUTO", THREADS
        self.codec: str = context.codec.canonical_name
        rate = float(self._stream.average_rate or 0)
        self._rate = rate if rate <= 240 else 0.0  # rates above are taken as wrong
        counted = self._stream.frames / self._rate if self._rate else 0.0
        units = (self._stream.duration, self._stream.time_base), (opened.duration, Fraction(1, 1_000_000))
        self.claimed_s = max(counted, *[float(n * unit) for n, unit in units if n and unit][:1], 0.0)
        """Duration as stated in the file, which may be wrong; 0 if it is not."""
        self.frames = 0
        """Number of frames read so far."""
        self.seconds = 0.0
        """Time of the last of them after the first."""
        self.notes: dict[str, None] = {}
        """What was done to the frames, for people."""
        self._converters: dict[tuple[object, ...], Graph] = {}

    @property
    def samples(self) -> int:
        """Expected number of sampled frames."""
        return max(1, int(self.claimed_s * min(self._rate or SAMPLES_PER_S, SAMPLES_PER_S)))

    @property
    def is_cut_short(self) -> bool:
        """Whether the file ended before 95 % of its stated duration; valid once all frames are read."""
        reordered_s = 4 / (self._rate or SAMPLES_PER_S)  # some files count these twice
        return self.seconds + reordered_s < 0.95 * self.claimed_s

    def small_frames(self) -> Iterator[tuple[int, Picture]]:
        """Yield gray pictures of about 30 frames per second, at most 480 px long, not turned, with their numbers."""
        last = -1
        size: tuple[int, int] | None = None
        for number, frame in self._read_frames():
            tick = int(self.seconds * SAMPLES_PER_S + 0.2) if self._rate else number
            if tick <= last or frame.is_corrupt:
                continue
            last = tick
            if size is None:
                width, height = self._square_size(frame)
                share = min(1.0, 480 / max(width, height))
                size = max(1, round(width * share)), max(1, round(height * share))
            yield number, self._convert(frame, size, "gray")

    def jpegs(self, numbers: Sequence[int]) -> Iterator[tuple[int, bytes]]:
        """Yield these frames at full size as JPEG, in ascending order; fewer if the file has changed."""
        missing = set(numbers)
        for number, frame in self._read_frames():
            if number in missing:
                picture = self._upright(frame, self._convert(frame, self._square_size(frame), "bgr24"))
                yield number, cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
                missing.remove(number)
            if not missing:
                return

    def _read_frames(self) -> Iterator[tuple[int, "VideoFrame"]]:
        start = 0.0
        for frame in self._deinterlace(self._decode()):
            time: float | None = frame.time
            if not self.frames:
                start = time or 0.0
            elif time is not None and time - start > self.seconds:
                self.seconds = time - start
            else:  # frames come in order: a time that goes back, as of B-frames in AVI, is wrong
                self.seconds += 1 / (self._rate or SAMPLES_PER_S)
            self.frames += 1
            yield self.frames - 1, frame

    def _decode(self) -> Iterator["VideoFrame"]:
        """Yield all frames that can be decoded; those after damage, too."""
        import av

        packets = self._opened.demux(self._stream)
        while True:
            try:
                packet = next(packets)
            except (StopIteration, av.FFmpegError):  # the end, or bytes of which nothing follows
                return
            if packet.has_sidedata("encryption_info"):
                raise UnreadableError(ENCRYPTED)
            try:
                frames = packet.decode()
            except av.FFmpegError:
                continue
            yield from frames

    def _deinterlace(self, frames: Iterator["VideoFrame"]) -> Iterator["VideoFrame"]:
        """Yield as many progressive frames. All frames from the first interlaced one go through the filter."""
        graph: Graph | None = None
        shape: tuple[object, ...] = ()
        for frame in frames:
            if graph is not None and shape != (frame.width, frame.height, frame.format.name):
                yield from _pull(graph, None)
                graph = None
            if graph is None and frame.interlaced_frame:
                self.notes["interlaced frames were deinterlaced"] = None
                graph = _make_graph(frame, ("bwdif", "mode=send_frame:deint=interlaced"))
                shape = frame.width, frame.height, frame.format.name
            if graph is None:
                yield frame
            else:
                yield from _pull(graph, frame)
        if graph is not None:
            yield from _pull(graph, None)

    def _square_size(self, frame: "VideoFrame") -> tuple[int, int]:
        """Return width and height with square pixels; the narrower side of the pixels is kept."""
        ratio = float(self._stream.sample_aspect_ratio or 1)
        if abs(ratio - 1) < 0.001 or not 1 / 4 < ratio < 4:  # an anamorphic lens has 2; more is a mistake
            return frame.width, frame.height
        self.notes[f"its pixels of {ratio:.2f} : 1 were made square"] = None
        return (round(frame.width * ratio), frame.height) if ratio > 1 else (frame.width, round(frame.height / ratio))

    def _convert(self, frame: "VideoFrame", size: tuple[int, int], kind: str) -> Picture:
        """Return the frame in BT.709 at full range: (H, W) gray, or (H, W, 3) in colors that a screen can show."""
        width, height = size
        area = "area" if kind == "gray" else "bicubic"
        arguments = f"{width}:{height}:flags={area}+accurate_rnd+full_chroma_int+bitexact:out_range=pc"
        if frame.colorspace == UNKNOWN and frame.height > SD_ROWS and "rgb" not in frame.format.name:
            arguments += ":in_color_matrix=bt709"
        if frame.color_trc in HDR or frame.color_primaries in WIDE:
            self.notes[f"{HDR.get(frame.color_trc, 'wide')} colors were converted to sRGB"] = None
            tone = "iec61966-2-1:intent=perceptual" if frame.color_trc in HDR else "bt709"
            arguments += "" if kind == "gray" else f":out_primaries=bt709:out_transfer={tone}"
        key = frame.width, frame.height, frame.format.name, arguments, kind
        if key not in self._converters:
            self._converters = {key: _make_graph(frame, ("scale", arguments), ("format", kind))}
        (converted,) = _pull(self._converters[key], frame)
        return np.asarray(converted.to_ndarray(), np.uint8)

    @staticmethod
    def _upright(frame: "VideoFrame", picture: Picture) -> Picture:
        """Turn and mirror a picture as the display matrix of its frame says."""
        side_data: Any = frame.side_data
        if (matrix := side_data.get("DISPLAYMATRIX")) is None:
            return picture
        (a, b), (c, d) = np.frombuffer(bytes(matrix), np.int32).reshape(3, 3)[:2, :2].tolist()
        across, down = a, d
        if abs(b) + abs(c) > abs(a) + abs(d):
            picture, across, down = picture.swapaxes(0, 1), c, b  # x' = ax + cy, y' = bx + dy
        return np.ascontiguousarray(picture[:: -1 if down < 0 else 1, :: -1 if across < 0 else 1])


def _find_stream(opened: "InputContainer") -> "VideoStream":
    """Return the largest stream of frames; raise an UnreadableError if there is none, or none that is decoded."""
    from av.stream import Disposition

    pictures = Disposition.attached_pic | Disposition.timed_thumbnails
    streams = [stream for stream in opened.streams.video if not stream.disposition & pictures]
    if not streams:
        has = "sound, but no video" if opened.streams.audio else "no video"
        raise UnreadableError(f"there is {has} in this {opened.format.long_name} file")
    known = [stream for stream in streams if stream.codec_context is not None]
    if not known:
        name = _codec_name(opened)
        raise UnreadableError(ENCRYPTED if name in ("encv", "drmi") else f"its codec, {name}, cannot be decoded")
    return max(known, key=lambda stream: stream.width * stream.height)


def _codec_name(opened: Any) -> str:
    """Return the name of the first codec, which PyAV has of known decoders only."""
    import av

    before = av.logging.get_level()
    try:
        av.logging.set_level(av.logging.INFO)
        told = re.search(r"Video: (none )?\(?(\w+)", opened.dumps_format())
    finally:
        av.logging.set_level(before)
    return told[2] if told and told[2] != "none" else "an unknown one"


def _make_graph(frame: "VideoFrame", *filters: tuple[str, str]) -> "Graph":
    from av.filter import Graph

    graph = Graph()
    unit = frame.time_base or Fraction(1, SAMPLES_PER_S)
    source = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=unit)
    nodes = [graph.add(name, arguments) for name, arguments in filters]
    graph.link_nodes(source, *nodes, graph.add("buffersink")).configure()
    return graph


def _pull(graph: "Graph", frame: "VideoFrame | None") -> Iterator["VideoFrame"]:
    """Push a frame, or the end, and yield the frames that are done."""
    graph.vpush(frame)
    while True:
        try:
            yield graph.vpull()
        except (BlockingIOError, EOFError):
            return


class OPTIONS:
    """Constants of the measurement of motion and sharpness."""

    step: float = 0.05
    """One step of motion: the median displacement of the corners, as a share of the longer side."""
    max_blurred_steps: float = 1.5
    """A blurred frame becomes the reference only after this many steps."""
    min_tracked: float = 0.6
    """Tracking a smaller share of the corners also counts as a step, since the overlap shrinks."""
    recent: int = 30
    """Number of frames that sharpness is compared with; a blur longer than most of them counts as normal."""
    sharp_percentile: int = 80
    """Percentile of the recent sharpness that stands for a sharp frame, even if most are blurred."""
    corners: int = 200
    forward_backward_px: float = 1.0
    """Largest forward-backward error of a tracked corner."""
    window_px: int = 15
    """Window of the Lucas-Kanade method."""
    levels: int = 3
    """Its pyramid levels."""


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """Measurements of one frame."""

    frame: int
    sharpness: float
    """Variance of the Laplacian; comparable only between neighboring frames."""
    path_steps: float
    """Accumulated motion from the first frame to this one, in steps."""


class CornerTracker:
    """Tracks corners from a reference to each frame; after one step, the next sharp frame becomes the reference.

    Frames are compared with the reference, not with the previous frame: otherwise noise and camera shake would add up
    to motion of a camera that stands still.
    """

    def __init__(self) -> None:
        self.has_texture = False
        """Whether any frame had enough corners to track."""
        self._reference_steps = 0.0
        self._reference: Picture | None = None
        self._corners = np.zeros((0, 1, 2), np.float32)
        self._last = self._corners
        self._motion = 0.0
        self._recent: deque[float] = deque(maxlen=OPTIONS.recent)

    def track(self, frame: int, gray: Picture) -> TrackedFrame:
        """Measure sharpness and accumulated motion of the next frame, a gray picture (H, W) of constant size."""
        sharpness = float(cv2.Laplacian(gray, cv2.CV_32F).var())
        self._recent.append(sharpness)
        if self._reference is None or len(self._corners) < MIN_CORNERS:
            self._set_reference(gray)
            return TrackedFrame(frame, sharpness, self._reference_steps)
        self._motion, tracked = self._track_corners(self._reference, gray)
        # corners lost to blur reappear later, so they do not count as lost overlap
        blurred = sharpness < BLURRED * float(np.percentile(self._recent, OPTIONS.sharp_percentile))
        lost = 0.0 if blurred else min(1.0, (1 - tracked) / (1 - OPTIONS.min_tracked))
        steps = max(self._motion / OPTIONS.step, lost)
        path_steps = self._reference_steps + steps
        if steps >= (OPTIONS.max_blurred_steps if blurred else 1.0):
            self._reference_steps = path_steps
            self._set_reference(gray)
        return TrackedFrame(frame, sharpness, path_steps)

    def _set_reference(self, gray: Picture) -> None:
        corners = cv2.goodFeaturesToTrack(gray, OPTIONS.corners, qualityLevel=0.01, minDistance=max(gray.shape) / 60)
        self._reference, self._motion = gray, 0.0
        self._corners = np.zeros((0, 1, 2), np.float32) if corners is None else np.asarray(corners, np.float32)
        self._last = self._corners
        self.has_texture = self.has_texture or len(self._corners) >= MIN_CORNERS

    def _track_corners(self, reference: Picture, gray: Picture) -> tuple[float, float]:
        """Return the median displacement of the corners in longer sides, and the share of tracked corners."""
        forward, found = _optical_flow(reference, gray, self._corners, self._last)
        back, found_back = _optical_flow(gray, reference, forward, self._corners)
        error = np.linalg.norm(back - self._corners, axis=2)[:, 0]
        inside = np.all((forward[:, 0] >= 0) & (forward[:, 0] < gray.shape[::-1]), axis=1)
        tracked = found & found_back & (error < OPTIONS.forward_backward_px) & inside
        if np.count_nonzero(tracked) < MIN_CORNERS:
            return self._motion, float(np.mean(tracked))
        flow = (forward - self._corners)[tracked, 0]
        # the next search for lost corners starts from the median flow
        guess = np.where(tracked[:, None, None], forward, self._corners + np.median(flow, axis=0))
        self._last = guess.astype(np.float32)
        return float(np.median(np.linalg.norm(flow, axis=1))) / max(gray.shape), float(np.mean(tracked))


def _optical_flow(
    before: Picture, after: Picture, points: Float32Array, guess: Float32Array
) -> tuple[Float32Array, BoolArray]:
    """Find points (N, 1, 2) of one picture in another; return their positions, and (N,) whether each was found."""
    positions, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, guess.copy(),
        winSize=(OPTIONS.window_px, OPTIONS.window_px), maxLevel=OPTIONS.levels, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return positions, found[:, 0] > 0


@dataclass(frozen=True, slots=True)
class Choice:
    """Chosen frames in ascending order, and why the others were not chosen."""

    frames: tuple[int, ...]
    rejected: dict[str, int]
    """Number of frames by reason; each measured frame is either chosen or counted once."""


def select_keyframes(frames: Sequence[TrackedFrame], most: int) -> Choice:
    """Choose one frame per step of motion; the spacing grows if that would be more than `most` >= 2 frames."""
    path = np.array([frame.path_steps for frame in frames], np.float64)
    sharpness = np.array([frame.sharpness for frame in frames], np.float64)
    if not len(path):
        return Choice((), {})
    every, candidates = sharpest_frames(path, sharpness, 1.0)
    chosen = every
    if len(every) > most:
        chosen, candidates = sharpest_frames(path, sharpness, float(path.max()) / (most - 1) * (1 - 1e-12))
    others = set(range(len(frames))) - set(chosen)
    too_many = others & set(every)
    less_sharp = (others & candidates) - too_many
    counts = {
        "hardly moved on": len(others) - len(too_many) - len(less_sharp),
        "less sharp than a neighbor": len(less_sharp),
        "more than max_frames": len(too_many),
    }
    return Choice(tuple(frames[k].frame for k in chosen), {reason: count for reason, count in counts.items() if count})


def sharpest_frames(path: FloatArray, sharpness: FloatArray, spacing: float) -> tuple[list[int], set[int]]:
    """Return the sharpest frame near every multiple of a spacing >= 1, and all candidates.

    It lies within 0.25 steps of the multiple, or within 0.5 steps if the nearer frames are all blurred. A blurred frame
    is chosen only 1.5 steps or more after the last one. The path is the accumulated motion in steps.
    """
    chosen: list[int] = []
    candidates: set[int] = set()
    for target in np.arange(0.0, path.max() + 1e-9, spacing):
        moment = int(np.argmax(path >= min(target, path.max())))
        if chosen and moment <= chosen[-1]:
            continue
        first = chosen[-1] + 1 if chosen else 0
        near = _nearby_frames(path, moment, target, 0.25, first)
        sharp = BLURRED * sharpness[_nearby_frames(path, moment, target, 1.0, 0)].max()
        best = _sharpest_frame(sharpness, near)
        if sharpness[best] < sharp:
            best = _sharpest_frame(sharpness, _nearby_frames(path, moment, target, 0.5, first))
        candidates.update(map(int, near))
        if sharpness[best] >= sharp or not chosen or path[best] - path[chosen[-1]] >= 1.5:
            chosen.append(best)
    return chosen, candidates


def _sharpest_frame(sharpness: FloatArray, frames: IndexArray) -> int:
    return int(frames[np.argmax(sharpness[frames])])


def _nearby_frames(path: FloatArray, moment: int, target: float, reach: float, first: int) -> IndexArray:
    """Return the consecutive frames around a moment whose motion is within `reach` steps of the target."""
    outside = np.abs(path - target) > reach
    outside[:first] = True
    before = np.flatnonzero(outside[:moment])
    after = np.flatnonzero(outside[moment + 1 :])
    start = int(before[-1]) + 1 if len(before) else 0
    end = moment + 1 + int(after[0]) if len(after) else len(path)
    return np.arange(max(start, first), end, dtype=np.int64)
