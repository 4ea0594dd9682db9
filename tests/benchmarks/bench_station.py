"""Memory, threads and open files of a station over many scans of the emulator.

    python tests/benchmarks/bench_station.py [--scans 2000] [--every 50] [--minutes 90] [--idle 1440]

Each scan is a whole turn at 60 rpm, as fast as it is read, with live image, reading, picture and history. A
page is connected and receives every frame, and the history is requested after each scan. One layout is
enrolled. Captures are removed after their scan. Prints scans, resident memory (MB), threads and open files,
one line per `--every` scans, and the slope of the memory over the second half of the run. After `--minutes`
it ends with the scans so far. With `--idle` the station then waits that many minutes, with the page connected
and its health watched, and prints one line every ten minutes and the slope per day.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "e2e"))
from station_harness import Asks, Raw, healthy, joined, source

IDLE_S = 600.0
RADAR = "emulator://helmet-120?rpm=60&seed=2"


@dataclass(frozen=True)
class Load:
    """State of the process after a number of scans.

    Attributes:
        scans: number of scans.
        resident_mb: resident memory, MB.
        threads: number of threads.
        files: number of open files.
    """

    scans: int
    resident_mb: float
    threads: int
    files: int

    @classmethod
    def now(cls, scans: int) -> Load:
        """The state of this process."""
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        resident = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
        return cls(scans, resident, threading.active_count(), len(list(Path("/proc/self/fd").iterdir())))


@dataclass(frozen=True)
class Run:
    """What a run has shown.

    Attributes:
        scanning: the state after every so many scans, and after the last one.
        idle: the state every ten minutes without a scan, the first at the end of the last scan.
    """

    scanning: list[Load]
    idle: list[Load]


def slope_mb(loads: list[Load]) -> float:
    """Growth of the memory, MB per 1000 scans, by least squares."""
    return float(np.polyfit([one.scans for one in loads], [one.resident_mb for one in loads], 1)[0] * 1000)


def run(home: Path, scans: int, every: int, seconds: float, idle_minutes: float) -> Run:
    """Scan with a station in this process, then let it wait."""
    os.environ |= {"TAGID_CONFIG": f"{home}/c.toml", "TAGID_DATA": f"{home}/data"}
    from tagid.station import server as web_server
    from tagid.station.server import Server
    from tagid.station.station import Station, registry

    web_server.PING_S = 3600.0  # a process that is halted for other work answers no ping
    for layout in registry().layouts():
        if layout.name != "helmet-120":
            registry().remove(layout.name)
    place = home / "out"
    place.mkdir()
    station = Station(source(place, RADAR, rpm=60), healthy)
    loads = []
    until = time.monotonic() + seconds
    with Server(station, "127.0.0.1", 0) as server:
        page, _ = joined(server.port)
        reader = threading.Thread(target=watch, args=(page,), name="page", daemon=True)
        reader.start()
        for number in range(1, scans + 1):
            station.start(None)
            assert station.scan is not None
            station.scan.join(300)
            assert station.scan.state.final, station.scan.state.note
            assert len(Asks(server.url, {}).get("/api/v1/history").json()["items"]) == min(number, 50)
            for path in place.iterdir():
                path.unlink()
            late = time.monotonic() > until
            if number % every == 0 or number == scans or late:
                loads.append(Load.now(number))
                show(loads[-1])
            if late:
                break
        idle = [Load.now(loads[-1].scans)]
        until = time.monotonic() + idle_minutes * 60
        while (left := until - time.monotonic()) > 0:
            time.sleep(min(IDLE_S, left))
            idle.append(Load.now(loads[-1].scans))
            show(idle[-1])
        assert reader.is_alive(), "the page lost its connection"
    reader.join(30)
    return Run(loads, idle)


def watch(page: Raw) -> None:
    """Receive every frame until the station ends."""
    with suppress(AssertionError, OSError):
        page.until("the end")


def show(load: Load) -> None:
    """Print a line."""
    sys.stdout.write(
        f"{load.scans:6d} {load.resident_mb:7.1f} MB {load.threads:3d} threads {load.files:3d} files\n"
    )
    sys.stdout.flush()


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--scans", type=int, default=2000)
    words.add_argument("--every", type=int, default=50)
    words.add_argument("--minutes", type=float, default=math.inf)
    words.add_argument("--idle", type=float, default=0.0, help="minutes")
    asked = words.parse_args()
    with tempfile.TemporaryDirectory() as home:
        seen = run(Path(home), asked.scans, asked.every, asked.minutes * 60, asked.idle)
    loads = seen.scanning
    late = loads[len(loads) // 2 :]
    if len(late) > 1:
        sys.stdout.write(f"slope of the second half: {slope_mb(late):+.2f} MB per 1000 scans\n")
    if len(seen.idle) > 2:
        growth = seen.idle[-1].resident_mb - seen.idle[0].resident_mb
        per_day = growth * 1440 / asked.idle
        sys.stdout.write(f"idle for {asked.idle:g} minutes: {growth:+.2f} MB, {per_day:+.1f} MB per day\n")


if __name__ == "__main__":
    main()
