"""The queue of the studio: one run at a time, each in a process that cannot take the server along."""

import asyncio
import contextlib
import json
import subprocess
import sys
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from subprocess import PIPE
from typing import IO, Any, cast

from sfm_app.operating_system import end_group, group_options
from sfm_app.studio.projects import IDLE, QUEUED, RUNNING, Project, Projects

PATIENCE_S = 30.0
"""Seconds that a process gets to end by itself; runs resume even after it is killed. Chosen by hand."""
MOST_MESSAGES = 5
"""Last messages of a run that the page shows. Chosen by hand."""


@dataclass
class Progress:
    """What the page shows of the run of a project."""

    stage: str = ""
    done: int = 0
    total: int = 0
    minutes: float | None = None
    """Minutes left; None where they are not known."""
    views: int = 0
    """Counts the views that the worker has written."""
    depths: int = 0
    """Counts the pictures of depth maps."""
    messages: deque[str] = field(default_factory=lambda: deque(maxlen=MOST_MESSAGES))
    failure: str = ""
    hint: str = ""

    def follow(self, line: dict[str, Any]) -> None:
        """Take over a line of the worker."""
        if line.get("view"):
            self.views += 1
        if line.get("end") == "failed":
            self.failure, self.hint = str(line["message"]), str(line["hint"])
        if "message" in line and "stage" in line:
            self.messages.append(str(line["message"]))
        for name in ("stage", "done", "total", "minutes", "depths"):
            if name in line:
                setattr(self, name, line[name])


class Jobs:
    """Runs the queued projects one after the other; checks and exports need no queue."""

    def __init__(self, projects: Projects) -> None:
        self.projects, self.progress = projects, dict[str, Progress]()
        self.changed = asyncio.Event()
        self.locks = defaultdict[str, asyncio.Lock](asyncio.Lock)
        """By project: only one process works in it."""
        self.unchecked = set[str]()
        """Projects whose check waits for the process that works in them."""
        self.run: asyncio.Task[None] | None = None
        self.running = ""
        """Name of the project whose run is at work."""

    async def work(self) -> None:
        """Run what is queued until it is canceled; what an ended server was running comes first."""
        for project in self.projects:
            project.forget_uploads()
            if project.wanted == RUNNING:
                project.note(wanted=QUEUED, queued=0)
        while True:
            self.changed.clear()
            waiting = [project for project in self.projects if project.wanted == QUEUED]
            if waiting:
                await self._run(min(waiting, key=lambda project: project.record.get("queued", 0)))
            else:
                await self.changed.wait()

    def start(self, project: Project) -> None:
        """Put a project at the end of the queue."""
        if project.wanted not in (QUEUED, RUNNING):
            last = max((other.record.get("queued", 0) for other in self.projects), default=0)
            project.note(wanted=QUEUED, queued=last + 1)
            self.changed.set()

    def stop(self, project: Project, wanted: str = IDLE) -> None:
        """End the run of a project, or take it out of the queue; it resumes when it is started again."""
        project.note(wanted=wanted)
        if project.name == self.running and self.run is not None:
            self.run.cancel()

    def is_at_work(self, project: Project) -> bool:
        """Return whether a process works in a project."""
        return project.name == self.running or self.locks[project.name].locked()

    async def _run(self, project: Project) -> None:
        project.note(wanted=RUNNING)
        self.run = run = asyncio.create_task(self._follow("run", project))
        self.running = project.name
        try:
            await asyncio.wait([run])
        finally:  # the studio ends, or the run has
            run.cancel()
            await asyncio.wait([run])
            self.running = ""
        if not run.cancelled():
            run.result()  # an error of ours
            project.note(wanted=IDLE)

    async def check(self, project: Project) -> None:
        """Find out which photos are usable, and what a run would cost; one check serves all that waits for it."""
        if project.name not in self.unchecked:
            self.unchecked.add(project.name)
            await self._follow("check", project)

    async def _follow(self, job: str, project: Project) -> None:
        async with self.locks[project.name]:
            self.unchecked.discard(project.name)
            shown = self.progress[project.name] = Progress()
            await _work(shown.follow, job, project)

    async def export(self, project: Project, file_format: str, box: Any) -> dict[str, Any]:
        """Write the model, or what is in a box of it, in another format; return the file, or the failure."""
        said = dict[str, Any]()
        async with self.locks[project.name]:
            await _work(said.update, "export", project, file_format, json.dumps(box))
        return said


async def _work(follow: Callable[[dict[str, Any]], None], job: str, project: Project, *rest: str) -> None:
    """Do a job in a worker and follow its lines; a worker that crashes ends with a failure."""
    said, ended = project.root / "worker.txt", False
    command = [sys.executable, "-m", "sfm_app.studio.worker", job, str(project.root), *rest]
    with said.open("wb") as errors:
        process = subprocess.Popen(command, stdin=PIPE, stdout=PIPE, stderr=errors, **group_options())  # noqa: S603 - our own
    try:
        while text := await asyncio.to_thread(cast(IO[bytes], process.stdout).readline):
            with contextlib.suppress(ValueError):  # a library may print
                line = json.loads(text)
                if isinstance(line, dict):
                    ended |= "end" in line
                    follow(line)
    finally:
        await asyncio.shield(asyncio.to_thread(_end, process))
    if not ended:
        last = said.read_text(encoding="utf-8", errors="replace").strip().rpartition("\n")[2]
        message = f"the program has ended: {last or process.returncode}"
        follow({"end": "failed", "message": message, "hint": "start it again: it resumes"})


def _end(process: subprocess.Popen[bytes]) -> None:
    """Let a worker end by itself, which the end of its input asks for; kill it where it does not."""
    cast(IO[bytes], process.stdin).close()
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(PATIENCE_S)
    end_group(process, PATIENCE_S)
    cast(IO[bytes], process.stdout).close()
