"""What a finished run of other photos in the same folder left behind, for stages that go on from it."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

from sfm_app.runtime.workspace import Workspace


@dataclass(frozen=True, slots=True)
class Earlier:
    """Stages of an earlier run with the same settings and versions, whose photos partly are those of this run."""

    place: Workspace
    """Where their files were put; not to be changed."""
    stages: tuple[str, ...]
    """Names of the stages whose files are complete, in order."""
    fingerprint: str
    """Hash of what these stages were made from."""
    known: frozenset[str]
    """Names of the photos that are the same: in content, name, size, camera group and mask."""
    new: frozenset[str]
    """Names of photos that came, or that were replaced."""
    gone: frozenset[str]
    """Names of photos that were taken away, or replaced."""

    @property
    def text(self) -> str:
        """What changed, for people."""
        left = f", {len(self.gone - self.new)} left" if self.gone - self.new else ""
        return f"{len(self.known)} photos are known, {len(self.new)} are new{left}"

    def with_replaced(self, names: Collection[str]) -> "Earlier":
        """Return the same, with some known photos as replaced ones.

        Args:
            names: of photos whose features are not those that the earlier run found.
        """
        changed = self.known.intersection(names)
        return replace(self, known=self.known - changed, new=self.new | changed, gone=self.gone | changed)


def split_names(
    before: Mapping[str, str], now: Mapping[str, str]
) -> tuple[frozenset[str], frozenset[str], frozenset[str]]:
    """Return the names of photos that stayed the same, that are new, and that are gone; a replaced one is both.

    Args:
        before: hash of each photo of the earlier run, by name.
        now: those of this run.
    """
    known = frozenset(name for name, digest in now.items() if before.get(name) == digest)
    return known, frozenset(now) - known, frozenset(before) - known
