"""An emulated device on a pseudo-terminal: a serial port that pyserial or any other program can open.

A pty has no baud rate but stores the one the client chose: if it differs from the device's, both sides
receive garbage, as on a real line.
"""

from __future__ import annotations

import contextlib
import os
import select
import termios
import threading
import time
from pathlib import Path
from typing import Final, Protocol

from tagid.errors import DeviceError
from tagid.workers import Worker

_TICK_S: Final = 0.005
_BAUDS: Final = {
    getattr(termios, f"B{rate}"): rate
    for rate in (300, 600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)
}


class SerialCore(Protocol):
    """A device behind a serial port; times are of time.monotonic()."""

    baud: int

    def handle(self, data: bytes, now_s: float) -> bytes:
        """Process received bytes; return the bytes it sends."""

    def advance(self, now_s: float) -> bytes:
        """Advance the time; return the bytes it sends unprompted."""


def garbled(data: bytes) -> bytes:
    """Simulates bytes read at the wrong baud rate: fewer, with most bits stuck."""
    return bytes((byte * 7 & 0x78) | 0x80 for byte in data[::3])


def raise_failure(worker: Worker) -> None:
    """Raise DeviceError if the thread of an emulated device has died."""
    if worker.failure is not None:
        raise DeviceError(
            f"the emulated device ({worker.name}) has died: {worker.failure!r}", "Start it again."
        )


class PtyPort:
    """Serves a core on a pty from a thread; a context manager.

    Args:
        link: path of a symbolic link to the port; None for none.

    Attributes:
        path: the port to open.
        lock: held while the core is used; hold it to inspect the core.

    Raises DeviceError at the end of the block if the thread has died.
    """

    def __init__(self, core: SerialCore, link: Path | None = None) -> None:
        self._core = core
        self._master, slave = os.openpty()
        attributes = termios.tcgetattr(slave)
        attributes[0] = attributes[1] = attributes[3] = 0  # raw: no echo, no translation
        attributes[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
        attributes[4] = attributes[5] = termios.B115200
        termios.tcsetattr(slave, termios.TCSANOW, attributes)
        self.path = os.ttyname(slave)
        # Kept open: without any open slave, reads of the master fail with EIO.
        self._slave = slave
        os.set_blocking(self._master, False)
        self._link = link
        if link is not None:
            link.unlink(missing_ok=True)
            link.symlink_to(self.path)
        self.lock = threading.Lock()
        self._stop = threading.Event()
        self.worker = Worker(self._serve, "pty-port")

    def __enter__(self) -> PtyPort:
        self.worker.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self.worker.join(5)
        for descriptor in (self._master, self._slave):
            with contextlib.suppress(OSError):
                os.close(descriptor)
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        raise_failure(self.worker)

    def _wrong_rate(self) -> bool:
        """Whether the client chose another baud rate than the device's."""
        try:
            chosen = termios.tcgetattr(self._master)[4]
        except termios.error:
            return False
        return _BAUDS.get(chosen) != self._core.baud

    def _serve(self) -> None:
        while not self._stop.is_set():
            try:
                readable, _, _ = select.select([self._master], [], [], _TICK_S)
                data = os.read(self._master, 4096) if readable else b""
            except OSError:
                data = b""
                self._stop.wait(_TICK_S)
            wrong = self._wrong_rate()
            with self.lock:
                now = time.monotonic()
                out = self._core.handle(garbled(data) if wrong else data, now) if data else b""
                out += self._core.advance(now)
            if out:
                # A client that does not read loses bytes, as at a real port.
                with contextlib.suppress(OSError):
                    os.write(self._master, garbled(out) if wrong else out)
