"""The dead-man, watched from the robot's end of the wire: whatever ends the host, the wheels stop."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from firmware_tools.virtual.process import BoardProcess
from tagid.errors import DeviceRejectedError
from tagid.motion.bridge.protocol import Event, Op, Reply, Status, Tripped
from tests.firmware.conftest import CONFIG, PASSKEY, STOP, Wire, bridge_on, host, on_loop

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


def test_a_link_cut_at_any_moment_stops_the_wheels(wire: Wire) -> None:
    random.seed(7)

    async def run(board: BoardProcess) -> float:
        async with host(board) as bridge:
            await bridge.arm()
            await bridge.write(DRIVE)
            assert await asyncio.to_thread(wire.read, len(DRIVE)) == DRIVE
            await asyncio.sleep(random.uniform(0.0, 0.3))
            cut = await asyncio.to_thread(board.command, "cut") / 1e6
            data, at = await asyncio.to_thread(read_until_stopped, wire)
            # The zeros in front complete a command that the cut may have torn.
            assert data.startswith(bytes(4) + STOP_WHEELS)
            return at - cut

    # The radio itself would notice only after a minute, so it is the silence that stops the wheels.
    with bridge_on(wire, CONFIG, "--supervision-ms", "60000") as board:
        assert asyncio.run(run(board)) <= LIMIT_S


def test_a_killed_host_stops_the_wheels(board: BoardProcess, wire: Wire) -> None:
    code = (
        "import asyncio\n"
        "from tests.firmware.conftest import host\n"
        f"class Board: hci, address = {board.hci!r}, {board.address!r}\n"
        "async def run():\n"
        "    async with host(Board) as bridge:\n"
        "        await bridge.arm()\n"
        "        await bridge.write(bytes((128, 131, 145, 0, 100, 255, 156)))\n"
        "        await asyncio.sleep(600)\n"
        "asyncio.run(run())\n"
    )
    root = str(Path(__file__).resolve().parents[2])
    process = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": root})
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


@on_loop
async def test_heartbeats_keep_the_wheels_turning(board: BoardProcess, wire: Wire) -> None:
    async with host(board) as bridge:
        await bridge.arm(2000)  # a busy machine may be late with a heartbeat, but not by three of them
        await bridge.write(DRIVE)
        await asyncio.sleep(3.0)
        assert wire.waiting() == DRIVE and (await bridge.status()).state == "armed"
        await bridge.disarm()
        assert await asyncio.to_thread(wire.read, 3 * len(STOP)) == 3 * STOP
    time.sleep(0.3)
    assert wire.waiting() == b"", "a host that said goodbye leaves nothing more to stop"


@pytest.mark.parametrize("how", ["drop", "close"])
def test_a_closed_link_stops_the_wheels_at_once(board: BoardProcess, wire: Wire, how: str) -> None:
    async def run() -> float:
        async with host(board) as bridge:
            await bridge.arm(5000)  # silence alone would take five seconds
            await bridge.write(DRIVE)
            assert await asyncio.to_thread(wire.read, len(DRIVE)) == DRIVE
            if how == "drop":
                await asyncio.to_thread(board.command, "drop")
            return time.monotonic()

    closed = asyncio.run(run())
    _, at = read_until_stopped(wire)
    assert at - closed <= LIMIT_S


@pytest.mark.parametrize("cause", ["hard", "wdt"])
def test_every_boot_stops_the_robot_three_times_whatever_the_cause(wire: Wire, cause: str) -> None:
    """A crash is reported as a hard reset, so no cause means that all is well; all: see test_bridge_vm."""
    with bridge_on(wire, CONFIG, "--reset-cause", cause):
        assert wire.waiting() == b""


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
async def test_disarming_a_robot_that_may_be_moving_stops_it(board: BoardProcess, wire: Wire) -> None:
    async with host(board) as bridge:
        await bridge.arm(5000)
        await bridge.write(DRIVE)
        assert await asyncio.to_thread(wire.read, len(DRIVE)) == DRIVE
        await bridge.disarm()
        # The next drive command waits until the last stop is out.
        await bridge.arm(5000)
        await bridge.write(DRIVE)
        assert await asyncio.to_thread(wire.read, 3 * len(STOP)) == 3 * STOP
        assert await asyncio.to_thread(wire.read, len(DRIVE)) == DRIVE
        with pytest.raises(DeviceRejectedError, match="busy"):
            await bridge.request(Op.BAUD, 19200)
        await bridge.disarm()


@on_loop
async def test_no_passkey_means_open_and_says_so(wire: Wire) -> None:
    with bridge_on(wire, {**CONFIG, "passkey": None}) as board:
        async with host(board, None) as bridge:
            assert bridge.info.flags & 6 == 4
            await bridge.request(Op.TIME)
    assert PASSKEY
