"""What the station's table does: only its operator moves it, and whatever ends the operator stops it."""

from __future__ import annotations

import socket
import threading
from pathlib import Path

import pytest
from station_harness import ENDLESS, OWN, WAIT_S, Asks, Raw, ended, joined, source, wait

from tagid.motion.device import MotionStoppedError
from tagid.motion.turntable import FreeTurntable
from tagid.station import operators, scans, server, wire
from tagid.station.errors import InterlockError
from tagid.station.server import Server
from tagid.station.station import Station
from tagid.storage.importers import read_any

pytestmark = pytest.mark.usefixtures("closed_clients")


class Table(FreeTurntable):
    """A table that moves on command, and tells whether it was stopped."""

    moves = True
    breaks_after: int | None = None

    def __init__(self) -> None:
        super().__init__(rpm=0.5)
        self.turning = threading.Event()
        self.stopped = threading.Event()
        self.checks = self.starts = 0

    def start(self) -> None:
        self.starts += 1
        self.stopped.clear()
        self.turning.set()

    def check(self) -> None:
        self.checks += 1
        if self.breaks_after is not None and self.checks > self.breaks_after:
            raise MotionStoppedError("the table stopped", "Switch it on.")

    def stop(self) -> None:
        self.turning.clear()
        self.stopped.set()


@pytest.fixture
def table(monkeypatch: pytest.MonkeyPatch) -> Table:
    single = Table()
    monkeypatch.setattr(scans, "open_motion", lambda url: single)
    return single


@pytest.fixture
def turning(serve, table: Table) -> tuple[Server, Raw, str]:
    """A station whose table turns; its operator, and the key of that."""
    station = serve(ENDLESS)
    operator, key = joined(station.port)
    operator.say(type="scan")
    assert table.turning.wait(WAIT_S)
    return station, operator, key


def test_only_the_operator_moves_the_table_and_losing_the_operator_stops_it(
    serve, table: Table, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(operators, "GRACE_S", 0.5)
    station = serve(ENDLESS)
    refused = Asks(station.url, OWN).post("/api/v1/scan")
    assert (refused.status, refused.json()["error"]["code"]) == (403, "not_operator")
    assert Asks(station.url, OWN).post("/api/v1/scan", key="made-up").status == 403
    assert not table.turning.is_set()
    first, key = joined(station.port)
    second, _ = joined(station.port)
    first.say(type="scan", note="")
    first.until("operator", lambda m: m["you"])
    first.until("frame", lambda m: m["scan"]["scans"] > 5)
    assert table.turning.is_set()
    second.say(type="scan")
    assert second.until("error")["error"]["code"] == "busy"
    second.say(type="take")
    assert second.until("error")["error"]["code"] == "busy"
    # A reload: the same browser is back within the grace period, and the scan goes on.
    first.close()
    first, again = joined(station.port, key)
    assert again == key
    seen = first.until("frame")["scan"]["scans"]
    first.until("frame", lambda m: m["scan"]["scans"] > seen + 20)
    assert table.turning.is_set()
    # The operator is gone for good; the one who looks on does not keep the table turning.
    first.close()
    second.until("frame", lambda m: not m["scan"]["running"])
    assert table.stopped.is_set() and not table.turning.is_set()
    scan = Asks(station.url, {}).get("/api/v1/scan").json()
    assert scan["phase"] == "failed" and "stopped after" in scan["note"]
    (capture,) = (tmp_path / "out").glob("*.tagid.h5")
    assert not read_any(capture).complete, "what was recorded is kept"
    second.say(type="take")
    second.until("operator", lambda m: m["you"])
    second.close()


def test_the_interlock_needs_neither_the_loop_nor_the_page(
    turning: tuple[Server, Raw, str], table: Table, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(operators, "GRACE_S", 0.3)
    station, operator, _ = turning
    busy, free = threading.Event(), threading.Event()
    monkeypatch.setattr(station._station, "tick", lambda: (busy.set(), free.wait(2 * WAIT_S)))
    assert busy.wait(WAIT_S)
    try:
        operator.close()  # nobody reads it: the loop is busy
        assert table.stopped.wait(WAIT_S)
    finally:
        free.set()


def test_a_client_that_vanishes_is_detected_by_the_system(serve) -> None:
    station = serve()
    joined(station.port)
    (line,) = [s for s in station._server.server_state.connections if isinstance(s, server.StationSocket)]
    wire = line.transport.get_extra_info("socket")
    assert wire.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
    assert wire.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE) == server.PING_S
    assert wire.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 2000 * server.PING_S


@pytest.mark.parametrize("part", ["page", "interlock"])
def test_a_dead_page_or_interlock_stops_the_motion_and_ends_the_station(
    turning: tuple[Server, Raw, str], table: Table, monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    station, _, key = turning
    assert station.running
    if part == "page":
        monkeypatch.setattr(wire, "frame", lambda run: {}["a fault"])
    else:
        station._station.operators.expire = None
    assert table.stopped.wait(WAIT_S)
    wait(lambda: not station._station.scan.running)
    assert not station.running
    assert ("KeyError" if part == "page" else "interlock") in str(station.failure)
    refused = Asks(station.url, OWN).post("/api/v1/scan", key=key)
    assert (refused.status, refused.json()["error"]["code"]) == (503, "interlock")


def test_without_the_interlock_nothing_moves(table: Table, tmp_path: Path) -> None:
    station = Station(source(tmp_path), lambda config: [])
    key = station.operators.join()
    with pytest.raises(InterlockError):
        station.start(key)
    assert not table.starts


def test_a_table_does_not_start_when_its_scan_was_stopped_before(serve, table: Table) -> None:
    station = serve(ENDLESS)
    first, _ = joined(station.port)
    with station._station._radar:  # a health check is talking to the radar
        first.say(type="scan")
        wait(lambda: Asks(station.url, {}).get("/api/v1/scan").status == 200)
        first.say(type="stop")
        first.until("status")
    scan = first.until("frame", lambda m: not m["scan"]["running"])["scan"]
    assert scan["phase"] == "failed" and "before the first scan" in scan["note"]
    assert table.starts == 0
    first.close()


def test_anybody_stops_a_scan_and_a_table_that_stops_half_way_is_told(
    serve, table: Table, tmp_path: Path
) -> None:
    station = serve(ENDLESS)
    first, _ = joined(station.port)
    first.say(type="scan")
    first.until("frame", lambda m: m["scan"]["scans"] > 5)
    assert Asks(station.url, OWN).post("/api/v1/scan/stop").status == 202
    assert "stopped after" in ended(station)["note"]
    table.breaks_after = table.checks + 10
    first.say(type="scan")
    scan = first.until("frame", lambda m: m["scan"]["number"] == 2 and not m["scan"]["running"])["scan"]
    assert scan["phase"] == "failed" and scan["note"].startswith("the table stopped")
    assert table.stopped.is_set()
    paths = sorted((tmp_path / "out").glob("*.tagid.h5"), key=lambda path: path.stat().st_mtime_ns)
    kept = [read_any(path) for path in paths]
    assert len(kept) == 2 and not any(capture.complete for capture in kept)
    assert kept[1].views >= 10, "what was recorded is kept"
    table.breaks_after = None
    first.say(type="scan")
    first.until("frame", lambda m: m["scan"]["number"] == 3 and m["scan"]["scans"] > 3)
    first.say(type="stop")
    first.close()
