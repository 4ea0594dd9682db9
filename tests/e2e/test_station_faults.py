"""The station while things go wrong: the radar's cable, the clock, too many connections."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
from contextlib import suppress
from http.client import HTTPConnection
from pathlib import Path

import pytest
from station_harness import OWN, WAIT_S, Asks, Raw, ended, joined, wait

from tagid.doctor import examine
from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.emulator import ServeOptions
from tagid.radar.settings import RadarConfig
from tagid.simulate.spec import SceneSpec, turning_scene
from tagid.station import server
from tagid.station.station import MAX_CONNECTIONS
from tagid.station.wiring import wiring
from tagid.storage.importers import read_any
from tests.emulators import SerialEmulator, UdpEmulator

ROOT = Path(__file__).resolve().parents[2]


def core(rpm: float) -> EmulatorCore:
    return EmulatorCore(turning_scene(SceneSpec("helmet-120", rpm=rpm, seed=2)), RadarConfig())


def test_a_radar_that_is_gone_is_told_with_its_wiring(serve, tmp_path: Path) -> None:
    with UdpEmulator(core(8), ServeOptions(port=0)) as radar:
        station = serve(radar.url, check=examine, rpm=8, resume_s=0.0)
        page, _ = joined(station.port)
        first = page.until("status", lambda m: m["health"]["checked"])["health"]
        assert first["wiring"] is None
        page.say(type="scan")
        page.until("frame", lambda m: m["scan"]["scans"] > 10)
    assert page.until("status", lambda m: m["scan"]["silent_s"] > 1)["scan"]["running"]
    scan = page.until("frame", lambda m: not m["scan"]["running"])["scan"]
    assert scan["phase"] == "failed" and "scans that arrived are in" in scan["note"], scan["note"]
    (capture,) = (tmp_path / "out").glob("*.tagid.h5")
    assert read_any(capture).views > 10 and not read_any(capture).complete
    help_ = page.until("status", lambda m: m["health"]["wiring"])["health"]
    assert help_["wiring"]["cable"] == "ethernet" and "127.0.0.1" in " ".join(help_["wiring"]["steps"])
    assert any(finding["topic"] == "radar" and finding["level"] == "problem" for finding in help_["findings"])
    page.close()


def test_a_cable_that_is_replugged_during_the_scan_costs_only_a_gap(serve, tmp_path: Path) -> None:
    with SerialEmulator(core(6), ServeOptions(), link=tmp_path / "port") as radar:
        station = serve(radar.url, rpm=6)
        page, _ = joined(station.port)
        page.say(type="scan")
        page.until("frame", lambda m: m["scan"]["scans"] > 20)
        radar.unplug()
        page.until("status", lambda m: m["scan"]["silent_s"] > 0.5)
        radar.plug()
        scan = page.until("frame", lambda m: m["scan"]["note"])["scan"]
        assert scan["note"].startswith("the radar was disco")
        page.say(type="stop")
        assert "stopped after" in ended(station)["note"]
        page.close()
    (path,) = (tmp_path / "out").glob("*.tagid.h5")
    assert read_any(path).radar.gap_count == 1 and read_any(path).views > 20


@pytest.mark.parametrize(
    ("url", "cable", "words"),
    [
        (None, "none", "tagid radar find"),
        ("udp://192.168.1.100", "ethernet", "192.168.1.100"),
        ("udp://192.168.1.100:21333", "ethernet", "UDP from port 21333"),
        ("serial:///dev/ttyACM0", "usb", "/dev/ttyACM0"),
        ("serial:///dev/ttyUSB0?framing=uart&baud=115200", "uart", "baud"),
        ("emulator://helmet-120", "none", "not a device"),
        ("nonsense", "none", "is not a URL"),
    ],
)
def test_the_wiring_help_fits_the_cable(url: str | None, cable: str, words: str) -> None:
    result = wiring(url)
    assert result.cable == cable and words in " ".join(result.steps)


CLOCK = """
import os, sys, time
real_s, real_local, shift = time.time, time.localtime, 0.0
time.time = lambda: real_s() + shift
time.time_ns = lambda: int((real_s() + shift) * 1e9)
time.localtime = lambda s=None: real_local(time.time() if s is None else s)

sys.path[:0] = ["tests", "tests/e2e"]
from pathlib import Path
import station_harness as h
from remembered import remember
from tagid.storage.importers import read_any

def main(place):
    global shift
    codes = []
    station = h.Station(h.source(place, "emulator://helmet-120?rpm=45&seed=2&rate=0.5"), h.healthy)
    with h.Server(station, "127.0.0.1", 0, codes.append) as one:
        own = {"tagid-station": "1"}
        token = h.Asks(one.url, own).post("/api/v1/pair", code=codes[-1]).json()["token"]
        ask = h.Asks(one.url, {**own, "authorization": "Bearer " + token})
        began = time.time()
        for jump in (3600.0, -7200.0):
            shift += began - time.time()  # the same second of the day: the same name for the file
            ask.post("/api/v1/scan")
            h.wait(lambda: ask.get("/api/v1/scan").json()["scans"] > 5)
            shift += jump
            assert ask.get("/api/v1/scan").json()["silent_s"] < 60
            scan = h.wait(lambda: (s := ask.get("/api/v1/scan").json()) and not s["running"] and s)
            assert (scan["phase"], scan["answer"]["layout"]) == ("done", "helmet-120"), scan
            assert 0 < scan["seconds"] < 60 and scan["remark"] == "", scan
        rows = ask.get("/api/v1/history").json()["items"]
        captures = sorted(place.glob("*.tagid.h5"))
        assert len(rows) == 2 and sorted(row["file"] for row in rows) == [str(path) for path in captures]
        assert rows[0]["id"] > rows[1]["id"]
        assert all(read_any(path).complete for path in captures)
        assert all(ask.get(f"/api/v1/history/{row['id']}/picture").status == 200 for row in rows)

remember(Path(sys.argv[2]))
main(Path(sys.argv[1]))
"""


def test_a_clock_that_jumps_loses_nothing(tmp_path: Path, remembered: Path) -> None:
    (tmp_path / "out").mkdir()
    environment = {"TAGID_DATA": str(tmp_path / "data"), "TAGID_CONFIG": str(tmp_path / "c.toml")}
    done = subprocess.run(
        [sys.executable, "-c", CLOCK, str(tmp_path / "out"), str(remembered)],
        capture_output=True, text=True, cwd=ROOT,
        env={**os.environ, **environment, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_of_many_connections_a_bounded_number_is_served(serve) -> None:
    station = serve()
    threads = threading.active_count()
    many = [Raw(station.port) for _ in range(MAX_CONNECTIONS + 10)]
    served = [client for client in many if client.status == 101]
    refused = [client for client in many if client.status != 101]
    assert len(served) == MAX_CONNECTIONS and {client.status for client in refused} == {503}
    error = refused[0].body()
    assert "too_many_connections" in error and "Close one of them" in error
    for client in served:
        client.say(type="hello")
        client.until("hello")
    ask = Asks(station.url, OWN)
    status = ask.get("/api/v1/status").json()
    assert status["connections"] == MAX_CONNECTIONS and status["full"], "the page says that it is full"
    assert ask.post("/api/v1/scan").status == 202, "a gate goes on working"
    served[0].until("frame", lambda m: m["scan"]["phase"] == "done" and not m["scan"]["running"])
    for client in many:
        client.close()
    wait(lambda: not ask.get("/api/v1/status").json()["connections"])
    assert threading.active_count() <= threads + 2, "workers of the web server, not one per connection"
    last, _ = joined(station.port)
    assert not last.until("status")["full"]
    last.close()


def test_a_station_that_is_closed_checks_nothing_more(serve) -> None:
    """The web server still ticks for a moment, and nobody would wait for the thread."""
    checks: list[object] = []
    single = serve(check=lambda config: checks.append(config) or [])
    station = single._station
    page, _ = joined(single.port)
    wait(lambda: station.health.checked_at)
    station.close()
    before = len(checks)
    station._health_due = 0.0
    station.tick()
    assert len(checks) == before and not any(t.name == "station-health" for t in threading.enumerate())
    page.close()


def test_a_health_check_that_cannot_start_is_shown_and_tried_again(
    serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    station = serve()
    page, _ = joined(station.port)
    page.until("status", lambda m: m["health"]["checked"])

    def no_thread(self: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", no_thread)
        station._station._health_due = 0.0
        message = page.until("status", lambda m: m["health"]["findings"][0]["topic"] == "health check")
    assert "no memory or thread left" in message["health"]["findings"][0]["text"]
    assert station.running and station._station._interlock.alive
    station._station._health_due = 0.0
    page.until("status", lambda m: m["health"]["findings"][0]["topic"] == "radar")
    page.close()


@pytest.mark.parametrize(("limit", "answer"), [("250", 200), ("100", None)])
def test_the_limit_of_open_files_counts(tmp_path: Path, limit: str, answer: int | None) -> None:
    words = ("station", "--demo", "--bind", "127.0.0.1:0", "--save-dir", str(tmp_path), "--output", "json")
    command = ["bash", "-c", f'ulimit -n {limit}; exec "$@"', "x", sys.executable, "-m", "tagid", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT) as station:
        if answer is None:
            output, _ = station.communicate(timeout=WAIT_S)
            assert station.returncode == 2 and b"ulimit -n 1024" in output
            return
        url = json.loads(station.stdout.readline())["data"]["url"]
        port = url.rpartition(":")[2]
        sent = SENT["half a body"].replace(b"PORT", port.encode())
        silent = [socket.create_connection(("127.0.0.1", int(port)), WAIT_S) for _ in range(300)]
        for client in silent:
            with suppress(OSError):
                client.sendall(sent)
        assert Asks(url, OWN).get("/api/v1/status").status == answer
        for client in silent:
            client.close()
        station.terminate()
        assert station.communicate(timeout=WAIT_S)[1] == b""


BODY = b"POST /api/v1/pair HTTP/1.1\r\nhost: 127.0.0.1:PORT\r\ncontent-type: application/json\r\n"
SENT = {
    "nothing": b"",
    "half a request": b"GET / HTTP/1.1\r\nHost: ",
    "half a body": BODY + b"tagid-station: 1\r\ncontent-length: 100\r\n\r\n{",
    "requests without reading": b"GET /api/v1/openapi.json HTTP/1.1\r\nhost: 127.0.0.1:PORT\r\n\r\n" * 40,
}


@pytest.mark.parametrize("sent", SENT.values(), ids=SENT.keys())
def test_connections_that_ask_for_nothing_keep_nobody_out(
    serve, sent: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More than there are places; each request is answered at once, not after they have expired."""
    monkeypatch.setattr(server, "KEPT_S", 600.0)  # longer than they may take to open
    monkeypatch.setattr(server, "MAX_SOCKETS", 40)
    station = serve()
    sent = sent.replace(b"PORT", str(station.port).encode())
    page, _ = joined(station.port)
    kept = HTTPConnection("127.0.0.1", station.port, timeout=WAIT_S)
    kept.request("GET", "/api/v1/status", headers=OWN)
    assert kept.getresponse().read()
    silent = [socket.socket() for _ in range(50)]
    for client in silent:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        client.connect(("127.0.0.1", station.port))
        with suppress(OSError):
            client.sendall(sent)
    ask = Asks(station.url, OWN)
    assert [ask.get(path).status for path in ("/", "/api/v1/status", "/api/v1/history")] == [200] * 3
    late, _ = joined(station.port)
    assert late.until("status", lambda m: m["connections"] == 2)["connections"] == 2
    assert page.until("status", lambda m: m["connections"] == 2), "a page that is connected stays so"
    kept.request("GET", "/api/v1/status", headers=OWN)
    assert kept.getresponse().status == 200, "a connection with requests goes after those without any"
    for client in (*silent, kept, page, late):
        client.close()


def test_pages_count_among_the_connections(serve, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "HEADER_S", 600.0)  # none is closed for its age
    monkeypatch.setattr(server, "MAX_SOCKETS", 4)
    station = serve()
    pages = [joined(station.port)[0] for _ in range(3)]
    silent = [socket.create_connection(("127.0.0.1", station.port), WAIT_S) for _ in range(3)]
    for client in silent[:2]:
        with suppress(ConnectionResetError):
            assert client.recv(1) == b"", "its place was needed"
    for client in (*silent, *pages):
        client.close()


def test_connections_of_paired_clients_are_the_last_to_go(serve, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "KEPT_S", 0.0)
    monkeypatch.setattr(server, "MAX_SOCKETS", 4)
    station = serve(announce=lambda code: None)
    kept = HTTPConnection("127.0.0.1", station.port, timeout=WAIT_S)
    headers = OWN | {"authorization": f"Bearer {station._pairing._grant()}"}
    for _ in range(3):
        kept.request("GET", "/api/v1/status", headers=headers)
        answer = kept.getresponse()
        assert answer.read() and answer.status == 200, "the same connection"
        for _ in range(8):
            socket.create_connection(("127.0.0.1", station.port), WAIT_S).close()
    kept.close()
