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
from collections.abc import Iterator, Sequence

from firmware_tools.virtual.backend import open_backend
from firmware_tools.virtual.process import BoardProcess
from tagid.motion.bridge.find import Backends, find
from tagid.motion.bridge.protocol import Op
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table
from tests.firmware.conftest import DrivingBridge, Wire

CONFIG = {"name": "bench", "passkey": "482913", "uart_tx": 4, "uart_rx": 5}
DRIVE = bytes((128, 131, 145, 0, 100, 0xFF, 0x9C))
STOP = bytes((145, 0, 0, 0, 0, 131, 145, 0, 0, 0, 0, 128))
FRAME = 13
PERIOD_S = 0.015


async def sent_by(
    wire: Wire, arrived: list[tuple[float, int]], pieces: Sequence[tuple[float, bytes]]
) -> tuple[float, list[float]]:
    """Bytes of a robot, each at its time: when the first was due, and when each was written."""
    written: list[float] = []
    arrived.clear()
    start = time.perf_counter()

    def robot() -> None:
        for at, piece in pieces:
            while time.perf_counter() < start + at:
                time.sleep(0.0005)
            written.append(time.perf_counter())
            os.write(wire.master, piece)

    thread = threading.Thread(target=robot)
    thread.start()
    size = sum(len(piece) for _, piece in pieces)
    while sum(count for _, count in arrived) < size:
        await asyncio.sleep(0.002)
    thread.join()
    return start, written


async def stream(wire: Wire, arrived: list[tuple[float, int]], frames: int) -> list[float]:
    """Frames of a robot's stream: ms from the last byte on the wire to the callback in the host."""
    pieces = [(number * PERIOD_S, bytes(FRAME)) for number in range(frames)]
    _, written = await sent_by(wire, arrived, pieces)
    delays, total = [], 0
    for at, count in arrived:
        total += count
        while len(delays) < frames and (len(delays) + 1) * FRAME <= total:
            delays.append(1000 * (at - written[len(delays)]))
    return delays


async def upload(wire: Wire, arrived: list[tuple[float, int]], size: int) -> float:
    """kB/s from the wire to the host, as fast as the bridge takes it at 115200 Bd's 11.5 kB/s."""
    pieces = [(done / 11520, bytes(min(115, size - done))) for done in range(0, size, 115)]
    start, _ = await sent_by(wire, arrived, pieces)
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
                delays = await stream(wire, arrived, 100 if short else 1000)
                rate = await upload(wire, arrived, 20_000 if short else 100_000)
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
    wire.close()
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
        counts = (f"{middle['rate']:.2f}", lost, f"{middle['retries']:.0f}", f"{worst:.0f}")
        rows.append((f"{interval:g}", *times, *counts))
    columns = (
        "connection interval ms | echo ms | frame ms | 99 % | kB/s | bytes lost | sent again | "
        "cut to stop ms, worst"
    )
    yield Table(columns, rows)
