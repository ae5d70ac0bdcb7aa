"""Projects: a folder each, which the command line can continue.

A project has `project.json` (where its photos are, what is wanted), `settings.toml` (settings that differ from the
defaults), `photos/` (what was uploaded), `removed/` (what the user took out), `model/` (output folder of the run),
`masks/`, `exports/`, and `view/` (what the page shows; `worker` writes it).
"""

import filecmp
import json
import re
import shlex
import shutil
import tomllib
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, count
from pathlib import Path
from typing import Any

from sfm_app.errors import ConfigError, InputError
from sfm_app.files import read_object, replace_atomically
from sfm_app.photos.files import EXTENSIONS, list_photos
from sfm_app.photos.masks import find_mask
from sfm_app.settings import Settings, toml_value

RECORD, SETTINGS, LIST, DRAFT = "project.json", "settings.toml", "photos.txt", ".upload-"
PHOTOS, REMOVED, MODEL, VIEW, EXPORTS, MASKS = "photos", "removed", "model", "view", "exports", "masks"
VIEW_DATA = "view.json"
"""File in VIEW: what the scripts of the 3D view read, as part of a page."""
DEPTHS = "depths"
"""Folder in VIEW: pictures of the depth maps that are there, by number."""
IDLE, QUEUED, RUNNING, PAUSED = "idle", "queued", "running", "paused"
"""What is wanted of a project: nothing, a run, the run that is at work, or a run that waits for the user."""
APART = (*EXTENSIONS, ".zip")
"""Suffixes of files that a run reads only if they are named one by one."""
UNSAFE = re.compile(r"[^\w.() +-]")
LONGEST_NAME = 120
"""Letters of a name; file systems take 255 bytes. Chosen by hand."""


def safe_name(name: str, fallback: str) -> str:
    """Return a name for a file or folder of ours: neither hidden, nor a path, nor HTML, nor too long."""
    plain = UNSAFE.sub("_", unicodedata.normalize("NFC", name.replace("\\", "/").rpartition("/")[2])).strip(" .")
    stem, dot, suffix = plain.rpartition(".")
    if dot and len(suffix) <= 5:
        return f"{stem[:LONGEST_NAME]}.{suffix}" if stem else fallback
    return plain[:LONGEST_NAME] or fallback


def toml_text(values: Mapping[str, Any]) -> str:
    """Return nested values as TOML."""
    tables = {key: value for key, value in values.items() if isinstance(value, Mapping)}
    lines = [f"{key} = {toml_value(value)}" for key, value in values.items() if key not in tables]
    for key, table in tables.items():
        lines += ["", f"[{key}]", toml_text(table).rstrip()]
    return "\n".join(lines) + "\n"


def move_beside(file: Path, place: Path) -> Path:
    """Move a file to a place, with a number where that is taken; return where it is."""
    place.parent.mkdir(exist_ok=True)
    free = (place.with_stem(f"{place.stem}-{number}") for number in count(2))
    chosen = place if not place.exists() else next(one for one in free if not one.exists())
    return file.replace(chosen)


class Project:
    """One project."""

    def __init__(self, root: Path) -> None:
        self.root, self.name = root, root.name
        self.out, self.view, self.exports, self.masks = root / MODEL, root / VIEW, root / EXPORTS, root / MASKS

    @property
    def record(self) -> dict[str, Any]:
        """What `project.json` says."""
        return read_object(self.root / RECORD)

    def note(self, **values: Any) -> None:
        """Change entries of `project.json`."""
        with replace_atomically(self.root / RECORD) as path:
            path.write_text(json.dumps(self.record | values, indent=1), encoding="utf-8", newline="\n")

    @property
    def wanted(self) -> str:
        """What is wanted of it."""
        return str(self.record.get("wanted", IDLE))

    @property
    def title(self) -> str:
        """What the user calls it."""
        return str(self.record.get("title") or self.name)

    # photos

    @property
    def source(self) -> Path:
        """Folder of its photos: of this machine, or its own."""
        return Path(self.record.get("source") or self.root / PHOTOS)

    @property
    def is_linked(self) -> bool:
        """Whether the photos lie in a folder of the user, which stays as it is."""
        return bool(self.record.get("source"))

    def photos(self) -> dict[str, str]:
        """Return the names of files below the source, each with the reason why it is no photo, or ""."""
        if not self.source.is_dir():
            return {}
        gone = set(self.record.get("removed", ()))
        return {name: why for name, why in list_photos(self.source, self.out).items() if name not in gone}

    def inputs(self, photos: Mapping[str, str] | None = None) -> list[Path]:
        """Return what a run reads: the folder, or every file where some are videos or archives."""
        listed = self.photos() if photos is None else photos
        files = [self.source / name for name, why in listed.items() if not why]
        return files if not self.is_linked and any(file.suffix.lower() in APART for file in files) else [self.source]

    def keep(self, draft: Path, name: str) -> str:
        """Move an uploaded file to the photos, unless the same is there; return its name."""
        place = self.root / PHOTOS / safe_name(name, "photo.jpg")
        if place.is_file() and filecmp.cmp(draft, place, shallow=False):
            draft.unlink()
        else:
            place = move_beside(draft, place)
        return place.name

    def remove(self, names: Sequence[str]) -> None:
        """Take photos out of the project: uploads move to `removed/`, files of the user stay where they are."""
        known = self.photos()
        chosen = [name for name in names if name in known]
        masks = [self.masks / f"{name}.png" for name in chosen]
        if any(mask.is_file() for mask in masks):
            for mask in masks:
                mask.unlink(missing_ok=True)
            self.note_masks()
        if self.is_linked:
            self.note(removed=sorted({*self.record.get("removed", ()), *chosen}))
            kept = [name for name, why in self.photos().items() if not why]
            (self.root / LIST).write_text("".join(f"{name}\n" for name in kept), encoding="utf-8", newline="\n")
            self.change("photos", "images", str(self.root / LIST))
            return
        for name in chosen:
            move_beside(self.source / name, self.root / REMOVED / Path(name).name)

    def mask(self, name: str) -> Path:
        """Return the place of a mask, by the name of its photo or its own; InputError where it belongs to no photo."""
        photos = self.photos()
        photo = name if name in photos else next((one for one in photos if find_mask(one, {name})), "")
        if not photo:
            raise InputError(
                f"{name} is the mask of no photo here", hint="name it as its photo: a_mask.png belongs to a.jpg"
            )
        return self.masks / f"{photo}.png"

    def note_masks(self) -> None:
        """Have a run use the masks, if there are any."""
        has_masks = any(path.is_file() for path in self.masks.rglob("*"))
        self.change("photos", "masks", str(self.masks) if has_masks else "")

    def forget_uploads(self) -> None:
        """Remove the files of uploads that a killed server has left."""
        for draft in self.root.glob(f"{DRAFT}*"):
            draft.unlink()

    # settings

    def settings(self) -> dict[str, Any]:
        """Return the values of `settings.toml`; empty without one, ConfigError where it is no TOML."""
        try:
            return tomllib.loads((self.root / SETTINGS).read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError) as err:
            raise ConfigError(f"{self.root / SETTINGS} cannot be read: {err}", hint="correct or remove it") from err

    def change(self, table: str, key: str, value: Any) -> None:
        """Set a value of `settings.toml`, in a table or with "" above all; ConfigError where it is invalid."""
        values = self.settings()
        (values.setdefault(table, {}) if table else values)[key] = value
        Settings.from_mapping(values)
        with replace_atomically(self.root / SETTINGS) as path:
            path.write_text(toml_text(values), encoding="utf-8", newline="\n")

    def command(self, photos: Mapping[str, str] | None = None) -> str:
        """Return the command that does the same as the page."""
        inputs = shlex.quote(str(self.source)) + ("/*" if self.inputs(photos) != [self.source] else "")
        config = f" --config {shlex.quote(str(self.root / SETTINGS))}" if (self.root / SETTINGS).exists() else ""
        return f"sfm-app run {inputs} -o {shlex.quote(str(self.out))}{config}"

    def rows(self) -> list[dict[str, Any]]:
        """Return its photos: name, file, state, reason, and number in the model; a file may hold several."""
        listed, known = self.photos(), self.result().get("photos", ())
        masked = {path.relative_to(self.masks).as_posix() for path in self.masks.rglob("*.png")}
        rows = [row for row in known if row["file"] in listed]
        whole, held = {row["name"] for row in rows}, {row["file"] for row in rows}
        for name, why in listed.items():
            if name not in whole:
                state = "left out" if why else "read" if name in held else "new"
                rows.append({"name": name, "file": name, "state": state, "reason": why})
        for row in rows:
            is_photo = row["name"] == row["file"] and Path(row["name"]).suffix.lower() not in APART
            row["can_mask"] = is_photo and row["state"] != "left out"
            row["masked"] = f"{row['name']}.png" in masked
        return rows

    def result(self) -> dict[str, Any]:
        """Return what the worker has last found out about the photos and the model."""
        return read_object(self.view / "result.json")


class Projects:
    """All projects in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def __iter__(self) -> Iterator[Project]:
        for path in sorted(self.folder.iterdir(), key=lambda path: path.name.lower()):
            if (path / RECORD).is_file():
                yield Project(path)

    def find(self, name: str) -> Project | None:
        """Return the project of this name; names are compared, never made into paths."""
        return next((project for project in self if project.name == name), None)

    def create(self, name: str, source: str = "") -> Project:
        """Make a project, whose photos are uploaded or lie in the folder `source`; InputError without that folder."""
        folder = Path(source).expanduser() if source else None
        if folder is not None and not (folder.is_absolute() and folder.is_dir()):
            raise InputError(f"{source} is no folder of this machine", hint="give its whole path, from the root")
        base = safe_name(name or (folder.name if folder else ""), "project").removesuffix(".")
        taken = {path.name.lower() for path in self.folder.iterdir()}
        names = chain([base], (f"{base} {number}" for number in count(2)))
        project = Project(self.folder / next(one for one in names if one.lower() not in taken))
        project.root.mkdir()
        project.note(source=str(folder.resolve()) if folder else "", wanted=IDLE)
        return project

    def delete(self, project: Project) -> None:
        """Remove a project with all its files; a folder of the user stays."""
        shutil.rmtree(project.root)
