"""What differs between operating systems, and nothing else: no other package asks which one this is.

Each function has the way of Linux and a fallback, for macOS, Windows, and drives and containers that lack something.
"""

from sfm_app.operating_system.abilities import VARIABLE, Ability, lacks, missing_abilities
from sfm_app.operating_system.files import (
    is_link,
    link_or_copy,
    move,
    replace_file,
    share_bytes,
)
from sfm_app.operating_system.libraries import find_in_wheel, load_libusb
from sfm_app.operating_system.machine import (
    ChildTimes,
    cpu_seconds,
    free_memory_mb,
    machine_memory_mb,
    usable_cores,
    yield_to_others,
)
from sfm_app.operating_system.processes import (
    crash_name,
    end_at_exit,
    end_group,
    end_own_group,
    group_options,
    has_run_out,
    heed_requests_to_end,
    ignore_interrupts,
    keep_handler,
    watch_parent,
)

__all__ = [
    "VARIABLE",
    "Ability",
    "ChildTimes",
    "cpu_seconds",
    "crash_name",
    "end_at_exit",
    "end_group",
    "end_own_group",
    "find_in_wheel",
    "free_memory_mb",
    "group_options",
    "has_run_out",
    "heed_requests_to_end",
    "ignore_interrupts",
    "is_link",
    "keep_handler",
    "lacks",
    "link_or_copy",
    "load_libusb",
    "machine_memory_mb",
    "missing_abilities",
    "move",
    "replace_file",
    "share_bytes",
    "usable_cores",
    "watch_parent",
    "yield_to_others",
]
