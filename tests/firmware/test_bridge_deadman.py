"""The dead-man, watched from the robot's end of the wire: whatever ends the host, the wheels stop."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from firmware_tools.virtual.process import BoardProcess
from tagid.motion.bridge.protocol import Event, Op, Reply, Status, Tripped
from tests.firmware.conftest import CONFIG, STOP, Wire, bridge_on, host, on_loop

pytestmark = pytest.mark.realtime

# Roomba Open Interface: Start, Safe, Drive Direct 100 -100.
DRIVE = bytes((128, 131, 145, 0, 100, 0xFF, 0x9C))
STOP_WHEELS = bytes((145, 0, 0, 0, 0))
PASSIVE = 128
LIMIT_S = 5.0
"""Generous, because this machine may be busy; test_bridge_vm holds the 500 ms in the firmware's own time."""


def stops(data: bytes) -> bool:
    """Whether bytes end with stopped wheels and a robot in Passive."""
    return STOP_WHEELS in data and data.endswith(bytes((PASSIVE,)))


def read_until_stopped(wire: Wire) -> tuple[bytes, float]:
    """What came, and when the last stop byte of the first sequence did, on the monotonic clock."""
    data = b""
    while not stops(data):
        piece = wire.read(1)
        assert piece, f"the robot was not stopped; it heard {data.hex()}"
        data += piece
    return data, time.monotonic()


DRIVER = """
import asyncio, sys
from types import SimpleNamespace
from tests.firmware.conftest import host

async def run():
    async with host(SimpleNamespace(hci=sys.argv[1], address=sys.argv[2])) as bridge:
        await bridge.arm()
        await bridge.write(bytes.fromhex(sys.argv[3]))
        await asyncio.sleep(600)

asyncio.run(run())
"""


def test_a_killed_host_stops_the_wheels(board: BoardProcess, wire: Wire) -> None:
    root = str(Path(__file__).resolve().parents[2])
    words = [sys.executable, "-c", DRIVER, board.hci, board.address, DRIVE.hex()]
    process = subprocess.Popen(words, env={**os.environ, "PYTHONPATH": root})
    try:
        assert wire.read(len(DRIVE)) == DRIVE
        process.send_signal(signal.SIGKILL)
        killed = time.monotonic()
        _, at = read_until_stopped(wire)
        assert at - killed <= LIMIT_S
    finally:
        process.kill()
        process.wait()


@on_loop
async def test_silence_trips_and_nothing_drives_until_armed_again(board: BoardProcess, wire: Wire) -> None:
    events: list[Event] = []
    async with host(board, on_event=events.append) as bridge:
        # Without a heartbeat: a plain terminal program that only writes.
        await bridge.write(DRIVE)
        data = await asyncio.to_thread(wire.read, len(DRIVE))
        assert data == DRIVE
        await asyncio.to_thread(read_until_stopped, wire)
        async with asyncio.timeout(20):
            while not events:
                await asyncio.sleep(0.01)
        assert isinstance(events[0], Tripped) and events[0].cause == "silence of the host"
        assert events[0].silent_ms >= 400
        repeats = await asyncio.to_thread(wire.read, 2 * 16)
        assert repeats.count(STOP_WHEELS) == 4 and stops(repeats)
        await bridge.write(DRIVE)
        reply: Reply = await bridge.ask(Op.HEARTBEAT)
        assert reply.status == Status.TRIPPED and wire.waiting() == b""
        assert (await bridge.status()).lost_to_robot == len(DRIVE)
        await bridge.arm(1000)
        await bridge.write(DRIVE)
        assert await asyncio.to_thread(wire.read, len(DRIVE)) == DRIVE
        await bridge.disarm()


def test_a_closed_link_stops_the_wheels_at_once(board: BoardProcess, wire: Wire) -> None:
    async def run(how: str) -> float:
        async with host(board) as bridge:
            await bridge.arm(5000)  # silence alone would take five seconds
            await bridge.write(DRIVE)
            assert await asyncio.to_thread(wire.read, len(DRIVE)) == DRIVE
            if how == "drop":
                await asyncio.to_thread(board.command, "drop")
            return time.monotonic()

    for how in ("drop", "close"):
        closed = asyncio.run(run(how))
        _, at = read_until_stopped(wire)
        assert at - closed <= LIMIT_S
        assert wire.read(2 * len(STOP)) == 2 * STOP


def test_a_killed_firmware_stops_the_robot_when_it_boots_again(wire: Wire) -> None:
    with bridge_on(wire) as board:

        async def drive() -> None:
            async with host(board) as bridge:
                await bridge.arm(5000)
                await bridge.write(DRIVE)
                assert await asyncio.to_thread(wire.read, len(DRIVE)) == DRIVE
                board.process.kill()
                board.process.wait()

        with contextlib.suppress(Exception):  # the host's link is gone
            asyncio.run(drive())
    assert wire.waiting() == b"", "nothing can stop it before the boot"
    with bridge_on(wire):
        pass


def test_a_hung_firmware_boots_again_and_stops_the_robot(wire: Wire, tmp_path: Path) -> None:
    with bridge_on(wire, CONFIG, "--reboot", "--folder", str(tmp_path)) as board:
        board.command("stall 600000")
        assert wire.read(3 * len(STOP), 60) == 3 * STOP


def test_an_interrupt_that_fails_stops_the_robot(wire: Wire, tmp_path: Path) -> None:
    """MicroPython prints such an exception and goes on; the bridge stops the robot and restarts."""

    async def drive(board: BoardProcess) -> None:
        async with host(board) as bridge:
            await bridge.arm(5000)
            await bridge.write(DRIVE)
            assert await asyncio.to_thread(wire.read, len(DRIVE)) == DRIVE
            await asyncio.to_thread(board.command, "break")
            assert await asyncio.to_thread(wire.read, 3 * len(STOP)) == 3 * STOP

    with bridge_on(wire) as board:
        with contextlib.suppress(Exception):  # the board restarts under the host
            asyncio.run(drive(board))
        assert board.process.wait(20) == 71


@on_loop
async def test_no_passkey_means_open_and_says_so(wire: Wire) -> None:
    with bridge_on(wire, {**CONFIG, "passkey": None}) as board:
        async with host(board, None) as bridge:
            assert bridge.info.flags & 6 == 4
            await bridge.request(Op.TIME)
