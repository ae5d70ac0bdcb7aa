"""Read the steps of a Dockerfile: as much of its language as ours uses, and an error for all else."""

import json
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

KNOWN = {"FROM", "RUN", "COPY", "ENV", "WORKDIR", "USER", "ENTRYPOINT", "CMD"}


@dataclass(frozen=True)
class Step:
    """One step of a Dockerfile."""

    keyword: str
    """In capitals, such as RUN."""
    text: str
    """What follows, on one line."""

    def words(self) -> list[str]:
        """Return what follows as words: a JSON list, or as a shell divides it, without options."""
        if self.text.startswith("["):
            return [str(word) for word in json.loads(self.text)]
        return [word for word in shlex.split(self.text) if not word.startswith("--")]

    def option(self, name: str) -> str | None:
        """Return the value of an option such as --from; None where there is none."""
        found = re.match(rf"(?:--\w+=\S+\s+)*--{name}=(\S+)", self.text)
        return found[1] if found else None

    def assignments(self) -> dict[str, str]:
        """Return the names and values of an ENV step."""
        return dict(word.split("=", 1) for word in shlex.split(self.text))


@dataclass(frozen=True)
class Stage:
    """One image that a Dockerfile builds."""

    base: str
    name: str
    steps: tuple[Step, ...]


def read_stages(path: Path) -> list[Stage]:
    """Return the stages of a Dockerfile in order; the last one is what it is for.

    Raises:
        ValueError: a step is not understood.
    """
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.lstrip().startswith("#")]
    text = re.sub(r"\\\n", " ", "\n".join(lines))
    stages: list[tuple[str, str, list[Step]]] = []
    for line in filter(None, map(str.strip, text.splitlines())):
        keyword, rest = line.split(maxsplit=1)
        if keyword not in KNOWN or ("$(" in rest and keyword != "RUN"):
            raise ValueError(f"a step that is not understood: {line}")
        if keyword == "FROM":
            base, *name = re.split(r"\s+AS\s+", rest)
            stages.append((base, name[0] if name else "", []))
        else:
            stages[-1][2].append(Step(keyword, re.sub(r"\s+", " ", rest).strip()))
    return [Stage(base, name, tuple(steps)) for base, name, steps in stages]
