"""A Dask cluster against threads: the same bytes, seconds, and what is lost with a worker or the scheduler.

    python -m benchmarks.many.cluster --photos FOLDER --cache CACHE
    python -m benchmarks.many.cluster --photos FOLDER --cache CACHE --parts hosts     (as root, on Linux)

Every run is a process of its own. `hosts` makes three network namespaces, one for the scheduler and one for each of two
workers, joined by veth; the folder is shared, and one worker is cut off in the middle.
"""

import json
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil

from benchmarks.common.command_line import new_parser
from benchmarks.common.processes import environment, module_command
from benchmarks.common.results import RESULTS, Row, document, table, write

ABOUT = (
    "Runs with threads (`--workers`) and with processes of one thread (`--cluster local:N`); copies of the finished "
    "run in which one stage is repeated on a cluster that loses a worker (`kill -9`, or its network) or its scheduler. "
    "Same: the stage's digest, or those of all stages, is that of the run with two threads. Seconds: from the manifest."
)
PER_PHOTO = ("match_graph", "view_graph", "depth_maps")
"""Stages of which most is done for each photo or pair on its own."""
STAGES = ("photos", "match_graph", "view_graph", "scene", "depth_maps", "mesh", "texture")
PARTS = ("same", "workers", "scheduler", "hosts")
LONG_S = 3600
WORKER = ("--nthreads", "1", "--no-dashboard", "--memory-limit", "0")


class Bench:
    """Photos, and the folder that keeps runs.

    Args:
        photos: folder of them.
        cache: keeps runs.
        quality: of all runs.
    """

    def __init__(self, photos: Path, cache: Path, quality: str) -> None:
        self.photos, self.cache, self.quality = photos.absolute(), cache.absolute(), quality
        self.base = self.cache / "threads-2"

    def command(self, out: Path, *more: str) -> list[str]:
        """Return the command of a run."""
        return module_command(
            "sfm_app", "run", str(self.photos), "-o", str(out), "--quality", self.quality, "-q", *more
        )

    def run(self, name: str, *more: str) -> dict[str, Any]:
        """Run to the end, unless it was done before, and return the stages of the manifest."""
        out = self.cache / name
        if not (out / "model.glb").exists():
            subprocess.run(self.command(out, *more), env=environment(), check=True, timeout=LONG_S)
        return stages(out)

    def copy(self, name: str) -> Path:
        """Return a copy of the finished run with two threads."""
        out = self.cache / name
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(self.base, out, symlinks=True)
        (out / "log.txt").unlink()
        return out


def stages(out: Path) -> dict[str, Any]:
    """Return the stages in the manifest of a run."""
    found: dict[str, Any] = json.loads((out / "manifest.json").read_text(encoding="utf-8"))["stages"]
    return found


def measure_same(bench: Bench) -> Iterator[Row]:
    """Compare threads with processes, and one process with two."""
    runs = {
        "2 threads": bench.run("threads-2", "--workers", "2"),
        "2 processes": bench.run("local-2", "--cluster", "local:2"),
        "1 process": bench.run("local-1", "--cluster", "local:1"),
    }
    base = runs["2 threads"]
    for method, found in runs.items():
        row: Row = {
            "method": method,
            "same": "yes" if all(found[stage]["digest"] == base[stage]["digest"] for stage in base) else "no",
            "s": sum(stage["seconds"] for stage in found.values()),
            "CPU s": sum(stage["cpu_seconds"] for stage in found.values()),
        }
        for stage in PER_PHOTO:
            row |= {f"{stage} s": found[stage]["seconds"], f"{stage} CPU s": found[stage]["cpu_seconds"]}
        yield row


def disturb(
    bench: Bench, stage: str, address: str, what: Callable[[int], None], prefix: Sequence[str] = ()
) -> tuple[Row, Path]:
    """Repeat a stage of a copy on a cluster, and disturb it half a second after it has begun.

    Args:
        bench, stage, address: runs; the stage; of the cluster.
        what: called with the process of the run.
        prefix: of the command.
    """
    out = bench.copy(f"disturbed-{stage}")
    command = [*prefix, *bench.command(out, "--from", stage, "--until", stage, "--cluster", address)]
    start = time.perf_counter()
    with subprocess.Popen(command, env=environment(), stderr=subprocess.PIPE, text=True) as process:
        log = out / "log.txt"
        while process.poll() is None and not (log.exists() and f"{stage} begins" in log.read_text("utf-8")):
            time.sleep(0.02)
        time.sleep(0.5)
        if process.poll() is None:
            what(process.pid)
        _, said = process.communicate(timeout=LONG_S)
    ended = process.returncode == 0
    same = ended and stages(out)[stage]["digest"] == stages(bench.base)[stage]["digest"]
    row: Row = {
        "method": stage,
        "exit code": process.returncode,
        "same": "yes" if same else "no",
        "s": time.perf_counter() - start,
        "says": said.strip().partition("\n")[0],
    }
    return row, out


def kill_worker(run: int) -> None:
    """Kill one of the processes of a run that do tasks."""
    below = psutil.Process(run).children(recursive=True)
    next(process for process in below if "spawn_main" in " ".join(process.cmdline())).kill()


def measure_workers(bench: Bench) -> Iterator[Row]:
    """Kill a worker in every stage."""
    for stage in STAGES:
        yield disturb(bench, stage, "local:2", kill_worker)[0] | {"lost": "a worker"}


@contextmanager
def dask(role: str, *arguments: str, prefix: Sequence[str] = ()) -> Iterator["subprocess.Popen[bytes]"]:
    """Run a scheduler or a worker within the block."""
    command = [*prefix, *module_command(f"distributed.cli.dask_{role}", *arguments)]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(command, env=environment(), stdout=quiet, stderr=quiet, start_new_session=True) as process:
        try:
            yield process
        finally:
            for one in [*psutil.Process(process.pid).children(recursive=True), process]:
                one.send_signal(signal.SIGKILL)


def measure_scheduler(bench: Bench) -> Iterator[Row]:
    """Kill the scheduler in every stage whose tasks travel, and go on without one."""
    for number, stage in enumerate(stage for stage in STAGES if stage not in ("scene", "texture")):
        address = f"127.0.0.1:{18786 + number}"
        with (
            dask("scheduler", "--host", "127.0.0.1", "--port", address.partition(":")[2], "--no-dashboard") as one,
            dask("worker", address, *WORKER),
            dask("worker", address, *WORKER),
        ):
            row, out = disturb(bench, stage, address, lambda _, one=one: one.kill())  # type: ignore[misc]
        subprocess.run(bench.command(out, "--until", stage, "--workers", "2"), env=environment(), check=True)
        same = stages(out)[stage]["digest"] == stages(bench.base)[stage]["digest"]
        yield row | {"lost": "the scheduler", "same": "yes, afterwards" if same else "no"}


SPACES = {"sfmhub": "", "sfmone": "10.211.1", "sfmtwo": "10.211.2"}
"""Network namespaces, and the networks that join two of them to the first."""


@contextmanager
def hosts() -> Iterator[None]:
    """Provide three network namespaces: the first is joined to each of the others, and nothing else to any."""

    def ip(*words: str) -> None:
        subprocess.run(["ip", *words], check=True)

    try:
        for space in SPACES:
            ip("netns", "add", space)
            ip("-n", space, "link", "set", "lo", "up")
        for space, net in list(SPACES.items())[1:]:
            here, there = f"v{space}", "veth0"
            ip("link", "add", here, "netns", "sfmhub", "type", "veth", "peer", "name", there, "netns", space)
            for where, link, address in (("sfmhub", here, f"{net}.1/24"), (space, there, f"{net}.2/24")):
                ip("-n", where, "addr", "add", address, "dev", link)
                ip("-n", where, "link", "set", link, "up")
        yield
    finally:
        for space in SPACES:
            subprocess.run(["ip", "netns", "del", space], check=False, stderr=subprocess.DEVNULL)


def measure_hosts(bench: Bench) -> Iterator[Row]:
    """Cut a worker off whose network is its own, in the middle of each stage whose tasks travel."""

    def within(space: str) -> list[str]:
        return ["ip", "netns", "exec", space]

    def cut(_: int) -> None:
        subprocess.run(["ip", "-n", "sfmhub", "link", "set", "vsfmtwo", "down"], check=True)

    for stage in (stage for stage in STAGES if stage not in ("scene", "texture")):
        with (
            hosts(),
            dask("scheduler", "--host", "0.0.0.0", "--port", "8786", "--no-dashboard", prefix=within("sfmhub")),  # noqa: S104
            dask("worker", "10.211.1.1:8786", *WORKER, prefix=within("sfmone")),
            dask("worker", "10.211.2.1:8786", *WORKER, prefix=within("sfmtwo")),
        ):
            time.sleep(8)  # both workers are there before the run begins
            row, _ = disturb(bench, stage, "10.211.1.1:8786", cut, within("sfmhub"))
        yield row | {"lost": "the network of a worker"}


MEASURES: dict[str, Callable[[Bench], Iterator[Row]]] = {
    "same": measure_same,
    "workers": measure_workers,
    "scheduler": measure_scheduler,
    "hosts": measure_hosts,
}


def main() -> None:
    """Measure, and write the results."""
    parser = new_parser("many.cluster", __doc__)
    parser.add_argument("--photos", type=Path, required=True)
    parser.add_argument("--cache", type=Path, required=True, help="keeps runs")
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--parts", nargs="+", default=list(PARTS[:-1]), choices=PARTS)
    parser.add_argument("--name", default="cluster", help="name of the result files")
    parser.add_argument("--results", type=Path, default=RESULTS)
    given = parser.parse_args()
    bench = Bench(given.photos, given.cache, given.quality)
    bench.run("threads-2", "--workers", "2")
    rows: list[Row] = []
    for part in given.parts:
        for row in MEASURES[part](bench):
            rows.append({"part": part} | row)
            print(json.dumps(rows[-1]), flush=True)
    tables = [table([row for row in rows if row["part"] == part]) for part in given.parts]
    options = {"quality": given.quality, "parts": " ".join(given.parts)}
    found = document("cluster", ABOUT, options, {"photos": given.photos.name}, rows)
    write(given.results, given.name, found, "# A cluster against threads\n\n" + ABOUT + "\n\n" + "\n".join(tables))


if __name__ == "__main__":
    main()
