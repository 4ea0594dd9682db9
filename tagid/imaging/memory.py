"""Memory that a computation will need, compared with what is free before any of it is taken.

An allocation that is too large ends in a killed process, which tells nobody what to change.
"""

from __future__ import annotations

import os

from tagid.errors import UsageError

SHARE = 0.8
"""Part of the free memory that one computation may take."""


def free_memory() -> int | None:
    """Bytes that can be taken without swapping, None if the system does not tell."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:  # noqa: PTH123 - a pseudo file
            for line in file:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


def require_memory(wanted: int, what: str, advice: str) -> None:
    """Refuse work that would not fit.

    Args:
        wanted: bytes it will take.
        what: the work and its sizes, as the subject of a sentence in the plural.
        advice: what to change.

    Raises:
        UsageError: more is wanted than `SHARE` of what is free.
    """
    free = free_memory()
    if free is not None and wanted > SHARE * free:
        raise UsageError(f"{what} need {wanted / 1e9:.1f} GB, {free / 1e9:.1f} GB are free", advice)
