"""Memory, threads and open files of a station over many scans of the emulator, and while it waits.

Each scan is a whole turn at 60 rpm, as fast as it is read, with live image, reading, picture and history. A
page is connected and receives every frame, and the history is requested after each scan. One layout is
enrolled. Captures are removed after their scan. After `--minutes` it ends with the scans so far.

With `--idle` the station then waits that many minutes, with the page connected (or none: `--no-page`) and its
health checked as `tagid doctor` does, and afterwards scans `--after` times. Every scan must be named.
`--speed 30` lets all clocks and waits of the process run thirty times as fast while it waits (fast_clock.c),
after measuring that they do; a day then takes 48 minutes, and the periodic work of a day is done.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tests.benchmarks import fast_clock
from tests.benchmarks.measure import memory_mb
from tests.benchmarks.provenance import ROOT
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

sys.path.insert(0, str(ROOT / "tests" / "e2e"))
from station_harness import Asks, Raw, joined, source

from tagid.config import Config
from tagid.doctor import Finding, examine
from tagid.operate.workplace import open_registry
from tagid.station.server import Server
from tagid.station.station import Station

SHOWN_S = 3600.0
"""Time between two lines while the station waits, s."""
TOLERANCE = 1.1
"""How much longer a wait of the fast clock may take."""
RADAR = "emulator://helmet-120?rpm=60&seed=2"
COLUMNS = "scans | resident memory, MB | threads | open files"


class Load(NamedTuple):
    """State of the process after a number of scans: resident memory, MB, threads and open files."""

    scans: int
    resident_mb: float
    threads: int
    files: int

    @classmethod
    def now(cls, scans: int, run: Run) -> Load:
        """The state of this process, with a line of progress."""
        load = cls(scans, memory_mb(), threading.active_count(), len(list(Path("/proc/self/fd").iterdir())))
        run.say(f"{scans:6d} {load.resident_mb:7.1f} MB {load.threads:3d} threads {load.files:3d} files")
        return load

    @property
    def row(self) -> tuple[object, ...]:
        return self.scans, f"{self.resident_mb:.1f}", self.threads, self.files


class Page(threading.Thread):
    """A page that receives every frame, answers pings, and connects again as the true page does.

    Args:
        port: of the station.
        work: counts what arrives: connections, pings and status messages.
    """

    def __init__(self, port: int, work: Counter[str]) -> None:
        super().__init__(name="page", daemon=True)
        self._port, self._work = port, work
        self._ended = threading.Event()

    def run(self) -> None:
        while not self._ended.is_set():
            with suppress(AssertionError, OSError):
                page, _ = joined(self._port)
                self._work["connections"] += 1
                self._receive(page)

    def end(self) -> None:
        self._ended.set()

    def _receive(self, page: Raw) -> None:
        while (frame := page.read())[0] != 8:
            opcode, payload = frame
            if opcode == 9:
                page.frame(payload, 10)
                self._work["pings"] += 1
            elif opcode == 1 and payload.startswith(b'{"type":"status"'):
                self._work["statuses"] += 1


def operate(run: Run) -> Iterator[Table]:
    """Scan with a station in this process, let it wait, and scan again."""
    given = run.options
    registry = open_registry()
    for layout in registry.layouts():
        if layout.name != "helmet-120":
            registry.remove(layout.name)
    place = run.folder / "out"
    place.mkdir()
    work = Counter[str]()

    def check(config: Config) -> list[Finding]:
        work["checks"] += 1
        return examine(config)

    class CountedStation(Station):
        def tick(self) -> None:
            work["ticks"] += 1
            super().tick()

    station = CountedStation(source(place, RADAR, rpm=60), check)
    with Server(station, "127.0.0.1", 0) as server:
        page = Page(server.port, work)
        if not given.no_page:
            page.start()
        loads = scan_often(station, server.url, place, run)
        before, began = work.copy(), time.monotonic()
        idle, true_s = wait_idle(run, loads[-1].scans)
        hours = (time.monotonic() - began) / 3600
        since = {what: count - before[what] for what, count in work.items()}
        for _ in range(given.after):
            scan_once(station, place)
        page.end()
        after = Load.now(loads[-1].scans + given.after, run)
    if not given.no_page:
        page.join(30)
    late = np.array([load[:2] for load in loads[len(loads) // 2 :]])
    slope = ""
    if len(late) > 1:
        slope_mb = 1000 * np.polyfit(*late.T, 1)[0]
        slope = f"Slope of the second half: {slope_mb:+.2f} MB per 1000 scans."
    yield Table(COLUMNS, [load.row for load in loads], below=slope)
    if len(idle) > 1:
        growth = idle[-1].resident_mb - idle[0].resident_mb
        below = (
            f"Idle for {hours:.2f} hours, truly {true_s / 60:.1f} minutes: {growth:+.2f} MB, "
            f"{growth / hours * 24:+.1f} MB per day. {since}."
        )
        yield Table(COLUMNS, [load.row for load in (*idle, after)], "Every hour.", "idle", below=below)


def scan_once(station: Station, place: Path) -> None:
    """Scan the helmet, which must be named."""
    station.start(None)
    station.scan.join(300)
    state = station.scan.view.state
    named = state.answer is not None and state.answer.status == "identified"
    assert named, state.answer or state.note
    for path in place.iterdir():
        path.unlink()


def scan_often(station: Station, url: str, place: Path, run: Run) -> list[Load]:
    """The state after every so many scans."""
    scans = run.options.scans or (6 if run.quick else 2000)
    every = run.options.every or max(1, scans // 20)
    loads, until = [], time.monotonic() + run.options.minutes * 60
    for number in range(1, scans + 1):
        scan_once(station, place)
        assert len(Asks(url, {}).get("/api/v1/history").json()["items"]) == min(number, 50)
        late = time.monotonic() > until
        if number % every == 0 or number == scans or late:
            loads.append(Load.now(number, run))
        if late:
            break
    return loads


def wait_idle(run: Run, scans: int) -> tuple[list[Load], float]:
    """The state every hour while nobody scans, and the true duration, s."""
    idle, speed, truly = [Load.now(scans, run)], run.options.speed, time.monotonic
    if speed != 1.0:
        clock = fast_clock.FastClock()
        truly = clock.true_s
        clock.run_at(speed)
        for kind, seconds, true_s in fast_clock.measure(clock):
            run.say(f"{kind}: {seconds:.2f} s on the clock in {true_s:.3f} s")
            assert true_s < fast_clock.CHECKED_S / speed * TOLERANCE + 0.1, kind
    began, until = truly(), time.monotonic() + run.options.idle * 60
    while (remaining := until - time.monotonic()) > 0:
        time.sleep(min(SHOWN_S, remaining))
        idle.append(Load.now(scans, run))
    true_s = truly() - began
    if speed != 1.0:
        clock.run_at(1.0)
    return idle, true_s


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scans", type=int, help="2000, or 6 for a look")
    parser.add_argument("--every", type=int, help="scans per row; a twentieth of them")
    parser.add_argument("--minutes", type=float, default=1e9, help="after which no further scan begins")
    parser.add_argument("--idle", type=float, default=0.0, help="minutes")
    parser.add_argument("--speed", type=float, default=1.0, help="of the clock while idle")
    parser.add_argument("--after", type=int, default=0, help="scans after the idle time")
    parser.add_argument("--no-page", action="store_true")


def endurance(run: Run) -> Iterator[Table]:
    run.seeds = "the emulator's, 2"
    if run.options.speed != 1.0:
        fast_clock.relaunch()
    yield from operate(run)
