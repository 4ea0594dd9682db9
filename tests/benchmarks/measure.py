"""What benchmarks measure with: commands beside them, the memory of a process, the time of some work."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def started(words: Sequence[str]) -> Iterator[dict[str, Any]]:
    """`tagid` with some words, and the data of the result by which it says that it is ready."""
    command = [sys.executable, "-m", "tagid", *words, "--output", "json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield json.loads(process.stdout.readline())["data"]
        finally:
            process.terminate()


def memory_mb(process: int | str = "self") -> float:
    """Resident memory of a process, MB of a million bytes."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def timed(work: Callable[[], Any]) -> tuple[Any, float, float]:
    """What some work gives, its wall and its processor seconds."""
    start, used = time.perf_counter(), time.process_time()
    result = work()
    return result, time.perf_counter() - start, time.process_time() - used


def best(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Least wall and least processor seconds of some repetitions, after one that is not counted."""
    work()
    times = [timed(work)[1:] for _ in range(repeats)]
    return min(wall for wall, _ in times), min(cpu for _, cpu in times)
