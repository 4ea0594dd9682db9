"""Capture at the radar's fastest and largest settings: scans lost, share of a core, growth of memory.

The emulated radar is another process; this one does what a recording does: socket, regrouping,
queue, journal on disk with its syncs. CPU is user and system time of this process, all its threads.
"""

from __future__ import annotations

import argparse
import multiprocessing
import signal
import threading
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection

import numpy as np

from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.emulator import ServeOptions, serve_udp
from tagid.radar.settings import RadarConfig
from tagid.recording.intake import Intake
from tagid.recording.radars import open_radar
from tagid.storage.journal import JournalWriter
from tagid.storage.journal_queue import JournalQueue
from tests.benchmarks.measure import memory_mb
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

SETTINGS = {
    "fastest": RadarConfig(10_000, 15_000, base_integration_index=6),
    "largest": RadarConfig(10_000, 10_000 + 492_000, base_integration_index=11),
}
COLUMNS = "setting | wire | scans | lost | dropped | share of a core (%) | memory since it settled (MB)"


class Noise:
    """Noise from a table, so that the emulator does not need the core that the capture is measured on."""

    def __init__(self) -> None:
        self._table = np.random.default_rng(0).integers(-3000, 3000, (64, 8400)).astype(np.int32)

    def scan(self, index: int, time_s: float, config: RadarConfig) -> np.ndarray:
        """The scan of a number."""
        return self._table[index % 64, : config.samples]


def emulate(ready: Connection) -> None:
    """The other process: sends its URL, then is a radar in real time until terminated."""
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    serve_udp(EmulatorCore(Noise()), ServeOptions(port=0), stop, lambda h, p: ready.send(f"udp://{h}:{p}"))


def measure(name: str, seconds: float, run: Run) -> tuple[object, ...]:
    """The row of one setting, recorded for some seconds of the radar's clock."""
    ours, others = multiprocessing.Pipe()
    server = multiprocessing.get_context("spawn").Process(target=emulate, args=(others,))
    server.start()
    path = run.folder / f"{name}.tagid.journal"
    try:
        with open_radar(ours.recv(), 2.0) as radar:
            config = radar.set_config(SETTINGS[name])
            header = {"range_start_m": 0.0, "range_step_m": config.range_step_m}
            with (
                JournalWriter(path, header, sync_every=1, sync_seconds=0.5) as journal,
                JournalQueue(journal) as queue,
            ):
                scans = Intake(radar, queue, resume_s=0).scans()
                first = next(scans)
                settled: float | None = None
                cpu, wall = time.process_time(), time.monotonic()
                minute = 60.0
                for scan in scans:
                    passed = (scan.radar_time_ms - first.radar_time_ms) * 1e-3
                    if settled is None and passed > min(5.0, seconds / 2):
                        settled = memory_mb()
                    if passed >= minute:
                        run.say(f"{minute / 60:.0f} min: {memory_mb():.1f} MB")
                        minute += 60.0
                    if passed >= seconds:
                        break
                cpu, wall = time.process_time() - cpu, time.monotonic() - wall
                grown = memory_mb() - (settled or 0.0)
                scans.close()  # type: ignore[attr-defined]
            lost, dropped = radar.statistics.lost_scans, queue.dropped
    finally:
        server.terminate()
        server.join(10)
    count = scan.scan_id - first.scan_id + 1
    messages = -(-config.samples // 350)
    setting = f"{config.samples} samples, index {config.base_integration_index}, {messages} message(s) a scan"
    return (
        setting, f"UDP, {seconds:g} s", f"{count} ({count / wall:.0f} a second)", lost, dropped,
        f"{100 * cpu / wall:.1f}", f"{grown:+.1f} of {memory_mb():.0f}",
    )  # fmt: skip


def add_options(parser: argparse.ArgumentParser) -> None:
    """Those of `measure`."""
    parser.add_argument("--seconds", type=float, help="of the radar's clock; 60, or 5 for a look")
    parser.add_argument("--only", choices=tuple(SETTINGS))


def capture(run: Run) -> Iterator[Table]:
    """A row for each setting."""
    given = run.options
    run.seeds = "one run each"
    seconds = given.seconds or (5.0 if run.quick else 60.0)
    names = [name for name in SETTINGS if given.only in (None, name)]
    yield Table(COLUMNS, [measure(name, seconds, run) for name in names])
