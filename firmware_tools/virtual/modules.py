"""The modules of MicroPython that CPython lacks, installed where `import` finds them.

Each process is one board, because modules are global to the process."""

from __future__ import annotations

import sys
import time
import traceback
import types
from functools import partial
from typing import Any

from firmware_tools.virtual.ble import MicroUUID
from firmware_tools.virtual.board import RESET_CAUSES, Board, VirtualPin, VirtualUart

_PERIOD = 1 << 30
"""The ticks of an ESP32 wrap at 2^30."""


def ticks_diff(later: int, earlier: int) -> int:
    """Signed difference of two readings of a wrapping clock."""
    return ((later - earlier + _PERIOD // 2) % _PERIOD) - _PERIOD // 2


def install(board: Board, ble: Any, folder: str) -> None:
    """Install `machine`, `bluetooth`, `micropython` and the extensions of `time` and `sys`."""
    machine = types.ModuleType("machine")
    pin = partial(VirtualPin, board)
    for name in ("IN", "OUT", "OPEN_DRAIN", "PULL_UP", "IRQ_RISING", "IRQ_FALLING"):
        setattr(pin, name, getattr(VirtualPin, name))

    class Watchdog:
        def __init__(self, timeout: int) -> None:
            self._timeout = timeout
            board.feed(timeout)

        def feed(self) -> None:
            board.feed(self._timeout)

    members = {
        "Pin": pin,
        "UART": partial(VirtualUart, board),
        "WDT": Watchdog,
        **RESET_CAUSES,
        "reset_cause": lambda: board.reset_cause,
        "reset": lambda: board.end(71),
    }
    for name, value in members.items():
        setattr(machine, name, value)
    bluetooth = types.ModuleType("bluetooth")
    bluetooth.UUID = MicroUUID  # type: ignore[attr-defined]
    bluetooth.BLE = lambda: ble  # type: ignore[attr-defined]
    micropython = types.ModuleType("micropython")
    micropython.const = lambda value: value  # type: ignore[attr-defined]
    sys.modules.update(machine=machine, bluetooth=bluetooth, micropython=micropython)
    clock: dict[str, Any] = {
        "ticks_us": lambda: (time.monotonic_ns() // 1000) % _PERIOD,
        "ticks_ms": lambda: (time.monotonic_ns() // 1_000_000) % _PERIOD,
        "ticks_add": lambda ticks, delta: (ticks + delta) % _PERIOD,
        "ticks_diff": ticks_diff,
        "sleep_ms": board.sleep_ms,
    }
    for name, value in clock.items():
        setattr(time, name, value)
    sys.print_exception = traceback.print_exception  # type: ignore[attr-defined]
    sys.path.insert(0, folder)
