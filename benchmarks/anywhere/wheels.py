"""For every Python and platform: which of the pinned libraries that a run needs have no wheel.

    python -m benchmarks.anywhere.wheels

Asks the package registry through pip; installs nothing. Call it where sfm-app is installed.
"""

import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from benchmarks.common.command_line import add_results, new_parser
from benchmarks.common.processes import ROOT
from benchmarks.common.results import Row, document, table, write

ABOUT = (
    "Libraries of constraints.txt that `pip install sfm-app` brings, and whether a wheel of that version is there: the "
    "markers of all requirements are read for the platform, and pip looks for the wheels. Nothing is run."
)
PYTHONS = ("3.11", "3.12", "3.13")
MANYLINUX = [f"manylinux_2_{minor}" for minor in range(35, 4, -1)] + ["manylinux2014", "manylinux2010", "manylinux1"]
PLATFORMS = {
    "Linux x86_64, glibc 2.35": ("linux", "x86_64", [f"{name}_x86_64" for name in MANYLINUX]),
    "Linux aarch64, glibc 2.35": ("linux", "aarch64", [f"{name}_aarch64" for name in MANYLINUX]),
    "macOS 14 arm64": ("darwin", "arm64", ["macosx_14_0_arm64"]),
    "macOS 14 x86_64": ("darwin", "x86_64", ["macosx_14_0_x86_64"]),
    "Windows x86_64": ("win32", "AMD64", ["win_amd64"]),
}
"""How Python calls system and processor, and the tags of wheels, by platform."""
SAME_NEEDS = {"open3d": "open3d-cpu"}
"""Libraries that are not installed here, and others that need the same."""
SYSTEMS = {"linux": ("posix", "Linux"), "darwin": ("posix", "Darwin"), "win32": ("nt", "Windows")}


def needed(name: str, variables: dict[str, str], found: dict[str, set[str]]) -> None:
    """Collect what a library needs where markers have these values; what is not installed here is named, not followed.

    Args:
        name: of the library.
        variables: of markers.
        found: gets the names, with the extras that were asked for.
    """
    try:
        texts = requires(SAME_NEEDS.get(name, name)) or []
    except PackageNotFoundError:
        return
    for requirement in map(Requirement, texts):
        extras = found.get(canonicalize_name(name), set()) | {""}
        if requirement.marker and not any(requirement.marker.evaluate({**variables, "extra": e}) for e in extras):
            continue
        key = canonicalize_name(requirement.name)
        if key not in found or not requirement.extras <= found[key]:
            found.setdefault(key, set()).update(requirement.extras)
            needed(key, variables, found)


def markers(python: str, system: str, processor: str) -> dict[str, str]:
    """Return the variables of markers for a Python on a platform."""
    name, title = SYSTEMS[system]
    return {
        "python_version": python,
        "python_full_version": f"{python}.0",
        "sys_platform": system,
        "platform_machine": processor,
        "os_name": name,
        "platform_system": title,
    }


def without_wheel(names: Sequence[str], python: str, tags: Sequence[str]) -> Iterator[str]:
    """Yield those for which pip finds no wheel, with the versions that the constraints give.

    Args:
        names: of libraries.
        python: such as "3.12".
        tags: of the platform.
    """
    left = list(names)
    while left:
        with tempfile.TemporaryDirectory() as target:
            command = [sys.executable, "-m", "pip", "install", "--dry-run", "--no-deps", "--only-binary=:all:"]
            command += ["--quiet", "--target", target, "--implementation", "cp", "--python-version", python]
            command += [word for tag in tags for word in ("--platform", tag)]
            done = subprocess.run([*command, *left], capture_output=True, text=True, check=False)
        if done.returncode == 0:
            return
        missing = re.search(r"No matching distribution found for (\S+)", done.stderr)
        if missing is None:
            raise RuntimeError(done.stderr[-1000:])
        yield missing[1]
        left.remove(missing[1])


def rows() -> Iterator[Row]:
    """Yield a row for each Python and platform."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins: dict[str, str] = {
        canonicalize_name(line.split("==")[0]): line.split("==")[1] for line in lines if "==" in line
    }
    for platform, (system, processor, tags) in PLATFORMS.items():
        for python in PYTHONS:
            found: dict[str, set[str]] = {"sfm-app": set()}
            needed("sfm-app", markers(python, system, processor), found)
            names = [
                f"{name}=={pin}" if (pin := pins.get(name)) else name for name in sorted(found) if name != "sfm-app"
            ]
            missing = list(without_wheel(names, python, tags))
            unpinned = [name for name in names if "==" not in name]
            row = {"method": platform, "Python": python, "libraries": len(names), "without a wheel": ", ".join(missing)}
            yield {**row, "not in constraints.txt": ", ".join(unpinned)}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = new_parser("anywhere.wheels", __doc__)
    add_results(parser, "anywhere-wheels")
    args = parser.parse_args(arguments)
    found = list(rows())
    page = f"# Wheels\n\n{ABOUT}\n\n{table(found)}"
    results: Path = args.results
    write(results, args.name, document(args.name, ABOUT, {}, {}, found), page)
    print(table(found))


if __name__ == "__main__":
    main()
