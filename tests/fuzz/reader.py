"""Read the photos of a folder, each in at most so many seconds, in little memory: reader.py FOLDER SECONDS MEGABYTES.

Lines of JSON: the memory in MB; per photo its name before it is read, and what became of it; the memory again. A hang
or a crash ends the process, and the last name says at which photo.
"""

import json
import resource
import signal
import sys
from pathlib import Path

from sfm_app.photos.probe import read_photo
from sfm_app.photos.selection import PhotoStats
from sfm_app.settings import PhotoSettings


def main(folder: Path, seconds: int, megabytes: int) -> None:
    """Say what every file is."""
    size = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + megabytes * 1_000_000, resource.RLIM_INFINITY))
    say(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)
    for path in sorted(folder.iterdir()):
        say(path.name)
        signal.alarm(seconds)
        found = read_photo(folder, path.name, options=PhotoSettings())
        signal.alarm(0)
        say("" if isinstance(found, PhotoStats) else found.reason)
    say(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)


def say(value: object) -> None:
    sys.stdout.write(json.dumps(value) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
