"""Every error that the program raises on purpose.

::

    SfmError                    anything below                                   exit 1
    ├── ConfigError             a setting is unknown, mistyped or out of range   exit 2
    ├── InputError              photos or files are missing or unreadable        exit 3
    │   └── DamagedProductError the files of a stage can no longer be read
    ├── ReconstructionError     the photos do not support a reconstruction       exit 4
    ├── BackendError            COLMAP failed; its own error is the cause        exit 5
    ├── PluginError             a plug-in is broken or clashes with another      exit 6
    ├── NumericalError          our own computation failed: singular matrix, NaN exit 7
    └── ClusterError            the cluster is gone, or cannot be used           exit 8
"""

from collections.abc import Mapping
from typing import ClassVar


class SfmError(Exception):
    """Base class: one line about the error, one about the remedy, and the reasons by photo."""

    exit_code: ClassVar[int] = 1

    def __init__(self, message: str, hint: str = "", photos: Mapping[str, str] | None = None) -> None:
        super().__init__(message, hint)  # both, for pickling
        self.message = message
        self.hint = hint
        self.photos = dict(photos or {})

    def __str__(self) -> str:
        return self.message


class ConfigError(SfmError):
    """A setting is unknown, mistyped or out of range."""

    exit_code = 2


class InputError(SfmError):
    """Photos or files are missing or unreadable, or the output cannot be written."""

    exit_code = 3


class DamagedProductError(InputError):
    """The files of a stage in the output folder can no longer be read; the stage has to run again."""

    def __init__(self, message: str, hint: str, stage: str) -> None:
        super().__init__(message, hint)
        self.args = (message, hint, stage)  # for pickling
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
    """Our own computation failed, as on a singular matrix or a NaN."""

    exit_code = 7


class ClusterError(SfmError):
    """The Dask cluster is gone, does not answer, or has workers that cannot be used."""

    exit_code = 8
