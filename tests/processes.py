"""`tagid` in processes of its own: emulated devices, and waiting for what a process does."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

TAGID = [sys.executable, "-m", "tagid"]


@contextmanager
def emulated(home: dict[str, str], *words: object) -> Iterator[tuple[dict[str, Any], subprocess.Popen[str]]]:
    """`tagid emulate WORDS`: what it says of itself, and its process, which ends with the block."""
    process = subprocess.Popen(
        [*TAGID, "emulate", *map(str, words), "--output", "json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=home,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        yield json.loads(process.stdout.readline())["data"], process
    finally:
        process.terminate()
        _, errors = process.communicate(timeout=10)
    assert "Traceback" not in errors, errors


@contextmanager
def emulated_radar(home: dict[str, str], *options: object) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """The URL of an emulated P440 on loopback, and its process."""
    with emulated(home, "p440", "--bind", "127.0.0.1:0", *options) as (there, process):
        yield there["url"], process


def wait_until(
    what: Callable[[], Any], process: subprocess.Popen[Any] | None = None, seconds: float = 60.0
) -> None:
    """Return once something is so; fail after a time, or where a process ends before."""
    deadline = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < deadline, "waited in vain"
        assert process is None or process.poll() is None, process.communicate()
        time.sleep(0.01)


def journal_bytes(folder: Path) -> int:
    """Size of the largest journal of a folder."""
    return max((path.stat().st_size for path in folder.glob("*.journal")), default=0)
