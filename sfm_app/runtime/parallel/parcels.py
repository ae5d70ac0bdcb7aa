"""Values on their way between processes: small ones as bytes, large ones as files of a folder that all can read.

This is the only place where pickles are read, since they may run anything. Their bytes, or the hashes of their files,
come through the network of the cluster, which has to be trusted as a whole. A file that is not the one that was sent is
refused.
"""

import hashlib
import io
import pickle
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

from sfm_app.atomic_io import replace_atomically
from sfm_app.tasks import Shared

SMALL_BYTES = 500_000
"""Larger values travel as files. Chosen by hand: the scheduler passes on what is smaller."""
KEPT = 2
"""Shared values that a worker keeps in memory: those of this step, and of one beside it. Chosen by hand."""
SHARED, PATH = "shared", "path"
"""What is not pickled itself."""


@dataclass(frozen=True, slots=True)
class Parcel:
    """A pickled value."""

    data: bytes
    path: str = ""
    """File that has the value instead; empty where `data` has it."""
    digest: str = ""
    """Hash of the file."""


class Packer:
    """Packs values for other processes; each shared value becomes a file once, and is removed with the packer.

    Args:
        folder: all processes read and write it under this path.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._shared: dict[int, tuple[Shared[Any], Path, str]] = {}

    def pack(self, value: object) -> Parcel:
        """Return a value as a parcel."""
        buffer = io.BytesIO()
        _Pickler(buffer, self).dump(value)
        data = buffer.getvalue()
        if len(data) <= SMALL_BYTES:
            return Parcel(data)
        path = self.folder / f"parcel-{secrets.token_hex(8)}.pickle"
        with replace_atomically(path) as beside:
            beside.write_bytes(data)
        return Parcel(b"", str(path), hashlib.blake2b(data).hexdigest())

    def share(self, value: Shared[Any]) -> tuple[str, str]:
        """Return the path and the hash of the file of a shared value; it is written if it is not yet there."""
        known = self._shared.get(id(value))
        if known is None:
            path = self.folder / f"shared-{secrets.token_hex(8)}.pickle"
            with replace_atomically(path) as beside, beside.open("wb") as file:
                _Pickler(file, self).dump(value.value)
            # the value is held, so that its id stays its own
            known = self._shared[id(value)] = value, path, _digest(path)
        return str(known[1]), known[2]

    def remove_shared(self) -> None:
        """Remove the files of shared values."""
        for _, path, _ in self._shared.values():
            path.unlink(missing_ok=True)
        self._shared.clear()


@contextmanager
def packing(folder: Path) -> Iterator[Packer]:
    """Provide a packer, and remove the files of shared values at the end of the block.

    Args:
        folder: where the files go; created if it is missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    packer = Packer(folder)
    try:
        yield packer
    finally:
        packer.remove_shared()


def unpack(parcel: Parcel, *, remove: bool = False) -> Any:
    """Return the value of a parcel.

    Args:
        parcel: from `Packer.pack`.
        remove: whether its file is no longer needed.

    Raises:
        OSError: the file cannot be read here, or is not the one that was sent.
    """
    if not parcel.path:
        return _Unpickler(io.BytesIO(parcel.data)).load()
    value = _load(parcel.path, parcel.digest)
    if remove:
        Path(parcel.path).unlink(missing_ok=True)
    return value


def survives_travel(value: object) -> bool:
    """Return whether a value has the same type after it was pickled and read again."""
    try:
        return type(pickle.loads(pickle.dumps(value))) is type(value)  # noqa: S301 - its own bytes
    except Exception:  # `__reduce__` and `__init__` may raise anything
        return False


class _Pickler(pickle.Pickler):
    """Leaves shared values out, and makes paths absolute: workers have another current folder."""

    def __init__(self, file: IO[bytes], packer: Packer) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self._packer = packer

    def persistent_id(self, value: object) -> tuple[str, str, str] | None:
        if isinstance(value, Shared):
            return SHARED, *self._packer.share(value)
        return (PATH, str(value.absolute()), "") if isinstance(value, Path) else None


class _Unpickler(pickle.Unpickler):
    def persistent_load(self, named: tuple[str, str, str]) -> Shared[Any] | Path:
        kind, path, digest = named
        return _read_shared(path, digest) if kind == SHARED else Path(path)


@lru_cache(maxsize=KEPT)
def _read_shared(path: str, digest: str) -> Shared[Any]:
    return Shared(_load(path, digest))


def _load(path: str, digest: str) -> Any:
    """Return the value in a file, if it is the one that was sent."""
    if _digest(Path(path)) != digest:
        raise OSError(f"{path} is not the file that was sent")
    with Path(path).open("rb") as file:
        return _Unpickler(file).load()


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "blake2b").hexdigest()
