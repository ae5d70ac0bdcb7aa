"""Install the wheel on every Python that is there, outside the tree, and run a part of the tests of the sdist with it.

    make test-pythons
    make test-pythons PYTHONS="/opt/python3.12/bin/python3 python3.13"

`doctor`, the version, every public name, and unit tests that are not slow. Says which Pythons were missing.
"""

import argparse
import os
import re
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
from collections.abc import Sequence
from pathlib import Path

from benchmarks.common.command_line import add_results, new_parser
from benchmarks.common.processes import ROOT
from benchmarks.common.results import Row, document, table, write

ABOUT = (
    "`make test-pythons`: the wheel in a new environment outside the tree, with constraints.txt; seconds to install "
    "(what pip has to fetch included), `doctor`, and unit tests that are not slow, from the unpacked sdist."
)
TESTS = ("camera", "cli", "formats", "geometry", "meshing", "photos", "fundamental", "types", "test_public_names.py")
"""Of tests/unit: files, numbers, kernels, COLMAP, Open3D, OpenCV and the command line, in a minute. Chosen by hand."""
PLUGINS = ("pytest", "pytest-xdist", "hypothesis", "laspy[lazrs]", "DracoPy", "usd-core", "pillow-heif")
"""What these tests need besides the program."""
NAMES = "import sfm_app; [getattr(sfm_app, name) for name in sfm_app.__all__]; print(sfm_app.__file__)"


def minor_versions() -> list[str]:
    """Return the Pythons that pyproject.toml promises, such as "3.11"."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [name[1] for line in project["classifiers"] if (name := re.fullmatch(r".*Python :: (3\.\d+)", line))]


def find_pythons(given: Sequence[str]) -> dict[str, str]:
    """Return interpreters by their minor versions; a name on PATH may be there and not work.

    Args:
        given: interpreters; if empty, those on PATH.
    """
    found: dict[str, str] = {}
    for name in given or [f"python{minor}" for minor in minor_versions()]:
        try:
            command = [name, "-c", "import sys, ensurepip; print('%d.%d' % sys.version_info[:2])"]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except OSError:
            continue
        if done.returncode == 0:
            found.setdefault(done.stdout.strip(), name)
    return found


def try_python(minor: str, python: str, built: Path, work: Path) -> Row:
    """Install the wheel with one interpreter and run the tests.

    Args:
        minor: its version.
        python: the interpreter.
        built: folder with the wheel and the sdist.
        work: an empty folder outside the tree.
    """
    subprocess.run([python, "-m", "venv", str(work / "venv")], check=True)
    here = next(path for path in (work / "venv" / "bin", work / "venv" / "Scripts") if path.exists())
    tree = _unpack(next(built.glob("*.tar.gz")), work / "sdist")
    wheel = next(built.glob("*.whl"))
    steps = {
        "install": ["python", "-m", "pip", "install", "-q", "-c", str(tree / "constraints.txt"), str(wheel), *PLUGINS],
        "names": ["python", "-c", NAMES],
        "version": ["sfm-app", "--version"],
        "doctor": ["sfm-app", "doctor"],
        "tests": ["python", "-m", "pytest", "-q", "-n", "2", "--dist", "loadfile", "-m", "not slow"]
        + [f"tests/unit/{name}" for name in TESTS],
    }
    row: Row = {"method": f"Python {minor}"}
    for name, (program, *arguments) in steps.items():
        start = time.perf_counter()
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        command = [str(here / program), *arguments]
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=False)
        row[f"{name} s"] = round(time.perf_counter() - start, 1)
        last = (done.stdout.strip() or done.stderr.strip()).splitlines()[-1:]
        print(f"Python {minor}, {name}: {' '.join(last) or 'done'}", flush=True)
        if done.returncode != 0:
            print(done.stdout[-4000:], done.stderr[-4000:], sep="\n", file=sys.stderr)
            return {**row, "result": f"{name} failed"}
    return {**row, "result": " ".join(last)}


def _unpack(sdist: Path, folder: Path) -> Path:
    """Unpack an sdist without the package, so that tests take the installed one; return its root."""
    with tarfile.open(sdist) as file:
        file.extractall(folder, filter="data")
    (tree,) = folder.iterdir()
    (tree / "sfm_app").rename(tree / "not-imported")
    return tree


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = new_parser("anywhere.pythons", __doc__)
    parser.add_argument("built", type=Path, help="folder with the wheel and the sdist")
    parser.add_argument("--pythons", nargs="*", default=[], help="interpreters, instead of those on PATH")
    parser.add_argument("--keep", action="store_true", help="write the results")
    add_results(parser, "anywhere-pythons")
    args: argparse.Namespace = parser.parse_args(arguments)
    found, rows = find_pythons(args.pythons), []
    for minor in minor_versions():
        if minor not in found:
            rows.append({"method": f"Python {minor}", "result": "not found on this machine"})
            continue
        with tempfile.TemporaryDirectory() as work:
            rows.append(try_python(minor, found[minor], args.built.resolve(), Path(work)))
    columns = [*dict.fromkeys(name for row in rows for name in row if name != "result"), "result"]
    print(table(rows, columns))
    if args.keep:
        page = f"# Pythons\n\n{ABOUT}\n\n{table(rows, columns)}"
        write(args.results, args.name, document(args.name, ABOUT, {}, {}, rows), page)
    failed = [row for row in rows if "failed" in row["result"] or not found]
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
