"""Whether a journal is being recorded at the moment: an advisory lock, held from its creation to its removal.

The operating system releases the lock with the process, however that ends. Where a file system has no locks,
or the platform no flock(2), no journal counts as being recorded.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

fcntl: Any
try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None

_TRIES = 20
_PAUSE_S = 0.005


def lock(descriptor: int) -> None:
    """Lock a new journal; the lock lasts until the descriptor and its duplicates are closed."""
    if fcntl is None:
        return
    for _ in range(_TRIES):
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:  # somebody asks `being_recorded` just now
            time.sleep(_PAUSE_S)
        except OSError:
            return
        else:
            return


def being_recorded(path: Path) -> bool:
    """Whether a process is recording into this journal, or is writing its capture file."""
    if fcntl is None:
        return False
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return False
