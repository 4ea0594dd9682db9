"""A robot's wire on a pty, and the unmodified firmware behind a virtual controller in its own process."""

from __future__ import annotations

import asyncio
import functools
import json
import os
import select
import time
import tty
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from typing import Any

import pytest

from firmware_tools.cli import app
from firmware_tools.virtual.backend import open_backend
from firmware_tools.virtual.process import BoardProcess
from tagid.cli.frame import serve
from tagid.motion.bridge.client import Bridge
from tagid.motion.bridge.find import Backends, find
from tagid.motion.bridge.protocol import COMMAND, Op, encode

collect_ignore = ["vm/scenario.py"]  # runs in MicroPython

PASSKEY = "482913"
PINS = {"uart_tx": 4, "uart_rx": 5, "brc_pin": 6, "index_pin": 7}
CONFIG: dict[str, Any] = {"name": "robot-7", "passkey": PASSKEY, **PINS}

STOP = bytes.fromhex("000000009100000000839100000000" + "80")
"""What the bridge writes to stop the robot (docs/bridge.md), three times at every boot."""


Command = Callable[..., tuple[int, dict[str, Any]]]
"""Runs `tagid-firmware WORDS --output json`; returns its exit code and its document."""


@pytest.fixture
def firmware(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """The firmware's command line, in this process."""

    def go(*words: str) -> tuple[int, dict[str, Any]]:
        monkeypatch.setattr("sys.argv", ["tagid-firmware", *words, "--output", "json"])
        code = serve(app)
        return code, json.loads(capsys.readouterr().out)

    return go


def on_loop(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """The asynchronous test, run on an event loop of its own."""

    @functools.wraps(test)
    def run(*args: Any, **kwargs: Any) -> None:
        asyncio.run(test(*args, **kwargs))

    return run


class Wire:
    """The robot's end of the serial line."""

    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.master)
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)

    def read(self, count: int, timeout: float = 20.0) -> bytes:
        """`count` bytes, or what came before the timeout."""
        data, deadline = b"", time.monotonic() + timeout
        while len(data) < count and self._comes(max(deadline - time.monotonic(), 0)):
            data += os.read(self.master, count - len(data))
        return data

    def waiting(self) -> bytes:
        """What is there now."""
        return os.read(self.master, 65536) if self._comes(0) else b""

    def _comes(self, timeout: float) -> bool:
        return bool(select.select([self.master], [], [], timeout)[0])

    def write(self, data: bytes) -> None:
        os.write(self.master, data)

    def close(self) -> None:
        os.close(self.master)
        os.close(self.slave)


@pytest.fixture
def wire() -> Iterator[Wire]:
    made = Wire()
    yield made
    made.close()


@contextmanager
def bridge_on(wire: Wire, config: dict[str, Any] = CONFIG, *options: str) -> Iterator[BoardProcess]:
    """A bridge whose robot is `wire`, after the stops of its boot."""
    with BoardProcess(config, wire.path, *options) as process:
        assert wire.read(3 * len(STOP)) == 3 * STOP
        yield process


@pytest.fixture
def board(wire: Wire) -> Iterator[BoardProcess]:
    """A provisioned bridge whose robot is `wire`."""
    with bridge_on(wire) as process:
        yield process


class DrivingBridge(Bridge):
    """A bridge whose dead-man is kept from tripping by heartbeats, four in its timeout."""

    heart: asyncio.Task[None] | None = None

    async def arm(self, timeout_ms: int = 0) -> None:
        """Arm the dead-man and start the heartbeats."""
        self.stop_heart()
        taken = int.from_bytes((await self.request(Op.ARM, timeout_ms))[:2], "little")
        self.heart = asyncio.get_running_loop().create_task(self.beat(taken / 1000 / 4))

    async def beat(self, every: float) -> None:
        with suppress(Exception):  # the link is lost
            while True:
                await asyncio.sleep(every)
                await self._client.write_gatt_char(COMMAND, encode(Op.HEARTBEAT, 0), response=True)

    def stop_heart(self) -> None:
        if self.heart is not None:
            self.heart.cancel()

    async def disarm(self) -> None:
        """Stop the heartbeats and disarm the dead-man; the robot must already be stopped and in Passive."""
        self.stop_heart()
        await self.request(Op.DISARM)

    async def close(self) -> None:
        self.stop_heart()
        await super().close()


@asynccontextmanager
async def host(
    board: BoardProcess, passkey: str | None = PASSKEY, secure: bool = True, **callbacks: Any
) -> AsyncIterator[DrivingBridge]:
    """A host that found and paired with the bridge."""
    async with open_backend(board.hci, passkey, secure=secure) as pair:
        backends = Backends(*pair)
        heard = await find(board.address, 20.0, backends)
        bridge = DrivingBridge(heard, passkey=passkey, backends=backends, timeout=20.0, **callbacks)
        async with bridge:
            yield bridge
