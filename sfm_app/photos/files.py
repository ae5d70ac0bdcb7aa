"""Files of a folder that may be photos or videos."""

import os
import re
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from pathlib import Path, PurePosixPath

from PIL import Image

from sfm_app.errors import InputError
from sfm_app.files import PROGRAM, RUN_FOLDERS, is_made_by_run, read_text, recorded_files
from sfm_app.operating_system import is_link

EXTENSIONS = (
    ".mp4", ".m4v", ".mov", ".3gp", ".3g2", ".insv", ".360", ".lrv", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".vob",
    ".ts", ".mts", ".m2ts", ".wmv", ".asf", ".flv", ".ogv", ".gif", ".mxf", ".dv", ".rm", ".h264", ".h265", ".ivf",
)  # fmt: skip
"""Of videos, for error messages only: videos are recognized by their first bytes, and playlists are none."""
HEAD_BYTES = 16384
"""Enough for the kinds of tracks that a header lists, and for five packets of an MPEG transport stream."""
HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"mif1", b"msf1")
AVIF_BRANDS = (b"avif", b"avis")
OTHER_BRANDS = (*HEIC_BRANDS, *AVIF_BRANDS, b"crx ", b"M4A ", b"M4B ", b"M4P ")
"""Photos and sound in the container of MP4."""
CONTAINERS = {
    "mov": rb".{4}(ftyp(?!%s)|moov|mdat|wide|free|skip)" % b"|".join(OTHER_BRANDS),
    "matroska": rb"\x1a\x45\xdf\xa3(.*\x86.V_|(?!.*\x86.A_))",
    "avi": rb"RIFF.{4}AVI ",
    "mpeg": rb"\0\0\x01\xba",
    "mpegvideo": rb"\0\0\x01\xb3",
    "mpegts": rb".{0,203}?((G.{187}){4}|(G.{191}){4}|(G.{203}){4})G",
    "asf": rb"\x30\x26\xb2\x75\x8e\x66\xcf\x11(.*\xc0\xef\x19\xbc\x4d\x5b|(?!.*\x40\x9e\x69\xf8\x4d\x5b))",
    "flv": rb"FLV\x01[^\x04]",
    "ogg": rb"OggS.*(\x80theora|\x01video|BBCD\0|OVP80)",
    "mxf": rb"\x06\x0e\x2b\x34\x02\x05\x01\x01\x0d\x01\x02\x01\x01\x02",
    "gxf": rb"\0\0\0\0\x01\xbc.{8}\xe1\xe2",
    "wtv": rb"\xb7\xd8\0\x20\x37\x49\xda\x11\xa6\x4e\0\x07\xe9\x5e\xad\x8d",
    "rm": rb"\.RMF",
    "dv": rb"\x1f\x07\0[\x3f\xbf]",
    "dhav": rb"DHAV",
    "m4v": rb"\0\0\x01\xb0",
    "nut": rb"nut/multimedia container\0",
    "ivf": rb"DKIF\0\0",
    "yuv4mpegpipe": rb"YUV4MPEG2 ",
    "h264": rb"\0?\0\0\x01([\x27\x47\x67]|\x09[\x10\x30\x50\x70\x90\xb0\xd0\xf0]\0)",
    "hevc": rb"\0?\0\0\x01[\x40\x46]\x01",
    "obu": rb"\x12\0\x0a[\x01-\x7f]",
    "gif": rb"GIF8[79]a.*(NETSCAPE2\.0|ANIMEXTS1\.0|\x21\xf9\x04.([^\0]|.[^\0]))",
    "apng": rb"\x89PNG\r\n\x1a\n.*acTL(?!\0\0\0\x01)",
}
"""First bytes of videos by FFmpeg's name of their container. Headers that list sound alone and pictures are none."""


def read_head(path: Path) -> bytes:
    """Return the first bytes of a regular file; empty if it cannot be read."""
    try:
        if not path.is_file():  # reading a pipe would never end
            return b""
        with path.open("rb") as file:
            return file.read(HEAD_BYTES)
    except OSError:
        return b""


def container(head: bytes) -> str:
    """Return FFmpeg's name of the container of a video that begins so; empty if it is none."""
    return next((name for name, pattern in CONTAINERS.items() if re.match(pattern, head, re.DOTALL)), "")


def is_video(head: bytes) -> bool:
    """Return whether a file that begins so is a video, and not a photo, a sound or a playlist."""
    return bool(container(head))


MOST_LIST_BYTES = 100_000_000
"""Largest list of photos: a million names."""
HINT = "name photos, folders, a video or a ZIP archive"


SYSTEM_FOLDERS = ("@eadir", "__macosx", "#recycle", "$recycle.bin", "lost+found")
"""Folders of thumbnails, of copies and of removed files that systems make; those that begin with a dot are hidden."""
SMALLER = "a smaller copy of another photo"
DERIVED = {
    "mask": "a mask; name its folder with --masks",
    "masks": "a mask; name its folder with --masks",
    "depth": "a depth map", "depths": "a depth map", "depthmap": "a depth map", "depthmaps": "a depth map",
    "disparity": "a depth map", "disparities": "a depth map",
    "normal": "a normal map", "normals": "a normal map",
    "thumb": SMALLER, "thumbs": SMALLER, "thumbnail": SMALLER, "thumbnails": SMALLER,
    "preview": SMALLER, "previews": SMALLER,
    "dense": "an undistorted copy of another photo", "undistorted": "an undistorted copy of another photo",
}  # fmt: skip
"""Words in the paths of pictures that programs make of photos. A word alone is no proof; see `_derived_from`."""
DEVELOPED = (".jpg", ".jpeg", ".heic", ".heif", ".tif", ".tiff", ".png")
RAW = (".dng", ".nef", ".nrw", ".cr2", ".cr3", ".crw", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw", ".x3f", ".3fr")
MODELS = (".mtl", ".gltf", ".ply", ".dae", ".usda")
"""Suffixes of models that name the pictures of their textures."""
NAMED_BYTES = 1_000_000
"""Bytes of a model that are searched for names."""


def list_photos(folder: Path, out: Path, listed_in: Path | None = None, closed: Sequence[Path] = ()) -> dict[str, str]:
    """Return the names of `list_files`, or those that a file lists, each with the reason why it is no photo or ""."""
    if not folder.is_dir():
        raise _bad_path_error(folder)
    if listed_in is not None:
        return dict.fromkeys(_read_list(listed_in, folder), "")
    made = _find_made(folder, {place.resolve() for place in (out, *closed)})
    names = list_files(folder, out, (*closed, *(folder / name for name in made)))
    derived = _derived_from(folder, names) | _textures(folder, names) | _raw_twins(names)
    return dict(sorted((made | dict.fromkeys(names, "") | derived).items()))


def list_files(folder: Path, out: Path, closed: Sequence[Path] = ()) -> list[str]:
    """Return the files below a folder, sorted, without `out` and `closed`; hidden folders and links count as files."""
    try:
        next(folder.iterdir(), None)
    except OSError as err:
        raise InputError(f"cannot read {folder}: {err.strerror}") from err
    excluded = {place.resolve() for place in (out, *closed)}
    return sorted(path.relative_to(folder).as_posix() for path in _walk(folder, excluded))


def _find_made(folder: Path, excluded: set[Path]) -> dict[str, str]:
    """Return the folders of runs, exports and systems, with reasons; of a folder of a run itself, those it fills."""
    made: dict[str, str] = {}
    for place, folders, _ in os.walk(folder):
        here, within = Path(place), is_made_by_run(Path(place))
        entered = []
        for name in folders:
            path = here / name
            if name.startswith(".") or is_link(path) or path.resolve() in excluded:
                continue
            if is_made_by_run(path) or recorded_files(path) or (within and name in RUN_FOLDERS):
                made[path.relative_to(folder).as_posix()] = f"a folder that {PROGRAM} made"
            elif name.casefold() in SYSTEM_FOLDERS:
                made[path.relative_to(folder).as_posix()] = "a folder of the system, not of photos"
            else:
                entered.append(name)
        folders[:] = entered
    return made


def _derived_from(folder: Path, names: Sequence[str]) -> dict[str, str]:
    """Return the pictures that programs made of photos beside them, with reasons.

    A word in the path tells them, and so does the name of a photo in their own, or a picture without color. Folders
    that hold nothing else are photos: thumbnails, say, whose originals are lost.
    """
    told = {name: found for name in names if (found := _word(name))}
    photos: dict[tuple[str, ...], str] = {}
    for name in names:
        if name not in told:
            photos.setdefault(_words(PurePosixPath(name).name), name)
    derived = {}
    for name, (reason, stem) in told.items() if photos else ():
        photo = photos.get(stem)
        mode, width = _mode_and_width(folder, name)
        if reason == SMALLER:
            is_made = photo is not None and 0 < width < _mode_and_width(folder, photo)[1]
        else:
            is_made = photo is not None or mode in ("1", "L", "LA", "I", "I;16", "I;16B", "F")
        if is_made:
            derived[name] = reason
    return derived


def _word(name: str) -> tuple[str, tuple[str, ...]] | None:
    """Return what a word in a path claims, and the words of the photo's name; None without such a word."""
    *parents, words = (_words(part) for part in PurePosixPath(name).parts)
    for place, word in enumerate(words):
        if word in DERIVED:
            return DERIVED[word], words[:place] or words[place + 1 :]
    for parent in reversed(parents):
        if len(parent) == 2 and parent[0] in ("image", "images") and parent[1].isdecimal():
            return SMALLER, words
        if reason := next((DERIVED[word] for word in parent if word in DERIVED), ""):
            return reason, words
    return None


def _words(text: str) -> tuple[str, ...]:
    """Return the words and numbers of a name, without its endings: those of `a_1.JPG.png` are a and 1."""
    words = re.findall(r"[^\W_]+", re.sub(r"(\.(jpe?g|png|tiff?|webp|bmp|exr|npy))+$", "", text.casefold()))
    return tuple(words)


def _mode_and_width(folder: Path, name: str) -> tuple[str, int]:
    try:
        if isinstance(place := resolve_file(folder, name), str):
            return "", 0
        with Image.open(place) as image:
            return image.mode, image.width
    except Exception:  # decoders of damaged bytes raise all kinds of errors
        return "", 0


def _raw_twins(names: Sequence[str]) -> dict[str, str]:
    """Return the raw photos that their camera also saved developed, with reasons."""
    paths = {name: PurePosixPath(name.casefold()) for name in names}
    developed = {path.with_suffix("") for path in paths.values() if path.suffix in DEVELOPED}
    return {
        name: "the raw file of another photo"
        for name, path in paths.items()
        if path.suffix in RAW and path.with_suffix("") in developed
    }


def _textures(folder: Path, names: Sequence[str]) -> dict[str, str]:
    """Return the pictures that a model in their folder names as its texture, with reasons."""
    textures = {}
    for model in (name for name in names if PurePosixPath(name).suffix.lower() in MODELS):
        try:
            with (folder / model).open("rb") as file:
                text = file.read(NAMED_BYTES)
        except OSError:
            continue
        parent = PurePosixPath(model).parent
        for name in names:
            path = PurePosixPath(name)
            if path.parent == parent and path.suffix.lower() not in MODELS and os.fsencode(path.name) in text:
                textures[name] = f"a texture of {model}"
    return textures


def _bad_path_error(path: Path) -> InputError:
    if not path.exists():
        siblings = path.parent.iterdir() if os.access(path.parent, os.R_OK) and path.parent.is_dir() else ()
        similar = get_close_matches(path.name, sorted(other.name for other in siblings), 1)
        suggestion = f"\nis it {path.with_name(similar[0])}?" if similar else ""
        return InputError(f"not found: {path}", hint=f"{HINT}{suggestion}")
    if path.suffix.lower() not in EXTENSIONS or not path.is_file():
        return InputError(f"neither a folder, a video nor a ZIP archive: {path}", hint=HINT)
    if not os.access(path, os.R_OK):
        return InputError(f"cannot read {path}: permission denied")
    hint = "copy the file again, or save it as MP4"
    return InputError(f"{path} is empty" if not path.stat().st_size else f"not a video: {path}", hint=hint)


def resolve_file(folder: Path, name: str) -> Path | str:
    """Return the path of a file in a folder with links resolved, or the reason why it is not opened."""
    root, place = folder.resolve(), folder / name
    if Path(name).name.startswith("."):
        return "hidden"
    try:
        real = place.resolve()
        exists = real.exists()
    except RuntimeError:  # a cycle of links
        return "a broken link"
    except (OSError, ValueError) as err:  # lists may hold invalid names; folders may be inaccessible
        return f"not readable: {getattr(err, 'strerror', 'no name').lower()}"
    if not real.is_relative_to(root):
        return "a link out of the folder" if is_link(place) else "outside the folder"
    if not exists:
        return "a broken link" if is_link(place) else "missing"
    if real.is_dir():
        return "a link to a folder" if is_link(place) else "a folder"
    return real if real.is_file() else "not a file"  # reading a pipe would never end


def _read_list(file: Path, folder: Path) -> list[str]:
    """Return the names in a list, as seen from the folder; lines that begin with # and name no file are comments."""
    try:
        lines = read_text(file, MOST_LIST_BYTES).splitlines()
    except (OSError, ValueError) as err:
        reason = err.strerror if isinstance(err, OSError) else str(err)
        raise InputError(f"cannot read {file}: {reason}", hint="one photo per line, as seen from the folder") from err
    names = {_name_in(folder, line, file.parent) for line in lines if line.strip()}
    return sorted(name for name in names if name and not (name.startswith("#") and not os.path.lexists(folder / name)))


def _name_in(folder: Path, line: str, beside: Path) -> str:
    """Return a listed file's name as seen from the folder; it may be as from here, from the list, or in full."""
    try:
        root = folder.resolve()
        for text in dict.fromkeys((line, line.strip())):
            for place in (folder / text, Path(text), beside / text):
                if os.path.lexists(place):
                    path = place.parent.resolve() / place.name
                    if path.is_relative_to(root) and path != root:
                        return path.relative_to(root).as_posix()
    except (OSError, ValueError, RuntimeError):  # a line may be no name, or a cycle of links
        pass
    return Path(line).as_posix()


def _walk(folder: Path, excluded: set[Path]) -> Iterator[Path]:
    for place, folders, files in os.walk(folder):
        here = Path(place)
        closed = [name for name in folders if name.startswith(".") or is_link(here / name)]
        folders[:] = [name for name in folders if name not in closed and (here / name).resolve() not in excluded]
        yield from (here / name for name in (*files, *closed))
