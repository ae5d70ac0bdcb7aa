"""The queue of the studio: one run at a time, each in a process that cannot take the server along."""

import asyncio
import contextlib
import json
import sys
from collections import defaultdict, deque
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from typing import Any

from sfm_app.studio.projects import IDLE, QUEUED, RUNNING, Project, Projects

PATIENCE_S = 30.0
"""Seconds that a process gets to end by itself; runs resume even after it is killed. Chosen by hand."""
MOST_MESSAGES = 50
"""Messages of a run that are kept for the page. Chosen by hand."""


@dataclass
class Progress:
    """What the page shows of the run of a project."""

    stage: str = ""
    label: str = ""
    done: int = 0
    total: int = 0
    minutes: float | None = None
    """Minutes left; None where they are not known."""
    views: int = 0
    """Counts the views that the worker has written."""
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
        for name in ("stage", "label", "done", "total", "minutes"):
            if name in line:
                setattr(self, name, line[name])


class Jobs:
    """Runs the queued projects one after the other; checks and exports need no queue."""

    def __init__(self, projects: Projects) -> None:
        self.projects, self.progress = projects, dict[str, Progress]()
        self.changed = asyncio.Event()
        self.locks = defaultdict[str, asyncio.Lock](asyncio.Lock)
        """By project: only one process works in it."""
        self.process: asyncio.subprocess.Process | None = None
        self.running = ""
        """Name of the project whose run is at work."""

    async def work(self) -> None:
        """Run what is queued until it is canceled; what an ended server was running comes first."""
        for project in self.projects:
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
        if project.name == self.running and self.process is not None and self.process.stdin is not None:
            self.process.stdin.close()

    async def _run(self, project: Project) -> None:
        project.note(wanted=RUNNING)
        self.running = project.name
        try:
            await self._follow("run", project)
        finally:
            self.running = ""
        if project.root.is_dir() and project.wanted == RUNNING:
            project.note(wanted=IDLE)

    async def check(self, project: Project) -> None:
        """Find out which photos are usable, and what a run would cost."""
        await self._follow("check", project)

    async def _follow(self, job: str, project: Project) -> None:
        async with self.locks[project.name]:
            shown = self.progress[project.name] = Progress()
            async for line in self._lines(job, project):
                shown.follow(line)

    async def export(self, project: Project, file_format: str) -> dict[str, Any]:
        """Write the model in another format; return the worker's line with the file, or with the failure."""
        async with self.locks[project.name]:
            lines = [line async for line in self._lines("export", project, file_format)]
        return {key: value for line in lines for key, value in line.items()}

    async def _lines(self, job: str, project: Project, *rest: str) -> AsyncIterator[dict[str, Any]]:
        """Start a worker and yield its lines; a worker that crashes ends with a failure."""
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "sfm_app.studio.worker", job, str(project.root), *rest,
            stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
            start_new_session=True, limit=2**22,
        )  # fmt: skip
        if job == "run":
            self.process = process
        assert process.stdout is not None and process.stderr is not None  # noqa: S101 - they are pipes
        errors = asyncio.create_task(process.stderr.read())
        ended = False
        try:
            async for text in process.stdout:
                with contextlib.suppress(ValueError):  # a library may print
                    line = json.loads(text)
                    if isinstance(line, dict):
                        ended |= "end" in line
                        yield line
            await process.wait()
        finally:
            await self._end(process)
        if not ended:
            last = (await errors).decode("utf-8", "replace").strip().rpartition("\n")[2]
            message = f"the program has ended: {last or process.returncode}"
            yield {"end": "failed", "message": message, "hint": "start it again: it resumes"}

    async def _end(self, process: asyncio.subprocess.Process) -> None:
        if process.returncode is None and process.stdin is not None:
            process.stdin.close()
            try:
                await asyncio.wait_for(process.wait(), PATIENCE_S)
            except TimeoutError:
                process.kill()
