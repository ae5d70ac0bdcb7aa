"""Run the program with the network shut: offline.py ARGUMENTS. Whoever knocks is named, and ends the run."""

import sys

from sfm_app.cli.program import main

KNOCKS = ("socket.connect", "socket.getaddrinfo", "socket.gethostbyname", "socket.sendto", "urllib.Request")


def listen(event: str, arguments: tuple[object, ...]) -> None:
    """Hear of every way in which Python can reach the network."""
    if event in KNOCKS:
        sys.stderr.write(f"network: {event} {arguments!r}\n")
        sys.stderr.flush()
        raise SystemExit(99)


if __name__ == "__main__":
    sys.addaudithook(listen)
    main(sys.argv[1:])
