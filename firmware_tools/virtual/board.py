"""The board below the firmware: interrupts, pins, serial line and watchdog as in MicroPython.

The firmware runs in its own thread; interrupts of a real board are queued and served whenever the firmware
sleeps, so that interrupt and loop never run concurrently, as on the board.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import queue
import struct
import termios
import time
import tty
from collections.abc import Callable
from typing import Any

from tagid.workers import Worker

Report = Callable[[dict[str, Any]], None]
RESET_CAUSES = {
    "PWRON_RESET": 1,
    "HARD_RESET": 2,
    "WDT_RESET": 3,
    "DEEPSLEEP_RESET": 4,
    "SOFT_RESET": 5,
}
"""Numbers of MicroPython's ESP32 port (ports/esp32/modmachine.c). A brown-out is reported as PWRON_RESET and
a crash as HARD_RESET, so the cause cannot tell whether the robot was driving."""
SCHEDULED = 8
"""Pin interrupts that wait for the interpreter (MICROPY_SCHEDULER_DEPTH of the ESP32 port); more are lost."""
_SPEEDS = {
    int(name[1:]): getattr(termios, name) for name in dir(termios) if name[1:].isdigit() and name[0] == "B"
}


class Board:
    """Implements the hardware behind the modules `machine` and `time`.

    Args:
        uart: path of the tty of the robot, or "loop" for TX connected to RX.
        report: called with {"pin": ..., "value": ..., "us": ...} when an output changes.
        end: called with an exit code when the board resets.
        reset_cause: value of `machine.reset_cause()`.
    """

    def __init__(self, uart: str, report: Report, end: Callable[[int], None], reset_cause: int = 1) -> None:
        self.uart_path = uart
        self.report = report
        self.end = end
        self.reset_cause = reset_cause
        self.pins: dict[int, VirtualPin] = {}
        self.watchdog_due: float | None = None
        self._interrupts: queue.Queue[Callable[[], None]] = queue.Queue()
        self._scheduled = 0

    def interrupt(self, handler: Callable[[], None]) -> None:
        """Queue a handler for the firmware's thread; from any thread."""
        self._interrupts.put(handler)

    def schedule(self, handler: Callable[[], None]) -> None:
        """Queue a pin's handler as MicroPython does: late if the firmware is busy, lost beyond SCHEDULED.

        From one thread only.
        """
        if self._scheduled >= SCHEDULED:
            self.report({"lost_interrupt": True})
            return
        self._scheduled += 1

        def run() -> None:
            self._scheduled -= 1
            handler()

        self.interrupt(run)

    def sleep_ms(self, duration: int) -> None:
        """The firmware's sleep: interrupts are served as they arrive."""
        deadline = time.monotonic() + duration / 1000
        while True:
            try:
                handler = self._interrupts.get(timeout=max(deadline - time.monotonic(), 0.0))
            except queue.Empty:
                return
            handler()

    def feed(self, timeout_ms: float) -> None:
        self.watchdog_due = time.monotonic() + timeout_ms / 1000

    def start_guard(self) -> None:
        """End the board if the watchdog was not fed, or its thread fails because nobody reads its report."""

        def guard() -> None:
            while True:
                time.sleep(0.05)
                if self.watchdog_due is not None and time.monotonic() > self.watchdog_due:
                    self.report({"watchdog": True})
                    self.end(70)

        Worker(guard, "watchdog", lambda error: self.end(70)).start()


class VirtualPin:
    """`machine.Pin`: an output reports its changes, an input is driven by `pulse`."""

    IN, OUT, OPEN_DRAIN = 1, 3, 7
    PULL_UP = 2
    IRQ_RISING, IRQ_FALLING = 1, 2

    def __init__(
        self, board: Board, number: int, mode: int = 1, pull: int | None = None, *, value: int = 1
    ) -> None:
        self._board = board
        self._number = number
        self._value = value
        self._handler: Callable[[Any], None] | None = None
        board.pins[number] = self

    def value(self, value: int | None = None) -> int:
        """Read, or set and report."""
        if value is not None and value != self._value:
            self._value = value
            self._board.report({"pin": self._number, "value": value, "us": time.monotonic_ns() // 1000})
        return self._value

    def irq(self, handler: Callable[[Any], None], trigger: int) -> None:
        self._handler = handler

    def pulse(self) -> None:
        """Generate the edge that triggers the interrupt."""
        handler = self._handler
        if handler is not None:
            self._board.schedule(lambda: handler(self))


class VirtualUart:
    """`machine.UART` on a tty, or with TX connected to RX."""

    def __init__(self, board: Board, number: int, baudrate: int, **pins: Any) -> None:
        self._loop: bytearray | None = None
        if board.uart_path == "loop":
            self._loop = bytearray()
            return
        self._tty = os.open(board.uart_path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self._tty)
        self.init(baudrate)

    def init(self, baudrate: int) -> None:
        """Set the baud rate of the line; on a pty the other end can read it back."""
        if self._loop is None:
            settings = termios.tcgetattr(self._tty)
            settings[4] = settings[5] = _SPEEDS.get(baudrate, termios.B115200)
            termios.tcsetattr(self._tty, termios.TCSANOW, settings)

    def any(self) -> int:
        """Bytes waiting."""
        if self._loop is not None:
            return len(self._loop)
        try:
            return int(struct.unpack("i", fcntl.ioctl(self._tty, termios.FIONREAD, b"\0\0\0\0"))[0])
        except OSError:  # the robot's side of the pty is closed: a disconnected robot sends nothing
            return 0

    def read(self, count: int) -> bytes | None:
        """Up to `count` bytes, or None."""
        if self._loop is not None:
            data = bytes(self._loop[:count])
            del self._loop[:count]
            return data or None
        try:
            return os.read(self._tty, count) or None
        except OSError:
            return None

    def write(self, data: bytes) -> int:
        """Send bytes; if there is no reader they are lost, as on a real line."""
        if self._loop is not None:
            self._loop += data
            return len(data)
        with contextlib.suppress(OSError):
            os.write(self._tty, data)
        return len(data)
