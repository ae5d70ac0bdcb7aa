"""photos: folder or video -> PhotoSet."""

import errno
import json
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from sfm_app.errors import InputError
from sfm_app.files import UNFINISHED, digest_files, replace_atomically
from sfm_app.operating_system import is_link, share_bytes
from sfm_app.photos.decode import UnreadableError
from sfm_app.photos.files import list_files, resolve_file
from sfm_app.photos.masks import MASK_HINT, assign_masks, check_mask, lay_out_mask, mask_path, unused_masks
from sfm_app.photos.probe import group_by_camera, read_photo, split_by_given_camera, with_one_zero
from sfm_app.photos.selection import COPY, OPTIONS, PhotoStats, drop_duplicates, drop_unusable, read_stats, write_stats
from sfm_app.photos.source import Source, assign_names, is_laid_out, lay_out
from sfm_app.photos.video import MOST_PIXELS, CornerTracker, open_video, select_keyframes
from sfm_app.products import read_copy_hashes, read_photo_list, write_photo_list
from sfm_app.progress import track
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.cost_estimate import largest_photo_megapixels
from sfm_app.settings import PhotoSettings
from sfm_app.tasks import Task
from sfm_app.types import Photo, PhotoSet, UnusablePhoto

MANY_FILES = 5000
"""Number of files above which the folder may be a wrong one, such as a home. Chosen by hand."""
DAMAGED = "play it to see whether it is whole; save it as MP4 with H.264"


@dataclass(frozen=True, slots=True)
class FrameChoice:
    """The chosen frames of a video."""

    made_from: str
    frames: tuple[int, ...]
    times_s: tuple[float, ...]
    """Timestamps of the frames, in seconds."""
    counts: Mapping[str, Any]
    """Figures for the manifest."""


@contextmanager
def video_frames(source: Path, run: RunContext, name: str = "", most: int = 0) -> Iterator[dict[str, float]]:
    """Write the chosen frames of a video to OUT/frames, and provide their timestamps in seconds by file name.

    One of several videos has a folder of its `name` there, and `most` frames. If the run is killed before the block
    ends, the next one keeps the choice. Raise an InputError if the video cannot be read or shows too little motion.
    """
    folder, marker = run.workspace.frames / name, _marker(run, name)
    choice = read_choice(run, marker)
    if choice is None:
        choice = choose_frames(source, run, most or run.settings.photos.max_frames)
        shutil.rmtree(folder, ignore_errors=True)
        with replace_atomically(marker) as path:
            path.write_text(json.dumps(asdict(choice)), encoding="utf-8", newline="\n")
    _write_frames(source, choice.frames, folder, run)
    run.record(video=choice.counts)
    names = (f"{name}/{frame_name(source, frame)}".lstrip("/") for frame in choice.frames)
    yield dict(zip(names, choice.times_s, strict=True))
    marker.unlink()


def _marker(run: RunContext, name: str) -> Path:
    return run.workspace.frames / name / UNFINISHED if name else run.workspace.frames_marker


@contextmanager
def gathered_frames(source: Source, run: RunContext) -> Iterator[tuple[dict[str, float], list[UnusablePhoto]]]:
    """Fill OUT/frames with photos and the frames of videos, as in `video_frames`; also provide unusable ones."""
    times_s, refused, counts = dict[str, float](), list[UnusablePhoto](), dict[str, Mapping[str, Any]]()
    if not any(read_choice(run, _marker(run, name)) for name in source.videos):
        shutil.rmtree(run.workspace.frames, ignore_errors=True)
    with ExitStack() as opened:
        for name, most in _share_frames(source, run.settings.photos.max_frames).items():
            video = source.path / name
            try:
                times_s |= opened.enter_context(video_frames(video, run, name, most))
                counts[source.label(name)] = run.statistics.pop("video")
            except InputError as err:
                reason = err.message.replace(str(video), "it")
                refused.append(UnusablePhoto(source.label(name), reason))
        for name in source.digests().keys() - set(source.videos):
            place, file = run.workspace.frames / name, resolve_file(source.path, name)
            place.parent.mkdir(parents=True, exist_ok=True)
            place.unlink(missing_ok=True)
            if isinstance(file, Path):
                share_bytes(file, place)
        if counts:
            run.record(video=_sum_counts(counts))
        yield times_s, refused


def _share_frames(source: Source, most: int) -> dict[str, int]:
    """Return the most frames of each video: at least two."""
    seconds = []
    for name in source.videos:
        try:
            with open_video(source.path / name) as video:
                seconds.append(video.claimed_s)
        except UnreadableError:
            seconds.append(0.0)
    shares = seconds if all(seconds) else [1.0] * len(seconds)
    return {name: max(2, int(most * one / sum(shares))) for name, one in zip(source.videos, shares, strict=True)}


def _sum_counts(videos: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the figures of several videos as of one."""
    left_out = Counter[str]()
    for counts in videos.values():
        left_out.update(counts["left_out"])
    sums = {key: sum(counts[key] for counts in videos.values()) for key in ("frames", "seconds", "looked_at", "chosen")}
    notes = [f"{label}: {note}" for label, counts in videos.items() for note in counts["notes"]]
    return sums | {"left_out": dict(left_out), "notes": notes}


def read_choice(run: RunContext, marker: Path) -> FrameChoice | None:
    """Return the choice of a killed run from the same inputs, or None."""
    try:
        values = json.loads(marker.read_text(encoding="utf-8"))
        frames, times_s = tuple(map(int, values["frames"])), tuple(map(float, values["times_s"]))
        choice = FrameChoice(values["made_from"], frames, times_s, dict(values["counts"]))
    except (OSError, ValueError, TypeError, LookupError):
        return None
    return choice if choice.made_from == run.fingerprint and len(times_s) == len(frames) else None


def choose_frames(source: Path, run: RunContext, most: int) -> FrameChoice:
    """Choose at most so many frames from the whole video."""
    try:
        with open_video(source) as video:
            tracker = CornerTracker()
            pictures = track(run.progress, video.small_frames(), "tracking frames", video.samples)
            tracked, times_s = [], {}
            for number, small in pictures:
                tracked.append(tracker.track(number, small))
                times_s[number] = video.seconds
    except UnreadableError as err:
        raise InputError(f"cannot read {source}: {err}", hint=DAMAGED) from err
    sampled, notes = len(tracked), list(video.notes)
    if video.is_cut_short:
        tracked = tracked[:-1]  # it may be half a picture
        notes.append(f"the file is cut off or damaged after {video.seconds:.1f} s; the frames before are used")
    if not tracked:
        limit = f"of at most {MOST_PIXELS // 10**6} megapixels"
        raise InputError(f"cannot read {source}: no frame of its {video.codec}, {limit}, can be decoded", hint=DAMAGED)
    choice = select_keyframes(tracked, most)
    if len(choice.frames) < 2:
        problem = "the camera does not move" if tracker.has_texture else "there is too little texture to track"
        hint = "walk around while you film, slowly, and keep the object in view"
        raise InputError(f"{problem} in {source}: its {video.frames} frames show one view", hint=hint)
    counts = {
        "frames": video.frames,
        "seconds": round(video.seconds, 2),
        "looked_at": sampled,
        "chosen": len(choice.frames),
        "left_out": choice.rejected,
        "notes": notes,
    }
    return FrameChoice(run.fingerprint, choice.frames, tuple(times_s[frame] for frame in choice.frames), counts)


def _write_frames(source: Path, frames: tuple[int, ...], folder: Path, run: RunContext) -> None:
    for incomplete in folder.glob(".*"):  # files of a killed run
        incomplete.unlink()
    places = {frame: folder / frame_name(source, frame) for frame in frames}
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
    """Return the file name of a frame of a video."""
    return f"{frame_stem(source)}_{frame:06d}.jpg"


def frame_stem(source: Path) -> str:
    """Return the stem of a video's frames: short, printable and not hidden."""
    printable = "".join(c if c.isprintable() else "_" for c in source.stem)
    return printable.lstrip(".")[:40] or "frame"


def make(source: Source, run: RunContext) -> PhotoSet:
    """Read a folder or a video, and lay the usable photos out for COLMAP; raise an InputError if too few are."""
    folder = run.workspace.frames
    if source.videos:
        with gathered_frames(source, run) as (times_s, refused):
            names = sorted([*(source.files.keys() - set(source.videos)), *times_s])
            return _read_photos(source, folder, names, times_s, run, refused)
    if not source.video:
        return _read_photos(source, source.path, list(source.files), {}, run)
    with video_frames(source.path, run) as times_s:
        return _read_photos(source, folder, list_files(folder, run.workspace.root), times_s, run)


def load(source: Source, run: RunContext) -> PhotoSet:
    """Read photos.json back; laid-out photos that are missing or damaged are laid out again."""
    return _read_photo_set(run.workspace.frames if source.video or source.videos else source.path, source.mask_dir, run)


def _read_photos(
    source: Source, folder: Path, names: Sequence[str], times_s: Mapping[str, float], run: RunContext,
    refused: Sequence[UnusablePhoto] = (),
) -> PhotoSet:  # fmt: skip
    options = run.settings.photos
    if run.settings.max_memory_gb:
        largest = min(options.max_megapixels, largest_photo_megapixels(run.memory_mb))
        options = options.model_copy(update={"max_megapixels": largest})
    contents = read_all(source, folder, names, options, run)
    unreadable = [UnusablePhoto(source.label(name), reason) for name, reason in source.left_out.items()]
    bad = [photo for photo in contents if isinstance(photo, UnusablePhoto)]
    unreadable += [*refused, *(replace(photo, name=source.label(photo.name)) for photo in bad)]
    good = [one for one in contents if isinstance(one, PhotoStats)]
    if source.named:
        good = [replace(one, photo=_as_gathered(one.photo, source)) for one in good]
    stats, masked = attach_masks(good, folder, source, run)
    photos, useless = select_photos(stats, keep_low_quality=options.keep_low_quality)
    unusable = sorted(unreadable + masked + useless, key=lambda photo: photo.name)
    alike = sum(COPY in photo.reason for photo in useless)
    if alike >= OPTIONS.many_copies * len(stats) > 0:
        run.progress.say(
            f"{alike} of {len(stats)} photos show the same as others: copies, or the camera hardly moves; "
            "walk around what is photographed"
        )
    if len(photos) < 2:
        raise InputError(
            _too_few_message("the inputs" if source.named else str(folder), len(photos), unusable),
            hint="at least two photos of a place are needed; 10 to 50 work best",
            photos={photo.name: photo.reason for photo in unusable},
        )
    known = [replace(photo, gps=source.positions.get(photo.path, photo.gps)) for photo in photos]
    timed = [replace(photo, time_s=times_s.get(photo.path)) for photo in with_one_zero(known)]
    named = tuple(split_by_given_camera(list(assign_names(group_by_camera(timed, options.cameras))), run.given))
    photo_set = PhotoSet(folder, named, tuple(unusable), source.mask_dir)
    for place in (run.workspace.photos, run.workspace.masks):
        shutil.rmtree(place, ignore_errors=True)
    run.map(Task(lay_out_photo, folder=folder, target=run.workspace.photos), photo_set.photos, "laying photos out")
    if photo_set.has_masks:
        lay_out = Task(lay_out_mask, folder=folder, masks=source.mask_dir, target=run.workspace.masks)
        hiding = run.map(lay_out, photo_set.photos, "laying masks out")
        run.record(masks=_mask_counts(photo_set.photos, hiding, list(source.masks)))
    copies = {photo.name: _copy_digest(photo, run) for photo in photo_set.photos}
    write_photo_list(photo_set, copies, run.workspace)
    run.record(usable=len(photos), cameras=len(photo_set.groups), unusable={p.name: p.reason for p in unusable})
    run.record(notes={photo.label: list(photo.notes) for photo in photos if photo.notes})
    run.record(gps=sum(photo.gps is not None for photo in timed), missing=dict(source.missing))
    return photo_set


def read_all(
    source: Source, folder: Path, names: Sequence[str], options: PhotoSettings, run: RunContext
) -> list[PhotoStats | UnusablePhoto]:
    """Return the contents of the files of a folder; files that an earlier run has read are not decoded again."""
    digests, store = source.digests(), run.workspace.photo_stats
    known: dict[str, PhotoStats | UnusablePhoto] = {**read_stats(store, digests, options)}
    new = [name for name in names if name not in known]
    if len(new) > MANY_FILES:
        run.progress.say(f"{len(new):,} files: if this is not the folder of the photos, stop with Ctrl-C")
    contents = known | dict(zip(new, run.map(Task(read_photo, folder, options=options), new, "photos"), strict=True))
    usable = {name: one for name in names if isinstance(one := contents[name], PhotoStats)}
    if new and usable.keys() & digests.keys():
        write_stats(store, usable, digests, options)
    return [contents[name] for name in names]


def select_photos(stats: list[PhotoStats], *, keep_low_quality: bool) -> tuple[list[Photo], list[UnusablePhoto]]:
    """Return the useful photos and the useless ones: blurred photos, screenshots and copies, unless these stay."""
    if keep_low_quality:
        return [one.photo for one in stats], []
    usable, unusable = drop_unusable(stats)
    photos, copies = drop_duplicates(usable)
    return photos, unusable + copies


def attach_masks(
    stats: list[PhotoStats], folder: Path, source: Source, run: RunContext
) -> tuple[list[PhotoStats], list[UnusablePhoto]]:
    """Return the photos with masks, and the completely masked ones; raise an InputError if a mask cannot be used."""
    masks = source.mask_dir
    if masks is None:
        return stats, []
    assigned = assign_masks([one.photo for one in stats], source.masks, for_all=source.one_mask)
    if stats and not any(photo.mask for photo in assigned):
        raise InputError(f"none of the {len(source.masks)} files in {masks} is the mask of a photo", hint=MASK_HINT)
    photos = run.map(Task(check_mask, folder=folder, masks=masks), assigned, "masks")
    used = [replace(one, photo=photo) for one, photo in zip(stats, photos, strict=True) if isinstance(photo, Photo)]
    return used, [photo for photo in photos if isinstance(photo, UnusablePhoto)]


def _as_gathered(photo: Photo, source: Source) -> Photo:
    """Return the photo with the user's name; the frames of each video are a camera of their own."""
    video = photo.path.rpartition("/")[0]
    group = " ".join(filter(None, (photo.group, video))) if video in source.videos else photo.group
    return replace(photo, named=source.label(photo.path), group=group)


def _mask_counts(photos: Sequence[Photo], hiding: Sequence[bool], names: list[str]) -> dict[str, Any]:
    """Return the manifest's entry: photos with a mask, those whose mask hides nothing, and files that are no mask."""
    white = [photo.label for photo, hides in zip(photos, hiding, strict=True) if photo.mask and not hides]
    masked = sum(bool(photo.mask or photo.cut_out) for photo in photos)
    return {"photos": masked, "unused": unused_masks(names, photos)} | ({"white": white} if white else {})


def lay_out_photo(photo: Photo, *, folder: Path, target: Path) -> None:
    """Put one photo into the workspace; raise an InputError if it has changed since it was first read."""
    try:
        lay_out(photo, folder, target)
    except UnreadableError as err:
        raise InputError(f"{photo.label} has changed while it was read: {err}", hint="restore it") from err


def _copy_digest(photo: Photo, run: RunContext) -> str | None:
    """Return a hash of the bytes of an 8-bit copy; None if the photo itself is laid out, or nothing."""
    place = run.workspace.photos / photo.name
    is_copy = photo.needs_copy and place.is_file() and not is_link(place)
    return digest_files(run.workspace.photos, photo.name) if is_copy else None


def _read_photo_set(folder: Path, masks: Path | None, run: RunContext) -> PhotoSet:
    photo_set = replace(read_photo_list(run.workspace), folder=folder, masks=masks)
    copies = read_copy_hashes(run.workspace)
    for photo in photo_set.photos:
        copy = copies.get(photo.name)
        if copy != _copy_digest(photo, run) or not (copy or is_laid_out(photo, folder, run.workspace.photos)):
            if folder == run.workspace.frames and not (folder / photo.path).exists():
                raise FileNotFoundError(errno.ENOENT, "no such frame", str(folder / photo.path))
            lay_out_photo(photo, folder=folder, target=run.workspace.photos)
        if photo_set.has_masks and not mask_path(run.workspace.masks, photo.name).exists():
            lay_out_mask(photo, folder, masks, run.workspace.masks)
    return photo_set


def _too_few_message(folder: str, usable: int, unusable: list[UnusablePhoto]) -> str:
    reasons = Counter("copies of another" if COPY in photo.reason else photo.reason for photo in unusable)
    missing = [photo.name for photo in unusable if photo.reason == "missing"]  # from a list
    counts = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
    counts += f", such as {missing[0]}" if missing else ""
    number = "no usable photo" if usable == 0 else "only one usable photo"
    return f"{number} in {folder}: " + (counts or ("the folder is empty" if usable == 0 else "it has no other file"))
