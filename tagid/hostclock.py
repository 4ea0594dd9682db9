"""The clock that stamps what arrives at this computer: since the epoch, and never stepped.

The clock of the system is set by hand or by NTP while a recording runs. Scans and motion readings stamped by
it would then be aligned with angles from another moment.
"""

from __future__ import annotations

import time
from typing import Final


def _since_boot_ns() -> int:
    """Time since the computer was started, ns; the time that it slept counts where the system can tell."""
    if hasattr(time, "CLOCK_BOOTTIME"):  # Linux
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    return time.monotonic_ns()


_BOOTED_NS: Final = time.time_ns() - _since_boot_ns()


def now_ns() -> int:
    """Now, ns since the epoch, as the system's clock said when this program started."""
    return _BOOTED_NS + _since_boot_ns()
