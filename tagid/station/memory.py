"""Memory of a process that scans for weeks."""

from __future__ import annotations

import ctypes

_M_MMAP_THRESHOLD = -3
"""Number of the parameter in glibc's malloc.h."""
LARGE_BYTES = 1 << 18


def return_large_blocks() -> bool:
    """Have the C library return every freed block of LARGE_BYTES or more to the system at once.

    By default glibc raises this limit to the size of the largest block freed so far, up to 32 MB (mallopt(3),
    M_MMAP_THRESHOLD). The arrays of a scan, some MB each, then lie between small objects that stay, and the
    process grows by steps of several MB.

    Returns:
        Whether the C library has such a limit.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, LARGE_BYTES))
