"""Recording at the pace of a P440: the radar's limits, the monitor, and long journals.

The emulated radar is another process and is not counted; the recording process does what a recording does:
socket, regrouping, queue, journal on disk with its syncs. CPU is user and system time of the process, all its
threads. The monitor runs as a user runs it, on a pseudo terminal. A long journal of scans of 1152 samples of
noise is turned into files by a process of its own a size; files are split at 128 MiB of samples instead of
1 GiB, so that the split is part of it.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import multiprocessing
import os
import pty
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import termios
import threading
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.emulator import ServeOptions, serve_udp
from tagid.radar.settings import RadarConfig
from tagid.recording.intake import Intake
from tagid.recording.radars import open_radar
from tagid.storage.journal import JournalWriter
from tagid.storage.journal_queue import JournalQueue
from tests.benchmarks.measure import memory_mb, started
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
                scans.close()
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


def capture_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=float, help="of the radar's clock; 60, or 5 for a look")
    parser.add_argument("--only", choices=tuple(SETTINGS))


def capture(run: Run) -> Iterator[Table]:
    given = run.options
    run.seeds = "one run each"
    seconds = given.seconds or (5.0 if run.quick else 60.0)
    names = [name for name in SETTINGS if given.only in (None, name)]
    yield Table(COLUMNS, [measure(name, seconds, run) for name in names])


MONITORED = (("480 samples, index 11", "11", "4.4"), ("96 samples, index 6", "6", "0.8"))
TERMINALS = ((80, 24, True), (80, 24, False), (200, 50, True))
TAGID = [sys.executable, "-m", "tagid"]


def watch(url: str, seconds: float, terminal: tuple[int, int, bool]) -> tuple[dict, int]:
    """(result of the monitor, bytes sent to the terminal)."""
    columns, lines, colour = terminal
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
    environment = {**os.environ, "TERM": "xterm-256color", "COLORTERM": "truecolor", "PYTHONUTF8": "1"}
    environment |= {} if colour else {"NO_COLOR": "1"}
    words = ["radar", "monitor", "--radar", url, "--seconds", str(seconds), "--output", "json"]
    child = subprocess.Popen(
        [*TAGID, *words], stdin=slave, stdout=subprocess.PIPE, stderr=slave, env=environment
    )
    os.close(slave)
    sent = 0

    def read() -> None:
        nonlocal sent
        try:
            while data := os.read(master, 1 << 16):
                sent += len(data)
        except OSError:  # the other end is closed
            return

    reader = threading.Thread(target=read)
    reader.start()
    out, _ = child.communicate()
    reader.join()
    os.close(master)
    return json.loads(out)["data"], sent


def monitor(run: Run) -> Iterator[Table]:
    run.seeds = "one run"
    rows = []
    with started(["emulate", "p440", "--bind", "127.0.0.1:0"]) as emulator:
        url = emulator["url"]
        for name, integration, stop in MONITORED:
            words = ["--radar", url, "--start", "0", "--stop", stop, "--pii", integration, "-q"]
            subprocess.run([*TAGID, "radar", "config", *words], check=True, stdout=subprocess.DEVNULL)
            for terminal in TERMINALS:
                data, sent = watch(url, 3.0 if run.quick else 10.0, terminal)
                rates = (f"{data['frames_per_second']:.1f}", f"{sent / data['seconds'] / 1e3:.0f}")
                size = f"{terminal[0]} x {terminal[1]}"
                kind = "colour" if terminal[2] else "characters"
                rows.append((name, size, kind, *rates, f"{data['scan_rate_hz']:.1f}", data["lost"]))
    yield Table("setting | terminal | drawn in | frames/s | kB/s | scans/s | lost", rows)


SIZES = (1_000, 5_000, 60_000)
BINS = 1152


def convert(scans: int) -> tuple[object, ...]:
    """Write a journal, turn it into captures; what that took."""
    # HDF5 counts in the memory of this process alone.
    from tagid.storage.journal_capture import write_captures

    noise = np.random.default_rng(0).normal(0, 120, (64, BINS)).astype(np.int32)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.tagid.journal"
        with JournalWriter(path, {"range_start_m": 0.0, "range_step_m": 0.009}, sync_every=0) as journal:
            for number in range(scans):
                journal.append(number, number, float(number), noise[number % len(noise)])
            journal.close({})
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
        began = time.process_time()
        written = write_captures(path, lambda part: Path(folder) / f"{part}.tagid.h5", part_bytes=128 << 20)
        spent = time.process_time() - began
        after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
        return scans, path.stat().st_size >> 20, len(written.paths), before, after, f"{spent:.1f}"


def sizes(run: Run) -> Iterator[Table]:
    run.seeds = "one run"
    columns = (
        "scans of 1152 samples | journal (MB) | files of 128 MiB | memory before (MB) | at most (MB) | "
        "CPU (s)"
    )
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        rows = list(pool.imap(convert, SIZES[:2] if run.quick else SIZES, chunksize=1))
    yield Table(columns, rows)
