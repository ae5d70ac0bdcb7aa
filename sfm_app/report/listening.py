"""Listening for browsers: the address of a page, the headers of every answer, and errors of ports in words.

Apart from `server`, because the studio does not load COLMAP.
"""

import errno
from collections.abc import Iterator
from contextlib import contextmanager

from sfm_app.errors import ConfigError

LOOPBACK = "127.0.0.1"
HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""Of every answer: no other page may read it, and browsers do not keep it."""


def page_address(host: str, port: int, token: str) -> str:
    """Return the address of a page, with its token; that of this machine if it listens at all addresses."""
    named = {"0.0.0.0": LOOPBACK, "::": "::1"}.get(host, host)  # noqa: S104 - addresses to compare with
    return f"http://{f'[{named}]' if ':' in named else named}:{port}/" + (f"?token={token}" if token else "")


@contextmanager
def explain_ports(host: str, port: int) -> Iterator[None]:
    """Turn errors of listening into a ConfigError that says what to do."""
    try:
        yield
    except (OSError, OverflowError, UnicodeError) as err:  # Unicode: a name with an empty part
        reason, hint = f"port {port} cannot be used: {err}", "leave the port out for a free one"
        if isinstance(err, OSError) and err.errno in (errno.EADDRINUSE, errno.EACCES):
            reason = f"port {port} is taken ({err.strerror})"
        elif not isinstance(err, OverflowError):
            reason, hint = f"cannot listen at {host}: {err}", "give an address of this machine, or 0.0.0.0 for all"
        raise ConfigError(reason, hint=hint) from err
