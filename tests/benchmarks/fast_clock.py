"""A process whose clock runs faster, for what would take a day: all clocks and waits, fast_clock.c."""

from __future__ import annotations

import asyncio
import ctypes
import os
import select
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

SOURCE = Path(__file__).with_name("fast_clock.c")
CHECKED_S = 6.0
"""Length of each wait of `measure`, on the fast clock, s."""


def relaunch() -> None:
    """Start this program again with the library loaded, at the true speed; returns where it is loaded.

    Raises CalledProcessError, FileNotFoundError without a compiler.
    """
    if not hasattr(ctypes.CDLL(None), "fast_clock_speed"):
        library = Path(tempfile.mkdtemp()) / "fast_clock.so"
        words = ["cc", "-shared", "-fPIC", "-O2", "-Wall", "-Werror", "-o", library, SOURCE, "-ldl"]
        subprocess.run(words, check=True)
        os.execve(sys.executable, sys.orig_argv, {**os.environ, "LD_PRELOAD": str(library)})
    if preloaded := os.environ.pop("LD_PRELOAD", None):
        shutil.rmtree(Path(preloaded).parent)


class FastClock:
    """The clock of this process, which `relaunch` has made adjustable."""

    def __init__(self) -> None:
        self._library = ctypes.CDLL(None)
        self._library.fast_clock_speed.argtypes = [ctypes.c_double]
        self._library.fast_clock_speed.restype = None
        self._library.fast_clock_true_s.restype = ctypes.c_double

    def run_at(self, speed: float) -> None:
        """Let all clocks advance by so many seconds per second from now on."""
        self._library.fast_clock_speed(speed)

    def true_s(self) -> float:
        return float(self._library.fast_clock_true_s())


def measure(clock: FastClock) -> Iterator[tuple[str, float, float]]:
    """Wait for `CHECKED_S` in each way that Python knows, at the present speed: what waited, how long on the
    clock of the process, and how long truly, s."""

    def socket_waits() -> None:
        ours, others = socket.socketpair()
        with ours, others, suppress(TimeoutError):
            ours.settimeout(CHECKED_S)
            ours.recv(1)

    def condition_waits() -> None:
        condition = threading.Condition()
        with condition:
            condition.wait(CHECKED_S)

    ways: dict[str, Callable[[], object]] = {
        "sleep": lambda: time.sleep(CHECKED_S),
        "lock": lambda: threading.Event().wait(CHECKED_S),
        "condition": condition_waits,
        "event loop": lambda: asyncio.run(asyncio.sleep(CHECKED_S)),
        "select": lambda: select.select([], [], [], CHECKED_S),
        "socket": socket_waits,
    }
    for kind, wait in ways.items():
        began, truly = time.monotonic(), clock.true_s()
        wait()
        yield kind, time.monotonic() - began, clock.true_s() - truly
