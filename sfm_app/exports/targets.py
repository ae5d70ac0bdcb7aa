"""Where exports go: a file or a folder, as a whole or not at all, and never over what no export has written."""

import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from sfm_app.atomic_io import replace_atomically
from sfm_app.errors import InputError
from sfm_app.numerical import json_text
from sfm_app.operating_system import is_link, move

RECORD = "export.json"
"""In a folder that an export has written: its format, its files, and which photo each picture shows."""
ELSEWHERE = "name another place with -o"


@contextmanager
def fill_folder(target: Path, about: Callable[[], Mapping[str, object]]) -> Iterator[Path]:
    """Provide an empty folder beside `target`, which takes its place once the block ends without an error.

    Args:
        target: folder; what an earlier export has written there is replaced.
        about: what the record says besides the files; called at the end.

    Raises:
        InputError: the target is something else, or holds files that no export has written.
    """
    check_replaceable(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    beside = target.with_name(f".{target.name}.unfinished")
    shutil.rmtree(beside, ignore_errors=True)
    beside.mkdir()
    try:
        yield beside
        with replace_atomically(beside / RECORD) as path:
            path.write_text(json_text({**about(), "files": _list_files(beside)}), encoding="utf-8", newline="\n")
        check_replaceable(target)  # it may have been filled meanwhile
        if target.exists():
            old = target.with_name(f".{target.name}.old")
            shutil.rmtree(old, ignore_errors=True)
            move(target, old)
            move(beside, target)
            shutil.rmtree(old, ignore_errors=True)
        else:
            move(beside, target)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def check_replaceable(target: Path) -> None:
    """Check that nothing is lost where a folder is written.

    Args:
        target: the folder; it may be missing.

    Raises:
        InputError: it is no folder, or it holds files that no export has written.
    """
    if is_link(target) or (target.exists() and not target.is_dir()):
        raise InputError(f"{target} is no folder", hint=ELSEWHERE)
    if not target.exists():
        return
    files = _list_files(target)
    foreign = sorted(set(files) - {*_recorded_files(target), RECORD})
    if foreign:
        raise InputError(f"{target} holds files that no export has written, such as {foreign[0]}", hint=ELSEWHERE)


def _list_files(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir())


def _recorded_files(folder: Path) -> list[str]:
    """Return the files that the record of an export lists; none where there is no sound record."""
    try:
        known = json.loads((folder / RECORD).read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    return [str(name) for name in known] if isinstance(known, list) else []
