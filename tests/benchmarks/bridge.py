"""Throughput and latency of the Bluetooth bridge: the firmware behind virtual controllers, two processes.

The virtual air has no radio; its connection events are 0 or 30 ms apart, as on real links. The last
figure is the time from the cut to the last byte of the first stop sequence at the robot's end of the wire.
"""

from __future__ import annotations

import asyncio
import os
import random
import statistics
import threading
import time
import tty
from collections.abc import Iterator

from firmware_tools.virtual.backend import open_backend
from firmware_tools.virtual.process import BoardProcess
from tagid.motion.bridge.client import Bridge
from tagid.motion.bridge.find import Backends, find
from tagid.motion.bridge.protocol import Op
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table
from tests.firmware.conftest import DrivingBridge

CONFIG = {"name": "bench", "passkey": "482913", "uart_tx": 4, "uart_rx": 5}
DRIVE = bytes((128, 131, 145, 0, 100, 0xFF, 0x9C))
STOP = bytes((145, 0, 0, 0, 0, 131, 145, 0, 0, 0, 0, 128))
FRAME = 13
PERIOD_S = 0.015


class Wire:
    """The robot's end of a pty."""

    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.master)
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)


async def stream(bridge: Bridge, wire: Wire, arrived: list[tuple[float, int]], frames: int) -> list[float]:
    """Frames of a robot's stream: ms from the last byte on the wire to the callback in the host."""
    sent: list[float] = []

    def robot() -> None:
        start = time.perf_counter()
        for number in range(frames):
            while time.perf_counter() < start + number * PERIOD_S:
                time.sleep(0.0005)
            sent.append(time.perf_counter())
            os.write(wire.master, bytes(FRAME))

    arrived.clear()
    thread = threading.Thread(target=robot)
    thread.start()
    while sum(count for _, count in arrived) < frames * FRAME:
        await asyncio.sleep(0.005)
    thread.join()
    delays, total, index = [], 0, 0
    for at, count in arrived:
        total += count
        while index < frames and (index + 1) * FRAME <= total:
            delays.append(1000 * (at - sent[index]))
            index += 1
    return delays


async def upload(bridge: Bridge, wire: Wire, arrived: list[tuple[float, int]], size: int) -> float:
    """kB/s from the wire to the host, as fast as the bridge takes it at 115200 Bd's 11.5 kB/s."""
    arrived.clear()
    start = time.perf_counter()

    def robot() -> None:
        for done in range(0, size, 115):
            while time.perf_counter() < start + done / 11520:
                time.sleep(0.0005)
            os.write(wire.master, bytes(min(115, size - done)))

    thread = threading.Thread(target=robot)
    thread.start()
    while sum(count for _, count in arrived) < size:
        await asyncio.sleep(0.002)
    thread.join()
    return size / (arrived[-1][0] - start) / 1000


async def measure(interval_ms: float, seed: int, short: bool) -> dict[str, float]:
    """All figures of one run."""
    random.seed(seed)
    wire = Wire()
    arrived: list[tuple[float, int]] = []
    options = ("--interval-ms", str(interval_ms), "--supervision-ms", "60000")
    with BoardProcess(CONFIG, wire.path, *options) as board:
        async with open_backend(board.hci, CONFIG["passkey"]) as pair:
            backends = Backends(*pair)
            heard = await find(board.address, 20.0, backends)

            def on_bytes(data: bytes) -> None:
                arrived.append((time.perf_counter(), len(data)))

            async with DrivingBridge(
                heard, on_bytes=on_bytes, passkey=CONFIG["passkey"], backends=backends
            ) as bridge:
                echoes = []
                for _ in range(50 if short else 200):
                    start = time.perf_counter()
                    await bridge.request(Op.ECHO, data=bytes(20))
                    echoes.append(1000 * (time.perf_counter() - start))
                delays = await stream(bridge, wire, arrived, 100 if short else 1000)
                rate = await upload(bridge, wire, arrived, 20_000 if short else 100_000)
                status = await bridge.status()
                await bridge.arm()
                await bridge.write(DRIVE)
                # The bridge stops the robot when it starts, too.
                data = b""
                while DRIVE not in data:
                    data += await asyncio.to_thread(os.read, wire.master, 1)
                await asyncio.sleep(random.uniform(0.05, 0.5))
                cut = await asyncio.to_thread(board.command, "cut") / 1e6
                data = b""
                while STOP not in data:
                    data += await asyncio.to_thread(os.read, wire.master, 1)
                stopped = 1000 * (time.monotonic() - cut)
    os.close(wire.master)
    os.close(wire.slave)
    return {
        "echo_median": statistics.median(echoes),
        "stream_median": statistics.median(delays),
        "stream_99": sorted(delays)[int(0.99 * len(delays))],
        "rate": rate,
        "lost": status.lost_from_robot + status.lost_to_robot,
        "retries": status.notify_retries,
        "stopped": stopped,
    }


def throughput(run: Run) -> Iterator[Table]:
    """A row for each connection interval, the median over the seeds (worst for the dead-man)."""
    seeds = run.number(3)
    run.seeds = f"{seeds}; median, and the worst for the last column"
    rows = []
    for interval in (0.0, 30.0):
        runs = [asyncio.run(measure(interval, seed, run.quick)) for seed in range(seeds)]
        middle = {key: statistics.median(run[key] for run in runs) for key in runs[0]}
        worst, lost = max(run["stopped"] for run in runs), sum(run["lost"] for run in runs)
        times = [f"{middle[key]:.1f}" for key in ("echo_median", "stream_median", "stream_99")]
        rows.append(
            (
                f"{interval:g}",
                *times,
                f"{middle['rate']:.2f}",
                lost,
                f"{middle['retries']:.0f}",
                f"{worst:.0f}",
            )
        )
    columns = (
        "connection interval ms", "echo ms", "frame ms", "99 %", "kB/s", "bytes lost", "sent again",
        "cut to stop ms, worst",
    )  # fmt: skip
    yield Table(columns, rows)
