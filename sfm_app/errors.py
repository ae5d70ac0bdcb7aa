"""Every error that the program raises on purpose.

::

    SfmError                    anything below                                   exit 1
    ├── ConfigError             a setting is unknown, mistyped or out of range   exit 2
    ├── InputError              photos or files are missing or unreadable        exit 3
    │   └── DamagedProductError what a stage has left can no longer be read
    ├── ReconstructionError     the photos do not support a reconstruction       exit 4
    ├── BackendError            COLMAP failed; its own error is the cause        exit 5
    ├── PluginError             a plug-in is broken or clashes with another      exit 6
    └── NumericalError          our own numbers failed: no inverse, no number    exit 7
"""

from typing import ClassVar


class SfmError(Exception):
    """What went wrong, in one line, and what the user can do about it.

    Args:
        message: one line.
        hint: what to do, one line; may be empty.
    """

    exit_code: ClassVar[int] = 1

    def __init__(self, message: str, hint: str = "") -> None:
        # Both go to the base class, so that the error survives pickling between worker processes.
        super().__init__(message, hint)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        return self.message


class ConfigError(SfmError):
    """A setting is unknown, mistyped or out of range."""

    exit_code = 2


class InputError(SfmError):
    """Photos or files are missing or unreadable, or the output cannot be written."""

    exit_code = 3


class DamagedProductError(InputError):
    """What a stage has left in the output folder can no longer be read.

    Args:
        message: one line.
        hint: what to do, one line.
        stage: that has to be done again.
    """

    def __init__(self, message: str, hint: str, stage: str) -> None:
        super().__init__(message, hint)
        self.args = (message, hint, stage)  # as above
        self.stage = stage


class ReconstructionError(SfmError):
    """The photos do not support a reconstruction."""

    exit_code = 4


class BackendError(SfmError):
    """COLMAP failed."""

    exit_code = 5


class PluginError(SfmError):
    """A plug-in is broken, unknown or clashes with another."""

    exit_code = 6


class NumericalError(SfmError):
    """Our own numbers failed: a matrix without an inverse, a value that is no number."""

    exit_code = 7
