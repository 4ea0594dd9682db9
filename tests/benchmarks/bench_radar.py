"""Capture at the radar's fastest and largest settings: scans lost, share of a core, growth of memory.

The emulated radar is another process; this one does what a recording does: socket or serial port, regrouping,
queue, journal on disk with its syncs. CPU is user and system time of this process, all its threads.

Run: python tests/benchmarks/bench_radar.py                     60 s of each setting over UDP
     python tests/benchmarks/bench_radar.py --short             5 s of each
     python tests/benchmarks/bench_radar.py --long              10 minutes of the fastest, memory every minute
     python tests/benchmarks/bench_radar.py --wire usb          over a pseudo-terminal
"""

from __future__ import annotations

import argparse
import os
import platform
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.emulator import ServeOptions, serve, serve_udp
from tagid.radar.emulation.wires import PtyWire
from tagid.radar.framing import Framing
from tagid.radar.settings import RadarConfig
from tagid.recording.intake import Intake
from tagid.recording.radars import open_radar
from tagid.storage.journal import JournalWriter
from tagid.storage.journal_queue import JournalQueue

SETTINGS = {
    "fastest": RadarConfig(10_000, 15_000, base_integration_index=6),
    "largest": RadarConfig(10_000, 10_000 + 492_000, base_integration_index=11),
}


class Noise:
    """Noise from a table, so that the emulator does not need the core that the capture is measured on."""

    def __init__(self) -> None:
        self._table = np.random.default_rng(0).integers(-3000, 3000, (64, 8400)).astype(np.int32)

    def scan(self, index: int, time_s: float, config: RadarConfig) -> np.ndarray:
        return self._table[index % 64, : config.samples]


def emulate(wire: str) -> None:
    """The other process: prints its URL, then is a radar in real time until terminated."""
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    core = EmulatorCore(Noise())
    if wire == "udp":
        serve_udp(core, ServeOptions(port=0), stop, lambda h, p: print(f"udp://{h}:{p}", flush=True))
    else:
        pty = PtyWire(Framing.USB)
        print(f"serial://{pty.path}", flush=True)
        serve(core, pty, ServeOptions(), stop)


def memory_mb() -> float:
    """Resident memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def measure(name: str, wire: str, seconds: float, folder: Path, minutes: bool) -> None:
    """One setting for some seconds of the radar's clock; prints a line."""
    server = subprocess.Popen(
        [sys.executable, __file__, "--emulate", wire], stdout=subprocess.PIPE, text=True
    )  # fmt: skip
    assert server.stdout is not None
    url = server.stdout.readline().strip()
    path = folder / f"{name}.tagid.journal"
    try:
        with open_radar(url, 2.0) as radar:
            config = radar.set_config(SETTINGS[name])
            header = {"range_start_m": 0.0, "range_step_m": config.range_step_m}
            with (
                JournalWriter(path, header, sync_every=1, sync_seconds=0.5) as journal,
                JournalQueue(journal) as queue,
            ):
                intake = Intake(radar, queue, resume_s=0)
                run = intake.scans()
                first = next(run)
                settled: float | None = None
                cpu, wall = cpu_s(), time.monotonic()
                minute = 60.0
                for scan in run:
                    passed = (scan.radar_time_ms - first.radar_time_ms) * 1e-3
                    if settled is None and passed > min(5.0, seconds / 2):
                        settled = memory_mb()
                    if minutes and passed >= minute:
                        print(f"  {minute / 60:.0f} min: {memory_mb():.1f} MB", flush=True)
                        minute += 60.0
                    if passed >= seconds:
                        break
                cpu, wall = cpu_s() - cpu, time.monotonic() - wall
                grown = memory_mb() - (settled or 0.0)
                run.close()  # type: ignore[attr-defined]
            lost, dropped = radar.statistics.lost_scans, queue.dropped
    finally:
        server.terminate()
        server.wait(10)
    count = scan.scan_id - first.scan_id + 1
    print(
        f"{name}, {wire}: {config.samples} samples, integration index {config.base_integration_index}, "
        f"{-(-config.samples // 350)} message(s) a scan\n"
        f"  {count} scans in {wall:.1f} s ({count / wall:.0f} a second), {lost} lost, {dropped} dropped\n"
        f"  {100 * cpu / wall:.1f} % of a core, journal of {path.stat().st_size / 1e6:.1f} MB included\n"
        f"  memory {grown:+.1f} MB since it settled ({memory_mb():.0f} MB)",
        flush=True,
    )
    path.unlink()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--short", action="store_true")
    parser.add_argument("--long", action="store_true")
    parser.add_argument("--wire", choices=("udp", "usb"), default="udp")
    parser.add_argument("--emulate", choices=("udp", "usb"))
    parser.add_argument("--only", choices=tuple(SETTINGS))
    options = parser.parse_args()
    if options.emulate:
        emulate(options.emulate)
        return
    date = datetime.now(UTC).strftime("%Y-%m-%d")
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    print(f"{date}, {machine}, numpy {np.__version__}")
    seconds = 5.0 if options.short else 600.0 if options.long else options.seconds
    with tempfile.TemporaryDirectory() as folder:
        for name in ("fastest",) if options.long else SETTINGS:
            if options.only in (None, name):
                measure(name, options.wire, seconds, Path(folder), options.long)


if __name__ == "__main__":
    main()
