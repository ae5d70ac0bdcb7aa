"""The manifest: which stages are finished, what each was made from, counted and wrote, and with what settings."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from sfm_app.atomic_io import replace_atomically
from sfm_app.errors import InputError
from sfm_app.hashing import fingerprint
from sfm_app.numerical import json_text

MANIFEST, PROGRAM = "manifest.json", "sfm-app"
FORMAT = 2
"""Version of the stages' files; raised when other versions of the program can no longer read them."""
CHECKSUM = "check"
"""Key in a record: hash of the rest. A record that was edited or cut off is ignored."""
PROBLEM = "problem"
"""Key of what ended the last run."""
MOST_BYTES = 64_000_000


@dataclass(frozen=True, slots=True)
class StageRecord:
    """Entry of the manifest for one finished stage."""

    fingerprint: str
    """Hash of everything that the stage's result depends on."""
    seconds: float
    counts: Mapping[str, Any] = field(default_factory=dict)
    files: Mapping[str, int] = field(default_factory=dict)
    """What the stage wrote, with the size in bytes; -1 for folders and the database, whose size readers may change."""
    peak_mb: int | None = None
    """Most memory that the program and its processes held during the stage, in MB; None if not measured."""
    made_with: Mapping[str, Any] = field(default_factory=dict)
    """The settings and versions that its result depends on."""
    digest: str = ""
    """Hash of what later runs read of it, so that damage is found before it is read."""
    cpu_seconds: float | None = None
    """Of the program and its processes, on all cores; None if not measured."""
    photos: Mapping[str, str] = field(default_factory=dict)
    """Hash of each photo by name, in the record of the first stage after the photos: a later run tells by it which
    photos came and went."""


class Manifest:
    """`manifest.json` of an output folder, and the sizes of the files that it lists."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.path = root / MANIFEST

    def read(self) -> dict[str, Any]:
        """Return the manifest; empty when it is missing or cannot be read (then everything is redone)."""
        try:
            if self.path.stat().st_size > MOST_BYTES:
                return {}
            found = json.loads(self.path.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return {}
        return found if isinstance(found, dict) and isinstance(found.get("stages", {}), dict) else {}

    def check_format(self) -> None:
        """Check that this program can read the files of the run.

        Raises:
            InputError: another version of the program wrote them.
        """
        found = self.read()
        if found.get("stages") and found.get("program") == PROGRAM and found.get("format") != FORMAT:
            raise InputError(
                f"the run in {self.root} was made by another version of sfm-app",
                hint="name another output folder with -o, or remove this one",
            )

    def check_begun(self) -> None:
        """Check that a run has left something that this program can read.

        Raises:
            InputError: there is no run, or another version of the program made it.
        """
        if not self.read():
            beside = self.root.resolve()
            beside = beside.with_name(f"{beside.name}-model")  # where a run without -o writes
            meant = f"\nis it {beside}?" if (beside / MANIFEST).exists() else ""
            raise InputError(
                f"{self.root} holds no run", hint=f"name the folder that `sfm-app run PHOTOS -o OUT` wrote{meant}"
            )
        self.check_format()

    def record(self, stage: str) -> StageRecord | None:
        """Return the record of a finished stage; None where there is none, or it was altered."""
        entry = self.read().get("stages", {}).get(stage)
        try:
            return StageRecord(**entry) if entry.pop(CHECKSUM) == fingerprint(entry) else None
        except (AttributeError, KeyError, TypeError, RecursionError):
            return None

    def changed_files(self, record: StageRecord) -> list[str]:
        """Return the files of a finished stage that are missing or have another size."""
        return [name for name, size in record.files.items() if _size(self.root / name) != size]

    def forget(self, stages: tuple[str, ...]) -> None:
        """Remove stages from the manifest before their files are touched, so that it never lists what is not there."""
        manifest = self.read()
        known = manifest.get("stages", {})
        if listed := [stage for stage in stages if stage in known]:
            for stage in listed:
                del known[stage]
            self.write(manifest)

    def finish(self, stage: str, record: StageRecord, head: Mapping[str, Any]) -> None:
        """Enter a finished stage.

        Args:
            stage: its name.
            record: what is known about its run and its files.
            head: settings, versions, ...; replaces the rest of the manifest.
        """
        entry = json.loads(json_text(asdict(record)))
        stages = self.read().get("stages", {}) | {stage: {**entry, CHECKSUM: fingerprint(entry)}}
        self.write({"format": FORMAT, **head, "stages": stages})

    def note_problem(self, problem: Mapping[str, Any]) -> None:
        """Note what ended a run, until a stage is finished again; an empty problem removes the note.

        Args:
            problem: plain values.
        """
        manifest = self.read()
        if problem != manifest.get(PROBLEM, {}):
            left = {key: value for key, value in manifest.items() if key != PROBLEM}
            self.write(left | ({PROBLEM: problem} if problem else {}))

    def write(self, manifest: Mapping[str, Any]) -> None:
        """Replace the manifest as a whole."""
        with replace_atomically(self.path) as path:
            path.write_text(json_text(manifest), encoding="utf-8", newline="\n")

    def sizes(self, files: tuple[str, ...]) -> dict[str, int]:
        """Return the sizes of a stage's files, as its record holds them."""
        found = {name: _size(self.root / name) for name in files}
        return {name: size for name, size in found.items() if size is not None}


def model_triangles(stages: Mapping[str, Any]) -> int | None:
    """Return how many triangles the model has, None where there is none: texturing may cut some of the surface's.

    Args:
        stages: of a manifest, by name.
    """
    counts = [stages.get(stage, {}).get("counts", {}).get("triangles") for stage in ("texture", "mesh")]
    return next((count for count in counts if count), None)


def _size(path: Path) -> int | None:
    if not path.exists():
        return None
    return -1 if path.is_dir() or path.suffix == ".db" else path.stat().st_size
