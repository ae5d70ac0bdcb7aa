"""The chosen frames of a video, written to OUT/frames as a folder of photos."""

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sfm_app.atomic_io import replace_atomically
from sfm_app.errors import InputError
from sfm_app.photos import CornerTracker, UnreadableError, open_video, select_keyframes
from sfm_app.progress import track
from sfm_app.runtime.context import RunContext

HINT = "walk around while you film, slowly, and keep the object in view"
DAMAGED = "play it to see whether it is whole; save it as MP4 with H.264"
INTERLACED = "save it deinterlaced (progressive), as MP4 with H.264"
BLACK = "black"
LONGEST_STEM = 40


@dataclass(frozen=True, slots=True)
class FrameChoice:
    """The choice of frames of a video."""

    made_from: str
    """Fingerprint of the inputs."""
    frames: tuple[int, ...]
    """Numbers of the chosen frames."""
    times_s: tuple[float, ...]
    """When they were taken."""
    counts: Mapping[str, Any]
    """Figures for the manifest."""


@dataclass(frozen=True, slots=True)
class VideoFrames:
    """The chosen frames of a video as a folder."""

    folder: Path
    times_s: Mapping[str, float]
    """When they were taken, by file name."""


@contextmanager
def video_frames(source: Path, run: RunContext) -> Iterator[VideoFrames]:
    """Provide a folder with the chosen frames of a video.

    If the run is killed before the block ends, the next one keeps the choice.

    Args:
        source: video file.
        run: the run.

    Raises:
        InputError: the video cannot be read, or shows too little.
    """
    chosen = read_choice(run)
    if chosen is None:
        chosen = choose_frames(source, run)
        shutil.rmtree(run.workspace.frames, ignore_errors=True)
        with replace_atomically(run.workspace.frames_marker) as path:
            path.write_text(json.dumps(asdict(chosen)), encoding="utf-8", newline="\n")
    _write_frames(source, chosen.frames, run)
    run.record(video=chosen.counts)
    names = (frame_name(source, frame) for frame in chosen.frames)
    yield VideoFrames(run.workspace.frames, dict(zip(names, chosen.times_s, strict=True)))
    run.workspace.frames_marker.unlink()


def read_choice(run: RunContext) -> FrameChoice | None:
    """Return the choice of a killed run from the same inputs; None where there is none."""
    try:
        found = json.loads(run.workspace.frames_marker.read_text(encoding="utf-8"))
        frames, times_s = tuple(map(int, found["frames"])), tuple(map(float, found["times_s"]))
        chosen = FrameChoice(found["made_from"], frames, times_s, dict(found["counts"]))
    except (OSError, ValueError, TypeError, LookupError):
        return None
    return chosen if chosen.made_from == run.fingerprint and len(times_s) == len(frames) else None


def choose_frames(source: Path, run: RunContext) -> FrameChoice:
    """Choose frames from the whole video.

    Args:
        source: video file.
        run: the run.
    """
    most = run.settings.photos.max_frames
    try:
        with open_video(source) as video:
            follower = CornerTracker()
            pictures = track(run.progress, video.small_frames(), "looking at frames", video.sample_count)
            looks, moments = [], {}
            for number, small in pictures:
                looks.append(follower.track(number, small))
                moments[number] = video.seconds
    except UnreadableError as err:
        raise InputError(f"cannot read {source}: {err}", hint=DAMAGED) from err
    looked_at, notes = len(looks) + video.black, []
    if video.black and not looks:
        raise InputError(f"cannot read {source}: all frames come out black, as interlaced ones do", hint=INTERLACED)
    if video.is_cut_short:
        looks = looks[:-1]  # it may be half a picture
        notes = [f"the file is cut off or damaged after {video.seconds:.1f} s; what comes before is used"]
    if not looks:
        raise InputError(f"cannot read {source}: no frame can be decoded", hint=DAMAGED)
    choice = select_keyframes(looks, most)
    if len(choice.frames) < 2:
        why = "the camera does not move" if follower.seen else "there is hardly any texture to follow"
        raise InputError(f"{why} in {source}: {video.frames} frames, and all show one view", hint=HINT)
    counts = {
        "frames": video.frames,
        "seconds": round(video.seconds, 2),
        "looked_at": looked_at,
        "chosen": len(choice.frames),
        "left_out": choice.left_out | ({BLACK: video.black} if video.black else {}),
        "notes": notes,
    }
    return FrameChoice(run.fingerprint, choice.frames, tuple(moments[frame] for frame in choice.frames), counts)


def _write_frames(source: Path, frames: tuple[int, ...], run: RunContext) -> None:
    """Write the frames that are not there yet."""
    for half in run.workspace.frames.glob(".*"):  # incomplete files of a killed run
        half.unlink()
    places = {frame: run.workspace.frames / frame_name(source, frame) for frame in frames}
    missing = [frame for frame, place in places.items() if not place.exists()]
    if not missing:
        return
    written = 0
    try:
        with open_video(source) as video:
            for frame, data in track(run.progress, video.jpegs(missing), "writing frames", len(missing)):
                with replace_atomically(places[frame]) as path:
                    path.write_bytes(data)
                written += 1
    except UnreadableError as err:
        raise InputError(f"cannot read {source}: {err}", hint=DAMAGED) from err
    if written < len(missing):
        raise InputError(f"{source} has changed while it was read", hint="run again once it is restored")


def frame_name(source: Path, frame: int) -> str:
    """Return the name of the file of a frame.

    Args:
        source: video file.
        frame: its number.
    """
    return f"{frame_stem(source)}_{frame:06d}.jpg"


def frame_stem(source: Path) -> str:
    """Return the stem of the names of a video's frames: short, printable and not hidden."""
    printable = "".join(c if c.isprintable() else "_" for c in source.stem)
    return printable.lstrip(".")[:LONGEST_STEM] or "frame"
