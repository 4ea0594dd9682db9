"""The unmodified firmware over virtual Bluetooth: who may drive, and that bytes arrive, all and in order."""

from __future__ import annotations

import asyncio
import json
import queue
import random
import termios
import time
from pathlib import Path
from typing import Any

import pytest
from bleak import BleakClient
from bleak.backends.scanner import BaseBleakScanner
from bleak.exc import BleakError
from bumble.keys import MemoryKeyStore

from firmware_tools.virtual.backend import open_backend
from firmware_tools.virtual.board import Board
from firmware_tools.virtual.process import BoardProcess
from tagid.errors import DeviceError, DeviceGoneError, DeviceRejectedError, UsageError
from tagid.motion.bridge.client import Bridge
from tagid.motion.bridge.find import Backends, find
from tagid.motion.bridge.protocol import COMMAND, NUS_RX, Event, Flag, Op, Overflow, encode
from tests.firmware.conftest import CONFIG, PASSKEY, STOP, Wire, bridge_on, host, on_loop

AFTER_ONE_FAILED_S = 2.1
"""Longer than the bridge waits after one failed try."""


@on_loop
async def test_bytes_cross_both_ways_unchanged_and_in_order(board: BoardProcess, wire: Wire) -> None:
    random.seed(4)
    to_robot, from_robot = random.randbytes(900), random.randbytes(3000)
    received = bytearray()
    async with host(board, on_bytes=received.extend) as bridge:
        await bridge.arm(5000)  # a busy machine may take longer than the usual 400 ms
        await bridge.write(to_robot)
        assert await asyncio.to_thread(wire.read, len(to_robot)) == to_robot
        await asyncio.to_thread(wire.write, from_robot)
        async with asyncio.timeout(20):
            while len(received) < len(from_robot):
                await asyncio.sleep(0.01)
        status = await bridge.status()
        assert (status.to_robot, status.from_robot) == (3 * len(STOP) + 900, 3000)
        assert (status.lost_to_robot, status.lost_from_robot) == (0, 0)
        await bridge.disarm()
    assert bytes(received) == from_robot


def test_an_unpaired_host_can_read_the_version_and_nothing_else(board: BoardProcess, wire: Wire) -> None:
    async def attempt(passkey: str | None) -> None:
        async with open_backend(board.hci, passkey) as pair:
            backends = Backends(*pair)
            heard = await find(board.address, 20.0, backends)
            async with BleakClient(heard.device, backend=backends.client, timeout=20) as client:
                assert b"robot-7" in bytes(
                    await client.read_gatt_char("7d1c0004-3a6e-4f52-9b0d-7461676964b1")
                )
                # Without a keyboard the pairing itself succeeds, but proves nothing.
                if passkey is None:
                    await client.pair()
                else:
                    with pytest.raises(BleakError):
                        await client.pair()
                for uuid, data in ((COMMAND, encode(Op.BRC, 1, 100, 1, 0)), (NUS_RX, b"\x80\x83\x89")):
                    with pytest.raises(BleakError, match=r"AUTHENTICATION|broke|Not connected"):
                        await client.write_gatt_char(uuid, data, response=True)
                if client.is_connected:
                    await client.write_gatt_char(NUS_RX, b"\x80\x83\x89", response=False)

    async def wrong() -> None:
        with pytest.raises(DeviceRejectedError, match="refused the pairing"):
            async with host(board, "111111"):
                pass

    asyncio.run(attempt(None))
    asyncio.run(attempt("111111"))
    asyncio.run(wrong())
    time.sleep(AFTER_ONE_FAILED_S)
    asyncio.run(_owner(board))
    assert wire.waiting() == b"" and not [line for line in board.changes if "pin" in line]


async def _owner(board: BoardProcess) -> None:
    async with host(board) as bridge:
        assert Flag.TRUSTED in (await bridge.read_info()).flags


def test_failed_tries_are_counted_over_reboots_and_owners(wire: Wire, tmp_path: Path) -> None:
    """Every wrong pass-key counts for its life, though it reboots and its owner pairs in between."""
    tries = tmp_path / "tries.json"

    async def attempt(board: BoardProcess, passkey: str) -> None:
        async with host(board, passkey):
            pass

    for before in (0, 1, 5):
        tries.write_text(str(before))
        with bridge_on(wire, CONFIG, "--folder", str(tmp_path)) as board:
            if before == 1:
                time.sleep(AFTER_ONE_FAILED_S)
                asyncio.run(attempt(board, PASSKEY))  # the owner's own success changes nothing
            else:
                if before == 0:
                    with pytest.raises(DeviceRejectedError):
                        asyncio.run(attempt(board, "100000"))
                with pytest.raises(DeviceRejectedError):  # too early or too late: not answered, not counted
                    asyncio.run(attempt(board, PASSKEY))
        assert json.loads(tries.read_text()) == max(before, 1)


def test_legacy_pairing_with_the_right_passkey_arms_nothing(board: BoardProcess, wire: Wire) -> None:
    async def run() -> None:
        async with host(board, secure=False) as bridge:
            await bridge.arm()

    with pytest.raises(DeviceError):
        asyncio.run(run())
    assert wire.waiting() == b""
    time.sleep(AFTER_ONE_FAILED_S)
    asyncio.run(_owner(board))


@on_loop
async def test_a_bond_survives_the_boards_restart(wire: Wire, tmp_path: Path) -> None:
    store = MemoryKeyStore()
    for passkey in (PASSKEY, None):  # the second time no key is typed
        with bridge_on(wire, CONFIG, "--folder", str(tmp_path)) as board:
            async with open_backend(board.hci, passkey, store=store, address="F2:00:00:00:00:09") as pair:
                backends = Backends(*pair)
                heard = await find(board.address, 20.0, backends)
                async with Bridge(heard, passkey=passkey, backends=backends, timeout=20.0) as bridge:
                    uptime_us = int.from_bytes((await bridge.request(Op.TIME))[:8], "little")
                    assert 0 < uptime_us < 600e6, "the clock of a board that has just started"


@on_loop
async def test_what_is_lost_is_counted_and_told(wire: Wire) -> None:
    events: list[Event] = []
    received = bytearray()
    with bridge_on(wire, {**CONFIG, "baud": 300, "deadman_ms": 5000}) as board:
        async with host(board, on_bytes=received.extend, on_event=events.append) as bridge:
            # At 300 Bd a second carries 30 bytes: the queue of 1024 is full at the fifth packet.
            for _ in range(8):
                await bridge.write(bytes(240))
            status = await bridge.status()
            assert 4 * 240 <= 8 * 240 - status.lost_to_robot <= 1024 + 240
            assert status.lost_to_robot % 240 == 0, "a packet is lost whole, or a command would be cut"
            async with asyncio.timeout(20):
                while not [e for e in events if isinstance(e, Overflow) and e.lost == status.lost_to_robot]:
                    await asyncio.sleep(0.01)


@on_loop
async def test_loopback_baud_and_brc_reach_the_boards_pins(board: BoardProcess, wire: Wire) -> None:
    async with host(board) as bridge:
        with pytest.raises(DeviceRejectedError, match="no echo"):  # this wire ends at a robot
            await bridge.request(Op.LOOPBACK, 64)
        pattern = wire.waiting()
        assert pattern and all(0x40 <= byte < 0x80 for byte in pattern), "no opcode of a robot"
        await bridge.request(Op.BAUD, 19200)
        assert termios.tcgetattr(wire.master)[4] == termios.B19200
        await bridge.request(Op.BRC, 80, 2, 40)
    board.command("index")
    edges = [line["value"] for line in board.changes if "pin" in line]
    assert edges == [1, 0] * 2, "through the transistor: high pulls BRC low"


@on_loop
async def test_a_bridge_without_configuration_drives_nothing() -> None:
    with BoardProcess(None) as board:
        async with open_backend(board.hci) as pair:
            backends = Backends(*pair)
            heard = await find(board.address, 20.0, backends)
            assert heard.name == "tagid-setup"
            async with Bridge(heard, backends=backends, timeout=20.0) as bridge:
                assert Flag.PROVISIONED not in bridge.info.flags
                with pytest.raises(DeviceRejectedError, match="no valid configuration"):
                    await bridge.request(Op.ARM, 0)


def once_heard(scanner: type[BaseBleakScanner], names: list[str]) -> type[BaseBleakScanner]:
    """The scanner, whose search begins when devices with those names were heard.

    Which of them a search of a given length hears depends on the advertising intervals (1 s) and on how busy
    the machine is, and that is not what is tested here.
    """

    class Scanner(scanner):  # type: ignore[valid-type, misc]
        async def start(self) -> None:
            await super().start()
            async with asyncio.timeout(60):
                while sorted(seen.name or "" for seen, _ in self.seen_devices.values()) != names:
                    await asyncio.sleep(0.01)

    return Scanner


@on_loop
async def test_names_that_are_absent_or_ambiguous(board: BoardProcess) -> None:
    async with open_backend(board.hci) as pair, open_backend(board.hci) as twin:
        alone = Backends(once_heard(pair[0], ["robot-7"]), pair[1])
        with pytest.raises(DeviceGoneError, match=r"robot-7 \(F0:F1"):
            await find("robot-8", 0.1, alone)
        impostor = twin[1].device  # type: ignore[attr-defined]
        service = bytes.fromhex("11079ecadc240ee5a9e093f3a3b50100406e")
        await impostor.start_advertising(advertising_data=service + b"\x08\x09robot-7")
        with pytest.raises(UsageError, match="2 bridges have the name 'robot-7'"):
            await find("robot-7", 0.1, Backends(once_heard(pair[0], ["robot-7", "robot-7"]), pair[1]))
        theirs = Backends(once_heard(twin[0], ["robot-7"]), twin[1])
        assert (await find("ROBOT-7", 0.1, theirs)).address == board.address
        assert (await find(board.address, 20.0, Backends(*pair))).address == board.address


def test_a_watchdog_whose_report_nobody_reads_fires_all_the_same() -> None:
    def report(document: dict[str, Any]) -> None:
        raise BrokenPipeError

    ended: queue.Queue[int] = queue.Queue()
    board = Board("loop", report, ended.put)
    board.feed(0)
    board.start_guard()
    assert ended.get(timeout=20) == 70
