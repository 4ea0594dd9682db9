"""Tests a bridge over Bluetooth, step by step, with a verdict for each step.

A step whose requirements are missing (a jumper, a robot, a pin) is skipped and reported as skipped.
"""

from __future__ import annotations

import asyncio
import statistics
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Final, Literal

from tagid.errors import DeviceError, MissingExtraError
from tagid.motion.bridge.client import Bridge
from tagid.motion.bridge.find import Backends, find
from tagid.motion.bridge.protocol import Flag, Op, Status
from tagid.motion.links import WAKE_S

_ECHOES: Final = 20
_SMALLEST_MTU: Final = 65
"""The status reply and its headers in one packet."""
# Roomba Open Interface: Start (to Passive, which moves nothing), then Query List: voltage (22), mode (35).
_QUERY: Final = bytes((128, 149, 2, 22, 35))
_MODES: Final = ("Off", "Passive", "Safe", "Full")

Verdict = Literal["passed", "failed", "skipped"]


@dataclass(frozen=True)
class Step:
    name: str
    verdict: Verdict
    text: str


@dataclass(frozen=True)
class SelftestPlan:
    """Options of the test.

    Attributes:
        name: name or address of the bridge.
        passkey: six digits, or None.
        loopback: TX and RX are connected; the robot is then not queried.
        brc: pulse BRC, which wakes a robot.
        listen_s: duration of the search, s.
    """

    name: str
    passkey: str | None = None
    loopback: bool = False
    brc: bool = True
    listen_s: float = 5.0


async def selftest(
    plan: SelftestPlan, progress: Callable[[float, str], None], backends: Backends
) -> list[Step]:
    """Run the steps in order. Raises the errors of `find` and `Bridge` if there is no bridge to test."""
    steps: list[Step] = []
    progress(0, "looking")
    heard = await find(plan.name, plan.listen_s, backends)
    steps.append(Step("find", "passed", f"{heard.name} at {heard.address}, {heard.rssi} dBm"))
    arrived = bytearray()
    async with Bridge(heard, on_bytes=arrived.extend, passkey=plan.passkey, backends=backends) as bridge:
        info = bridge.info
        secured = (
            "paired with its pass-key" if Flag.PASSKEY in info.flags else "open to anyone: set a pass-key"
        )
        steps.append(
            Step(
                "version",
                "passed" if Flag.PROVISIONED in info.flags else "failed",
                f"firmware {info.version} on {info.chip}, MicroPython {info.micropython}; {secured}",
            )
        )
        good = bridge.mtu >= _SMALLEST_MTU
        steps.append(Step("MTU", "passed" if good else "failed", f"{bridge.mtu} bytes"))
        parts: list[tuple[str, Callable[[], Awaitable[Step]]]] = [
            ("echo", lambda: _echo(bridge)),
            ("UART loopback", lambda: _loopback(bridge, plan)),
            ("BRC", lambda: _brc(bridge, plan)),
            ("robot", lambda: _robot(bridge, plan, arrived)),
            ("counters", lambda: _counters(bridge)),
        ]
        for done, (name, part) in enumerate(parts, 1):
            progress(done, name)
            try:
                steps.append(await part())
            except DeviceError as error:
                steps.append(Step(name, "failed", f"{error.message}. {error.remedy}"))
    return steps


async def _echo(bridge: Bridge) -> Step:
    payload = bytes(range(min(bridge.mtu - 6, 200)))
    took = []
    for _ in range(_ECHOES):
        start = time.perf_counter()
        if await bridge.request(Op.ECHO, data=payload) != payload:
            return Step("echo", "failed", "the returned bytes differ")
        took.append(1000 * (time.perf_counter() - start))
    text = f"{len(payload)} bytes: median {statistics.median(took):.1f} ms, longest {max(took):.1f} ms"
    return Step("echo", "passed", text)


async def _loopback(bridge: Bridge, plan: SelftestPlan) -> Step:
    if not plan.loopback:
        return Step("UART loopback", "skipped", "connect TX and RX, without the robot, and give --loopback")
    reply = await bridge.ask(Op.LOOPBACK, 256, timeout=20.0)
    if reply.status not in (Status.OK, Status.NO_ECHO) or len(reply.payload) != 8:
        return Step("UART loopback", "failed", f"the bridge answers status {reply.status}")
    sent, right = int.from_bytes(reply.payload[:2], "little"), int.from_bytes(reply.payload[2:4], "little")
    if reply.status == Status.NO_ECHO:
        return Step("UART loopback", "failed", f"{right} of {sent} bytes came back: check pins and jumper")
    seconds = int.from_bytes(reply.payload[4:], "little") / 1e6
    return Step("UART loopback", "passed", f"{sent} bytes returned in {1000 * seconds:.0f} ms")


async def _brc(bridge: Bridge, plan: SelftestPlan) -> Step:
    if not plan.brc:
        return Step("BRC", "skipped", "as asked")
    if Flag.BRC not in bridge.info.flags:
        return Step("BRC", "skipped", "no pin is configured")
    await bridge.request(Op.BRC, round(1000 * WAKE_S), 1, 0)
    return Step("BRC", "passed", f"one low pulse of {WAKE_S:g} s")


async def _robot(bridge: Bridge, plan: SelftestPlan, arrived: bytearray) -> Step:
    """Query voltage and mode; this cannot move a wheel."""
    if plan.loopback:
        return Step("robot", "skipped", "TX and RX are connected")
    arrived.clear()
    await bridge.write(_QUERY)
    for _ in range(100):
        if len(arrived) >= 3:
            break
        await asyncio.sleep(0.01)
    await bridge.request(Op.DISARM)
    if len(arrived) < 3:
        text = f"no answer ({bytes(arrived).hex(' ') or 'no byte'}): check wires and robot"
        return Step("robot", "failed", text)
    volts, mode = int.from_bytes(arrived[-3:-1], "big") / 1000, arrived[-1]
    if mode >= len(_MODES) or not 5 <= volts <= 25:
        return Step("robot", "failed", f"invalid answer ({bytes(arrived).hex(' ')}): check the baud rate")
    return Step("robot", "passed", f"battery {volts:.1f} V, mode {_MODES[mode]}")


async def _counters(bridge: Bridge) -> Step:
    status = await bridge.status()
    lost = status.lost_to_robot + status.lost_from_robot
    text = (
        f"{status.to_robot} bytes to the robot, {status.from_robot} from it, {lost} lost; "
        f"{status.notify_retries} notifications resent, dead-man tripped {status.trips} times"
    )
    return Step("counters", "failed" if lost else "passed", text)


def run_selftest(
    plan: SelftestPlan, progress: Callable[[float, str], None], hci: str | None = None
) -> list[Step]:
    """Run `selftest` in its own event loop.

    Args:
        hci: a virtual controller (bumble transport) instead of this computer's Bluetooth.
    """

    async def run() -> list[Step]:
        if hci is None:
            return await selftest(plan, progress, Backends())
        try:
            from firmware_tools.virtual.backend import open_backend
        except ImportError as error:
            raise MissingExtraError(
                "virtual controllers need bumble", "Install it: pip install bumble."
            ) from error
        async with open_backend(hci, plan.passkey) as pair:
            return await selftest(plan, progress, Backends(*pair))

    try:
        return asyncio.run(run())
    except (ConnectionError, TimeoutError) as error:
        raise DeviceError(
            f"no virtual controller at {hci}", "Start `python -m firmware_tools.virtual`."
        ) from error
