"""Memory that a computation will need, compared with what is free before any of it is taken.

An allocation that is too large ends in a killed process, which tells nobody what to change.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from tagid.errors import UsageError

SHARE = 0.8
"""Part of the free memory that one computation may take."""
_CGROUPS = Path("/sys/fs/cgroup")


def free_memory() -> int | None:
    """Bytes that can be taken without swapping or passing a limit, None if the system does not tell."""
    return min((*_of_the_system(), *_of_limits(), *_of_cgroups()), default=None)


def _of_the_system() -> Iterator[int]:
    available = _fields(Path("/proc/meminfo")).get("MemAvailable:")
    if available is not None:
        yield available * 1024
        return
    with suppress(AttributeError, ValueError, OSError):
        yield os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _of_limits() -> Iterator[int]:
    """What is left of this process's address space and data (`ulimit -v`, `-d`; proc(5), statm)."""
    with suppress(ImportError, OSError, ValueError, IndexError):
        import resource

        pages = [int(word) for word in Path("/proc/self/statm").read_text("ascii").split()]
        for kind, used in ((resource.RLIMIT_AS, pages[0]), (resource.RLIMIT_DATA, pages[5])):
            limit = resource.getrlimit(kind)[0]
            if limit != resource.RLIM_INFINITY:
                yield max(0, limit - used * resource.getpagesize())


def _of_cgroups() -> Iterator[int]:
    """What is left in each control group that holds this process, version 1 and 2; its page cache is free."""
    with suppress(OSError, ValueError):
        for line in Path("/proc/self/cgroup").read_text("utf-8").splitlines():
            _, controllers, name = line.split(":", 2)
            if controllers and "memory" not in controllers.split(","):
                continue
            root = _CGROUPS / "memory" if controllers else _CGROUPS
            files = ("memory.limit_in_bytes", "memory.usage_in_bytes") if controllers else _VERSION_2
            # In a container, the name is that outside of it: the group itself is the root there.
            inner = root / name.lstrip("/")
            for folder in (inner, *inner.parents):
                if root in (folder, *folder.parents):
                    yield from _of_cgroup(folder, *files)


_VERSION_2 = ("memory.max", "memory.current")


def _of_cgroup(folder: Path, limit: str, usage: str) -> Iterator[int]:
    with suppress(OSError, ValueError):
        most = int((folder / limit).read_text("ascii"))  # "max": no limit
        cache = _fields(folder / "memory.stat")
        used = int((folder / usage).read_text("ascii"))
        yield max(0, most - used + cache.get("total_inactive_file", cache.get("inactive_file", 0)))


def _fields(path: Path) -> dict[str, int]:
    """Names and numbers of a pseudo file; empty if there is none."""
    with suppress(OSError, ValueError, IndexError):
        rows = [line.split() for line in path.read_text("ascii").splitlines()]
        return {row[0]: int(row[1]) for row in rows}
    return {}


def require_memory(wanted: int, what: str, advice: str) -> None:
    """Raise UsageError if more bytes are wanted than `SHARE` of what is free.

    `what` names the work and its sizes, as the subject of a sentence in the plural, `advice` what to change.
    """
    free = free_memory()
    if free is not None and wanted > SHARE * free:
        raise UsageError(f"{what} need {wanted / 1e9:.1f} GB, {free / 1e9:.1f} GB are free", advice)
