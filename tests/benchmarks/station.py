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
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tests.benchmarks import fast_clock
from tests.benchmarks.provenance import ROOT
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

sys.path.insert(0, str(ROOT / "tests" / "e2e"))
from station_harness import Asks, Raw, joined, source

if TYPE_CHECKING:
    from tagid.config import Config
    from tagid.doctor import Finding
    from tagid.station.station import Station

SHOWN_S = 3600.0
"""Time between two lines while the station waits, s."""
TOLERANCE = 1.1
"""How much longer a wait of the fast clock may take."""
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


@dataclass
class Work:
    """Periodic work of the station so far.

    Attributes:
        ticks: calls of `Station.tick`.
        checks: health checks.
        statuses: status messages that the page received.
        pings: pings that the page answered.
        connections: connections that the page opened.
    """

    ticks: int = 0
    checks: int = 0
    statuses: int = 0
    pings: int = 0
    connections: int = 0

    def since(self, before: Work) -> Work:
        """The work after an earlier state."""
        return Work(*(now - then for now, then in zip(astuple(self), astuple(before), strict=True)))


@dataclass(frozen=True)
class Seen:
    """What a run has shown.

    Attributes:
        scanning: the state after every so many scans, and after the last one.
        idle: the state every hour without a scan, the first at the end of the last scan.
        work: the periodic work while it was idle.
        idle_s: duration without a scan on the clock of the process, s.
        true_idle_s: the true duration, s.
        after: the state after the scans that followed.
    """

    scanning: list[Load]
    idle: list[Load]
    work: Work
    idle_s: float
    true_idle_s: float
    after: Load


@dataclass(frozen=True)
class Plan:
    """What to run.

    Attributes:
        scans, every: number of scans, and of scans per line.
        seconds: time after which no further scan begins, s.
        idle_s: duration without a scan, s.
        after: scans that follow.
        with_page: whether a page is connected.
        speed: of the clock without a scan.
    """

    scans: int
    every: int
    seconds: float
    idle_s: float
    after: int
    with_page: bool
    speed: float


class Page(threading.Thread):
    """A page that receives every frame, answers pings, and connects again as the true page does.

    Args:
        port: of the station.
        work: counts what arrives.
    """

    def __init__(self, port: int, work: Work) -> None:
        super().__init__(name="page", daemon=True)
        self._port, self._work = port, work
        self._ended = threading.Event()

    def run(self) -> None:
        while not self._ended.is_set():
            with suppress(AssertionError, OSError):
                page, _ = joined(self._port)
                self._work.connections += 1
                self._receive(page)

    def end(self) -> None:
        """End with the connection that the station closes."""
        self._ended.set()

    def _receive(self, page: Raw) -> None:
        while (frame := page.read())[0] != 8:
            opcode, payload = frame
            if opcode == 9:
                page.frame(payload, 10)
                self._work.pings += 1
            elif opcode == 1 and payload.startswith(b'{"type":"status"'):
                self._work.statuses += 1


def slope_mb(loads: list[Load]) -> float:
    """Growth of the memory, MB per 1000 scans, by least squares."""
    return float(
        np.polyfit([load.scans for load in loads], [load.resident_mb for load in loads], 1)[0] * 1000
    )


def operate(home: Path, plan: Plan) -> Seen:
    """Scan with a station in this process, let it wait, and scan again."""
    from tagid.doctor import examine
    from tagid.operate.workplace import open_registry
    from tagid.station.server import Server
    from tagid.station.station import Station

    registry = open_registry()
    for layout in registry.layouts():
        if layout.name != "helmet-120":
            registry.remove(layout.name)
    place = home / "out"
    place.mkdir()
    work = Work()

    def check(config: Config) -> list[Finding]:
        work.checks += 1
        return examine(config)

    class CountedStation(Station):
        def tick(self) -> None:
            work.ticks += 1
            super().tick()

    station = CountedStation(source(place, RADAR, rpm=60), check)
    with Server(station, "127.0.0.1", 0) as server:
        page = Page(server.port, work)
        if plan.with_page:
            page.start()
        loads = scan_often(station, server.url, place, plan)
        work.connections = 0
        before, began = replace(work), time.monotonic()
        idle, true_s = wait_idle(plan, loads[-1].scans)
        result, seconds = work.since(before), time.monotonic() - began
        for _ in range(plan.after):
            scan_once(station, place)
        page.end()
        after = Load.now(loads[-1].scans + plan.after)
    if plan.with_page:
        page.join(30)
    return Seen(loads, idle, result, seconds, true_s, after)


def scan_once(station: Station, place: Path) -> None:
    """Scan the helmet, which must be named."""
    station.start(None)
    assert station.scan is not None
    station.scan.join(300)
    state = station.scan.view.state
    named = state.answer is not None and state.answer.status == "identified"
    assert named, state.answer or state.note
    for path in place.iterdir():
        path.unlink()


def scan_often(station: Station, url: str, place: Path, plan: Plan) -> list[Load]:
    """The state after every so many scans."""
    loads = []
    until = time.monotonic() + plan.seconds
    for number in range(1, plan.scans + 1):
        scan_once(station, place)
        assert len(Asks(url, {}).get("/api/v1/history").json()["items"]) == min(number, 50)
        late = time.monotonic() > until
        if number % plan.every == 0 or number == plan.scans or late:
            loads.append(Load.now(number))
            show(loads[-1])
        if late:
            break
    return loads


def wait_idle(plan: Plan, scans: int) -> tuple[list[Load], float]:
    """The state every hour while nobody scans, and the true duration, s."""
    idle = [Load.now(scans)]
    truly = time.monotonic
    if plan.speed != 1.0:
        clock = fast_clock.FastClock()
        truly = clock.true_s
        clock.run_at(plan.speed)
        for item in fast_clock.measure(clock):
            print(
                f"{item.kind}: {item.seconds:.2f} s on the clock in {item.true_seconds:.3f} s",
                file=sys.stderr,
            )
            assert item.true_seconds < fast_clock.CHECKED_S / plan.speed * TOLERANCE + 0.1, item
    began, until = truly(), time.monotonic() + plan.idle_s
    while (remaining := until - time.monotonic()) > 0:
        time.sleep(min(SHOWN_S, remaining))
        idle.append(Load.now(scans))
        show(idle[-1])
    true_s = truly() - began
    if plan.speed != 1.0:
        clock.run_at(1.0)
    return idle, true_s


def show(load: Load) -> None:
    """A line of progress."""
    cells = f"{load.scans:6d} {load.resident_mb:7.1f} MB {load.threads:3d} threads {load.files:3d} files"
    print(cells, file=sys.stderr, flush=True)


def add_options(parser: argparse.ArgumentParser) -> None:
    """How much is scanned, and how long it then waits."""
    parser.add_argument("--scans", type=int, help="2000, or 6 for a look")
    parser.add_argument("--every", type=int, help="scans per row; a twentieth of them")
    parser.add_argument("--minutes", type=float, default=1e9, help="after which no further scan begins")
    parser.add_argument("--idle", type=float, default=0.0, help="minutes")
    parser.add_argument("--speed", type=float, default=1.0, help="of the clock while idle")
    parser.add_argument("--after", type=int, default=0, help="scans after the idle time")
    parser.add_argument("--no-page", action="store_true")


def endurance(run: Run) -> Iterator[Table]:
    """A row for every so many scans, for every hour without one, and for the scans after it."""
    given = run.options
    scans = given.scans or (6 if run.quick else 2000)
    every = given.every or max(1, scans // 20)
    run.seeds = "the emulator's, 2"
    if given.speed != 1.0:
        fast_clock.relaunch()
    seconds, idle_s = given.minutes * 60, given.idle * 60
    seen = operate(
        run.folder, Plan(scans, every, seconds, idle_s, given.after, not given.no_page, given.speed)
    )
    columns = ("scans", "resident memory, MB", "threads", "open files")
    late = seen.scanning[len(seen.scanning) // 2 :]
    slope = f"Slope of the second half: {slope_mb(late):+.2f} MB per 1000 scans." if len(late) > 1 else ""
    yield Table(columns, [_row(load) for load in seen.scanning], below=slope)
    if len(seen.idle) > 1:
        growth = seen.idle[-1].resident_mb - seen.idle[0].resident_mb
        hours = seen.idle_s / 3600
        below = (
            f"Idle for {hours:.2f} hours, truly {seen.true_idle_s / 60:.1f} minutes: {growth:+.2f} MB, "
            f"{growth / hours * 24:+.1f} MB per day. {seen.work}."
        )
        yield Table(
            columns, [_row(load) for load in (*seen.idle, seen.after)], "Every hour.", "idle", below=below
        )


def _row(load: Load) -> tuple[object, ...]:
    return load.scans, f"{load.resident_mb:.1f}", load.threads, load.files
