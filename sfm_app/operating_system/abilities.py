"""Which abilities this system has. Tests take some away, to run the fallbacks on a system that has them all."""

import os
import sys
from collections.abc import Mapping
from enum import StrEnum

VARIABLE = "SFM_APP_WITHOUT"
"""Environment variable that takes abilities away, by names with commas; processes that a run starts have it, too."""


class Ability(StrEnum):
    """What a system may have or lack; the value is its name for people."""

    LINKS = "links"
    """A file may point to another. Windows asks for a right that few users have."""
    HARD_LINKS = "hard links"
    """Two files may share their bytes. Not between drives, and not on sticks and some network drives."""
    OPEN_FILES = "replacing open files"
    """A file may be replaced while another program, such as a virus scanner, looks at it."""
    GROUPS = "process groups"
    """One signal ends a process with all that it has started."""
    CLOSED_INPUT = "waiting for input"
    """A thread may wait for the end of the standard input. On Windows, it holds up the loading of libraries."""
    CHILD_TIMES = "times of children"
    """The system adds up the CPU seconds of processes that have ended."""
    CORES = "chosen cores"
    """The system says which cores this process may use."""
    CONTAINERS = "container limits"
    """The system says how much memory a container may use."""
    REUSED_PORTS = "reusing ports"
    """The port of a program that has just ended can be asked for. On Windows, that lets two programs share one."""
    WHEEL_LIBRARIES = "libraries in wheels"
    """The libraries of a package are files of their own, whose functions can be called."""
    EXIT_HANDLERS = "exit handlers"
    """The C library can be told what to do first at the end of a process, and passes the exit code on."""


LINUX = frozenset(Ability)
MACOS = LINUX - {Ability.CORES, Ability.CONTAINERS, Ability.EXIT_HANDLERS}
WINDOWS = frozenset({Ability.LINKS, Ability.HARD_LINKS})
"""Links are tried, and copied where they are refused."""


def find_abilities(platform: str, environment: Mapping[str, str]) -> frozenset[Ability]:
    """Return what a system has, less what the environment takes away.

    Args:
        platform: as `sys.platform` has it.
        environment: variables of the process.

    Raises:
        ValueError: the variable names something that is no ability.
    """
    usual = WINDOWS if platform == "win32" else LINUX if platform.startswith("linux") else MACOS
    named = [name.strip() for name in environment.get(VARIABLE, "").split(",") if name.strip()]
    return usual - {Ability(name) for name in named}


HERE = find_abilities(sys.platform, os.environ)


def lacks(ability: Ability) -> bool:
    """Return whether this system lacks an ability, so that the fallback is used."""
    return ability not in HERE


def missing_abilities() -> list[str]:
    """Return the names of what this system lacks, for people."""
    return [ability.value for ability in Ability if lacks(ability)]
