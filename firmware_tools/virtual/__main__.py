"""One board as a process: `python -m firmware_tools.virtual --config bridge.json --uart /dev/pts/7`.

Prints one JSON line when a host may connect, then one per pin change; reads commands on stdin.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import os
import shutil
import sys
import tempfile
import threading
import time
import traceback
import types
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from bumble import hci
from bumble.device import Device
from bumble.host import Host

from firmware_tools.virtual.air import COMMAND_TIMEOUT_S, Air, HciServer, make_controller
from firmware_tools.virtual.ble import MicroUUID, VirtualBle
from firmware_tools.virtual.board import RESET_CAUSES, Board, VirtualPin, VirtualUart
from tagid import processes

_FIRMWARE = Path(__file__).resolve().parent.parent / "bridge"
_CAUSES = {name.removesuffix("_RESET").lower(): number for name, number in RESET_CAUSES.items()}
_WATCHDOG, _RESET = 70, 71
"""Exit codes of a board whose watchdog fired, and of one that called machine.reset()."""
_REPORTS = sys.stdout
_PERIOD = 1 << 30
"""The ticks of an ESP32 wrap at 2^30."""
COMMANDS = (
    "cut: the link is lost; drop: it closes; index: a pulse; stall MS: the firmware hangs; "
    "break: an interrupt of the radio fails; quit"
)


def report(document: dict[str, Any]) -> None:
    """One JSON line on stdout."""
    _REPORTS.write(json.dumps(document) + "\n")
    _REPORTS.flush()


def arguments(words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m firmware_tools.virtual", description=__doc__, epilog=COMMANDS
    )
    parser.add_argument(
        "--config", type=Path, help="configuration file; without one the bridge is not provisioned"
    )
    parser.add_argument(
        "--uart", default="loop", help="tty of the robot, or 'loop': TX connected to RX (default)"
    )
    parser.add_argument("--hci", default="tcp-server:127.0.0.1:0", help="address of the host's controller")
    parser.add_argument("--address", default="F0:F1:F2:F3:F4:01", help="the bridge's Bluetooth address")
    parser.add_argument("--folder", type=Path, help="the board's file system; default: a temporary one")
    parser.add_argument(
        "--interval-ms", type=float, default=0.0, help="connection interval, limits the throughput"
    )
    parser.add_argument(
        "--supervision-ms", type=float, default=2000.0, help="time after which a lost link is detected"
    )
    parser.add_argument(
        "--reset-cause", choices=sorted(_CAUSES), default="pwron", help="value of machine.reset_cause()"
    )
    parser.add_argument(
        "--reboot", action="store_true", help="restart after a reset like a board; otherwise exit"
    )
    return parser.parse_args(words)


def ticks_diff(later: int, earlier: int) -> int:
    """Signed difference of two readings of a wrapping clock."""
    return ((later - earlier + _PERIOD // 2) % _PERIOD) - _PERIOD // 2


def install(board: Board, ble: Any, folder: str) -> None:
    """Install what CPython lacks: `machine`, `bluetooth`, `micropython`, and more of `time` and `sys`.

    Modules are global to the process, so each process is one board.
    """
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
        "reset": lambda: board.end(_RESET),
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


def run_firmware(board: Board) -> None:
    """Run the unmodified main.py in this thread."""
    try:
        source = (_FIRMWARE / "main.py").read_text()
        exec(compile(source, "main.py", "exec"), {"__name__": "__main__"})
    except BaseException:
        traceback.print_exc()
        board.end(1)


def make_end(options: argparse.Namespace) -> Callable[[int], None]:
    """Effect of a reset: the process ends with its exit code, or restarts with the cause of the reset."""

    def end(code: int) -> None:
        if options.reboot and code in (_WATCHDOG, _RESET):
            cause = "wdt" if code == _WATCHDOG else "hard"
            words = [word for word in sys.argv[1:] if not word.startswith("--reset-cause")]
            processes.replace("firmware_tools.virtual", *words, f"--reset-cause={cause}")
        os._exit(code)

    return end


async def serve(options: argparse.Namespace) -> None:
    """Set up the virtual link, start the firmware and process commands."""
    loop = asyncio.get_running_loop()
    air = Air(options.interval_ms / 1000, options.supervision_ms / 1000)
    controller = make_controller("bridge", air)
    host = Host()
    host.controller = controller
    device = Device(name="bridge", address=hci.Address(options.address), host=host)
    device.command_timeout = COMMAND_TIMEOUT_S
    board = Board(options.uart, report, make_end(options), _CAUSES[options.reset_cause])
    advertising = asyncio.Event()
    ble = VirtualBle(board, device, loop, air)
    ble.on_advertise = advertising.set
    install(board, ble, str(_FIRMWARE))
    _, _, address = options.hci.partition("tcp-server:")
    host_name, _, port_text = address.rpartition(":")
    port = await HciServer(air, controller).start(host_name or "127.0.0.1", int(port_text))
    threading.Thread(target=run_firmware, args=(board,), daemon=True).start()
    board.start_guard()
    await advertising.wait()
    report(
        {"ready": True, "hci": f"tcp-client:{host_name or '127.0.0.1'}:{port}", "address": options.address}
    )
    reader = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    while line := (await reader.readline()).decode().split():
        if line[0] == "cut":
            air.cut()
        elif line[0] == "drop":
            for connection in list(device.connections.values()):
                await connection.disconnect()
        elif line[0] == "index":
            for pin in board.pins.values():
                pin.pulse()
        elif line[0] == "stall":
            board.interrupt(partial(time.sleep, float(line[1]) / 1000))
        elif line[0] == "break":
            ble.break_next_event()
        elif line[0] == "quit":
            return
        report({"done": line[0], "us": time.monotonic_ns() // 1000})


def main() -> None:
    """Entry point; ends with stdin."""
    options = arguments(sys.argv[1:])
    folder = Path(options.folder or tempfile.mkdtemp(prefix="bridge-"))
    folder.mkdir(parents=True, exist_ok=True)
    if options.config is not None:
        shutil.copyfile(options.config, folder / "bridge.json")
    os.chdir(folder)
    sys.stdout = sys.stderr  # the firmware's output belongs on its console
    # A rejected write without response has no recipient for the error; bumble would print its traceback.
    logging.getLogger("bumble.gatt_server").setLevel(logging.CRITICAL)
    try:
        asyncio.run(serve(options))
    finally:
        if options.folder is None:
            shutil.rmtree(folder, ignore_errors=True)
        os._exit(0)


if __name__ == "__main__":
    main()
