"""The station over real sockets: the main road, what an attacker would try, and what goes wrong."""

from __future__ import annotations

import asyncio
import gc
import json
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Any

import pytest
from station_harness import ENDLESS, OWN, WAIT_S, Asks, Raw, alone, ended, joined, source, wait

from tagid.capture import Capture
from tagid.imaging.types import Image
from tagid.live.engine import LiveView
from tagid.operate.workplace import Workplace
from tagid.pipeline.answer import Identification
from tagid.station import server, web_scans
from tagid.station.openapi import document
from tagid.station.requests import refusal_of
from tagid.station.scans import ScanRun
from tagid.station.security import COOKIE, Guesses
from tagid.station.server import Server
from tagid.station.station import Source, Station
from tagid.storage.importers import read_any

pytestmark = pytest.mark.usefixtures("closed_clients")


def asks(station: Server, **headers: str) -> Asks:
    return Asks(station.url, headers)


def test_a_script_starts_follows_and_reads_a_scan(serve, tmp_path: Path) -> None:
    station = serve()
    client = asks(station, **OWN)
    assert client.get("/api/v1/scan").status == 404
    assert client.post("/api/v1/scan", note="gate 4").json() == {"number": 1}
    scan = ended(station)
    assert scan["phase"] == "done" and scan["final"] and scan["remark"] == ""
    assert (scan["answer"]["status"], scan["answer"]["layout"]) == ("identified", "helmet-120")
    (entry,) = client.get("/api/v1/history?layout=helmet-120").json()["items"]
    assert entry["command"] == "station" and Path(entry["file"]).exists()
    assert client.get(f"/api/v1/history/{entry['id']}/picture").content.startswith(b"\x89PNG")
    assert client.get("/api/v1/history?status=failed").json()["items"] == []
    rows = client.get("/api/v1/history.csv").text.splitlines()
    assert len(rows) == 2 and "helmet-120" in rows[1]
    # The document describes what is really answered.
    schemas = document()["components"]["schemas"]
    assert sorted(scan) == schemas["Scan"]["required"]
    assert sorted(scan["answer"]) == schemas["Answer"]["required"]
    assert sorted(client.get("/api/v1/status").json()) == schemas["Status"]["required"]
    assert sorted(entry) == schemas["History"]["properties"]["items"]["items"]["required"]
    assert client.get("/api/v1/openapi.json").json() == json.loads(json.dumps(document()))


CHUNKED = {"content-type": "application/json", "transfer-encoding": "chunked"}


@pytest.mark.parametrize(
    ("method", "path", "headers", "body", "status"),
    [
        ("GET", "/", {"host": "evil.example:80"}, None, 421),
        ("GET", "/", {"host": ""}, None, 421),
        ("GET", "/api/v1/status", {"origin": "http://evil.example"}, None, 403),
        ("GET", "/api/v1/status", {"origin": "null"}, None, 403),
        ("GET", "/api/v1/status", {"sec-fetch-site": "cross-site"}, None, 403),
        ("GET", "/api/v1/status", {"sec-fetch-site": "same-site"}, None, 403),
        ("GET", "/", {"sec-fetch-site": "cross-site"}, None, 200),
        ("POST", "/api/v1/scan", {}, b"{}", 415),
        ("POST", "/api/v1/scan", {"content-type": "application/json"}, b"{}", 403),
        ("POST", "/api/v1/scan", {"content-type": "text/plain", **OWN}, b"{}", 415),
        ("POST", "/api/v1/scan", {"content-type": "multipart/form-data; boundary=x", **OWN}, b"--x--", 415),
        ("POST", "/api/v1/scan", {"content-type": "application/json", **OWN}, b"[" * 4000, 400),
        ("POST", "/api/v1/scan", {"content-type": "application/json", **OWN}, b"[1]", 400),
        ("POST", "/api/v1/scan", {"content-type": "application/json", **OWN}, b'{"note": 1}', 400),
        ("POST", "/api/v1/scan", {"content-type": "application/json", **OWN}, b" " * 5000, 413),
        ("POST", "/api/v1/scan", {**CHUNKED, **OWN}, None, 411),  # before it arrives
        ("POST", "/api/v1/pair", {"content-type": "application/json", **OWN}, b'{"code": "1"}', 400),
        ("PUT", "/api/v1/scan", OWN, b"x", 405),
        ("DELETE", "/api/v1/history/1/picture", OWN, None, 405),
        ("OPTIONS", "/api/v1/scan", {"origin": "http://evil.example"}, None, 403),
        ("GET", "/api/v1/history/..%2f..%2f..%2fetc%2fpasswd/picture", {}, None, 404),
        ("GET", "/../../etc/passwd", {}, None, 404),
        ("GET", "/%2e%2e/station.py", {}, None, 404),
        ("GET", "/api/v1/history/-1/picture", {}, None, 404),
        ("GET", "/api/v1/history/99999999999999999999/picture", {}, None, 404),
        ("GET", "/api/v1/history?limit=100000", {}, None, 400),
        ("GET", "/api/v1/history?since=yesterday", {}, None, 400),
        ("GET", "/api/v1/history?path=/etc/passwd", {}, None, 400),
        ("GET", "/api/v1/history?file=%27%20OR%201=1%20--", {}, None, 200),
    ],
)  # fmt: skip
def test_what_another_page_or_a_stranger_sends_is_refused(
    station_alone: Server, method: str, path: str, headers: dict[str, str], body: bytes | None, status: int
) -> None:
    station = station_alone
    lines = {"host": f"127.0.0.1:{station.port}", **headers}
    if body is not None:
        lines["content-length"] = str(len(body))
    text = f"{method} {path} HTTP/1.1\r\n" + "".join(f"{k}: {v}\r\n" for k, v in lines.items()) + "\r\n"
    with socket.create_connection(("127.0.0.1", station.port), timeout=60) as wire:
        wire.sendall(text.encode() + (body or b""))
        answer = b""
        while b"\r\n\r\n" not in answer:
            part = wire.recv(65536)
            assert part, answer
            answer += part
    head = answer.partition(b"\r\n\r\n")[0].decode().lower()
    assert int(head.split()[1]) == status, head
    if status != 421 or headers["host"]:
        assert "content-security-policy: default-src 'none'" in head
        assert "access-control-allow-origin" not in head
        assert "x-content-type-options: nosniff" in head
    assert asks(station).get("/api/v1/status").json()["scan"] is None, "nothing was started"


def documented() -> list[tuple[str, str]]:
    """(method, path) of everything in the OpenAPI document."""
    paths = document()["paths"].items()
    return [
        (method, path.replace("{number}", "1").replace("{name}", "helmet-120"))
        for path, methods in paths
        for method in methods
    ]


def test_no_action_is_taken_for_another_page(station_alone: Server) -> None:
    """Every POST that is documented, as a form, a script or an image of another page could send it."""
    posts = [path for method, path in documented() if method == "post"]
    assert len(posts) >= 11
    evil = {"origin": "http://evil.example"}
    for path in posts:
        assert asks(station_alone).post(path).json()["error"]["code"] == "no_header", path
        assert asks(station_alone, **OWN, **evil).post(path).json()["error"]["code"] == "wrong_origin", path
        cross = asks(station_alone, **OWN, **{"sec-fetch-site": "cross-site"})
        assert cross.post(path).json()["error"]["code"] == "wrong_origin", path
    for method, path in documented():
        if method == "get":
            cross = asks(station_alone, **{"sec-fetch-site": "cross-site"})
            assert cross.get(path).status == 403, path
    status = asks(station_alone).get("/api/v1/status").json()
    assert (status["scan"], status["report"], status["enrolment"]["subject"]) == (None, None, None)


@pytest.fixture(scope="module")
def station_alone(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """One station for the requests that must change nothing."""
    with alone(tmp_path_factory.mktemp("alone")) as station:
        yield station


@pytest.mark.parametrize(
    "headers",
    [{"Origin": "http://evil.example"}, {"Origin": "null"}, {"Origin": ""}, {"Host": "evil.example"}],
)
def test_a_websocket_of_another_page_is_refused(station_alone: Server, headers: dict[str, str]) -> None:
    assert Raw(station_alone.port, headers).status == 403


@pytest.mark.parametrize(
    "attack",
    [
        lambda c: c.frame(b"\xff\xfe\x00", 2),
        lambda c: c.frame(b"no json"),
        lambda c: c.frame(b"[1, 2]"),
        lambda c: c.frame(b"[" * 3000),
        lambda c: c.say(type="open", path="/etc/passwd"),
        lambda c: c.say(type="scan", note={"a": 1}),
        lambda c: c.frame(b"x" * 100_000),
        lambda c: c.frame(b"{}", masked=False),
        lambda c: c.frame(b"\xc3\x28"),
        lambda c: c.socket.sendall(b"\xff" * 200),
        lambda c: c.say(type="scan", note="\ud800"),
    ],
    ids=["binary", "text", "list", "deep", "unknown", "note", "large", "unmasked", "utf-8", "noise", "half"],
)  # fmt: skip
def test_a_bad_frame_closes_its_connection_and_no_other(
    station_alone: Server, attack: Callable[[Raw], Any]
) -> None:
    good, _ = joined(station_alone.port)
    bad, _ = joined(station_alone.port)
    attack(bad)
    assert bad.closed() in (1002, 1003, 1006, 1007, 1008, 1009)
    good.until("status")
    good.close()
    bad.close()
    assert asks(station_alone).get("/api/v1/status").json()["scan"] is None


@pytest.mark.parametrize(
    ("kind", "body"),
    [(1, b'{"type": "stop"}'), (9, b"a" * 120), (10, b"")],
    ids=["messages", "pings", "pongs"],
)
def test_a_flood_ends_with_1008_and_is_not_read_on(station_alone: Server, kind: int, body: bytes) -> None:
    bad, _ = joined(station_alone.port)
    bad.socket.settimeout(20.0)
    for _ in range(server.MOST_FRAMES + 1):
        bad.frame(body, kind)
    assert bad.closed() == 1008
    with pytest.raises(OSError):  # it is not read any more, and then the connection ends
        while True:
            bad.socket.sendall(bytes(1 << 16))


def test_a_device_needs_a_token_on_every_request_and_gets_it_with_the_code(serve) -> None:
    codes: list[str] = []
    station = serve(announce=codes.append)
    client = asks(station, **OWN)
    assert client.get("/api/v1/nothing").status == 401
    for method, path in documented():
        if path != "/api/v1/pair":
            assert getattr(client, method)(path).status == 401, path
    assert Raw(station.port).status == 403
    assert Raw(station.port, {"Cookie": f"{COOKIE}=guess"}).status == 403
    # Wrong codes of a stranger do not make the code worthless that somebody types meanwhile.
    for _ in range(20):
        assert client.post("/api/v1/pair", code="AAAA-AAAA").status == 403
    assert len(codes) == 1
    paired = client.post("/api/v1/pair", code=codes[0].lower())
    cookie = paired.headers["set-cookie"].lower()
    assert "httponly" in cookie and "samesite=strict" in cookie
    token = paired.json()["token"]
    assert len(codes) == 2 and codes[0] != codes[1]
    assert client.post("/api/v1/pair", code=codes[0]).status == 403, "a code makes one token"
    fresh = asks(station, **OWN, authorization=f"Bearer {token}")
    assert fresh.get("/api/v1/status").status == 200
    assert asks(station, authorization=f"Bearer {token[:-1]}").get("/api/v1/status").status == 401
    raw, _ = joined(station.port, Cookie=f"{COOKIE}={token}")
    raw.close()


def test_all_guesses_have_one_limit_and_a_right_code_its_turn(serve, monkeypatch: pytest.MonkeyPatch) -> None:
    codes: list[str] = []
    station = serve(announce=codes.append)
    monkeypatch.setattr(web_scans, "GUESS_S", 0.1)
    client, stop, wrong = asks(station, **OWN), threading.Event(), [0] * 10
    began = time.monotonic()

    def guess(number: int) -> None:
        while not stop.is_set():
            wrong[number] += client.post("/api/v1/pair", code="BBBB-BBBB").status == 403

    threads = [threading.Thread(target=guess, args=(number,)) for number in range(10)]
    for thread in threads:
        thread.start()
    wait(lambda: sum(wrong) > 3)
    before = sum(wrong)
    assert client.post("/api/v1/pair", code=codes[0]).status == 200
    assert sum(wrong) - before <= 12, "in its turn"
    stop.set()
    for thread in threads:
        thread.join()
    assert sum(wrong) <= (time.monotonic() - began) / 0.1 + 1, "of all of them together"
    assert len(codes) == 2


def test_a_guesser_does_not_take_the_turn_of_another_address() -> None:
    async def order() -> list[str]:
        guesses, done = Guesses(), []

        async def guess(address: str) -> None:
            async with guesses.turn(address):
                done.append(address)
                await asyncio.sleep(0)

        async with asyncio.TaskGroup() as group:
            for address in (*["many"] * 50, "single"):
                group.create_task(guess(address))
        assert not guesses._queues
        return done

    assert "single" in asyncio.run(order())[:3]


def test_guessers_of_many_addresses_do_not_end_the_code_of_one_that_has_a_single_connection(
    serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nine addresses with three guessers each, and as many places as addresses."""
    monkeypatch.setattr(server, "MAX_SOCKETS", 10)
    codes: list[str] = []
    first, stop = serve(announce=codes.append), threading.Event()
    monkeypatch.setattr(web_scans, "GUESS_S", 0.1)

    def pair(address: str, code: str) -> int:
        client = HTTPConnection("127.0.0.1", first.port, timeout=WAIT_S, source_address=(address, 0))
        with closing(client), suppress(OSError, HTTPException):
            headers = OWN | {"content-type": "application/json"}
            client.request("POST", "/api/v1/pair", json.dumps({"code": code}), headers)
            return client.getresponse().status
        return 0

    def guess(address: str) -> None:
        while not stop.is_set():
            pair(address, "BBBB-BBBB")

    threads = [threading.Thread(target=guess, args=(f"127.0.1.{i % 9 + 1}",)) for i in range(27)]
    for thread in threads:
        thread.start()
    statuses = [pair(f"127.0.2.{i + 1}", codes[-1]) for i in range(3)]
    stop.set()
    for thread in threads:
        thread.join()
    assert statuses == [200] * 3


def dates() -> list[str]:
    """Histories of times that have no UTC."""
    late, early = "9999-12-31T23:59:59-23:59", "0001-01-01T00:00%2B14:00"
    paths = ("history", "history.csv", "history.json", "history/captures.zip")
    return [
        f"{path}?{side}={date}" for path in paths for side in ("since", "until") for date in (late, early)
    ]


def test_no_request_is_answered_with_500(
    serve, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    station = serve(announce=lambda code: None)
    token = station._pairing._grant()
    client = asks(station, **OWN, authorization=f"Bearer {token}")
    assert [client.get(f"/api/v1/{path}").status for path in dates()] == [400] * 16
    long = "9" * 5000
    for path in (f"history/{long}/picture", f"reports/{long}", f"reports/{'0' * 5000}1/items.csv"):
        assert client.get(f"/api/v1/{path}").status == 404
    for path in ("pair", "scan", "enrolment"):
        refused = client.post(f"/api/v1/{path}", code="\ud800", name="\udfff", note="\ud800")
        assert refused.status == 400 and "surrogate" in refused.json()["error"]["message"], path
    (tmp_path / "c.toml").write_text("[radar\n")
    for answer in (client.post("/api/v1/enrolment", name="x"), client.get("/api/v1/history/1/capture")):
        assert answer.status in (200, 404, 503)
    monkeypatch.setattr(station._station, "source", Source(lambda: Workplace()))
    broken = client.post("/api/v1/scan")
    assert (broken.status, broken.json()["error"]["code"]) == (503, "config")
    with socket.create_connection(("127.0.0.1", station.port)) as gone:
        head = f"POST /api/v1/scan/stop HTTP/1.1\r\nhost: 127.0.0.1:{station.port}\r\n"
        more = f"authorization: Bearer {token}\r\ntagid-station: 1\r\ncontent-length: 100\r\n"
        head += more + "content-type: application/json\r\n\r\n{"
        gone.sendall(head.encode())
        wait(lambda: len(station._server.server_state.tasks) == 1)
    wait(lambda: not station._server.server_state.tasks)
    assert not caplog.records


def test_a_fault_of_the_program_is_500_and_its_line_in_the_log_is_short(
    caplog: pytest.LogCaptureFixture,
) -> None:
    assert refusal_of(ValueError("x"), "/" + "9" * 5000).status == 500
    assert len(caplog.records[0].getMessage()) < 300
    assert refusal_of(RuntimeError("can't start new thread"), "/").status == 503


def test_of_two_that_press_at_once_one_scans(serve) -> None:
    station = serve(ENDLESS)
    answers: list[int] = []
    threads = [
        threading.Thread(target=lambda: answers.append(asks(station, **OWN).post("/api/v1/scan").status))
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(answers) == [202, 409, 409, 409]
    asks(station, **OWN).post("/api/v1/scan/stop")
    assert ended(station)["number"] == 1


def test_a_free_table_that_stops_half_way_is_told_with_the_part_that_it_turned(serve) -> None:
    station = serve("emulator://helmet-120?rpm=15&seed=2&stop=0.5", rpm=15)
    client, _ = joined(station.port)
    client.say(type="scan")
    client.until("frame", lambda m: not m["scan"]["running"])
    scan = asks(station).get("/api/v1/scan").json()
    assert scan["phase"] == "done" and "the turn stopped at about" in scan["remark"]
    assert scan["answer"]["status"] == "unknown" and scan["answer"]["reason_code"] == "turn_stopped"
    (cause,) = scan["answer"]["causes"]
    assert cause["code"] == "turn_stopped" and "what holds the table" in cause["remedy"]
    (row,) = asks(station).get("/api/v1/history").json()["items"]
    assert row["status"] == "unknown"
    client.close()


def test_a_client_that_never_reads_is_cut_off_and_holds_up_nobody(
    serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "PING_S", 3.0)
    station = serve(ENDLESS)
    deaf = Raw(station.port, receive_bytes=4096)
    deaf.say(type="hello")
    good, _ = joined(station.port)
    good.say(type="scan")
    good.until("frame", lambda m: m["scan"]["scans"] > 20)
    assert good.until("status", lambda m: m["connections"] == 1)["connections"] == 1, "the deaf one is gone"
    good.say(type="stop")
    good.close()
    deaf.close()


def test_a_connection_without_a_request_is_closed(serve, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "HEADER_S", 0.2)
    station = serve()
    for before in (b"", f"GET / HTTP/1.1\r\nhost: 127.0.0.1:{station.port}\r\n\r\n".encode()):
        with socket.create_connection(("127.0.0.1", station.port), timeout=60) as wire:
            wire.sendall(before)
            assert not before or wire.recv(65536).startswith(b"HTTP/1.1 200")
            wire.sendall(b"GET / HTTP/1.1\r\nho")
            with suppress(ConnectionResetError):
                while wire.recv(65536):
                    pass  # the rest of the page


def test_a_full_disk_is_told_and_the_next_scan_works(serve, tmp_path: Path) -> None:
    station = serve()
    client = asks(station, **OWN)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, hard))
    try:
        assert client.post("/api/v1/scan").status == 202
        scan = ended(station)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert scan["phase"] == "failed" and "tagid recover" in scan["note"], scan
    (journal,) = (tmp_path / "out").glob("*.journal")
    assert journal.stat().st_size > 10_000
    assert client.post("/api/v1/scan").status == 202
    assert client.post("/api/v1/scan/stop").status == 202
    assert "tagid recover" not in ended(station)["note"]


def test_the_command_serves_until_it_is_stopped(home: dict[str, str], tmp_path: Path) -> None:
    run = [sys.executable, "-m", "tagid", "station"]
    taken = subprocess.Popen(
        [*run, "--demo", "--bind", "127.0.0.1:0", "--save-dir", str(tmp_path / "out"), "--output", "json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=home,
    )  # fmt: skip
    try:
        assert taken.stdout is not None
        url = json.loads(taken.stdout.readline())["data"]["url"]
        client = Asks(url, OWN)
        assert client.get("/api/v1/status").json()["demo"]
        busy = subprocess.run(
            [*run, "--bind", url.removeprefix("http://"), "--output", "json"],
            capture_output=True, text=True, env=home, timeout=120,
        )  # fmt: skip
        assert (busy.returncode, json.loads(busy.stdout)["errors"][0]["code"]) == (4, "port_in_use")
        client.post("/api/v1/scan")
        wait(lambda: client.get("/api/v1/scan").json()["scans"] > 10)
        taken.send_signal(signal.SIGTERM)
        _, err = taken.communicate(timeout=120)
    finally:
        if taken.poll() is None:
            taken.kill()
    assert (taken.returncode, "Traceback" in err) == (0, False), err
    (capture,) = (tmp_path / "out").glob("*.tagid.h5")
    assert read_any(capture).views > 5, "the scan that was running is kept"
    assert [path.name for path in (tmp_path / "out").iterdir()] == [capture.name]


def test_a_web_server_that_ends_is_not_running(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def ends(self: Server) -> None:
        raise SystemExit(3)  # as uvicorn does

    monkeypatch.setattr(Server, "_serve", ends)
    with Server(Station(source(tmp_path), lambda config: []), "127.0.0.1", 0) as station:
        wait(lambda: station.failure)
        assert not station.running and "the web server died: SystemExit" in str(station.failure)


DIES = """
import tagid.station.live_socket
from tagid.cli.app import main

async def run(self):
    raise KeyError("x")

tagid.station.live_socket.Hub.run = run
main()
"""


def test_the_command_fails_if_a_part_of_the_station_dies(home: dict[str, str]) -> None:
    words = [sys.executable, "-c", DIES, "station", "--bind", "127.0.0.1:0", "--output", "json"]
    done = subprocess.run(words, capture_output=True, text=True, env=home, timeout=WAIT_S)
    (error,) = json.loads(done.stdout.partition("\n")[2])["errors"]
    assert done.returncode == 1 and " died: " in error["message"], done.stdout


def test_nothing_is_left_of_a_scan_when_the_next_ones_are_over(serve) -> None:
    """Like `python -m tests.benchmarks station`, shorter: objects, threads and files instead of megabytes."""
    station = serve()
    page, _ = joined(station.port)
    reader = threading.Thread(target=page.closed, daemon=True)
    reader.start()
    client = asks(station, **OWN)
    seen: list[tuple[Counter[type], set[str], int]] = []
    kinds = (ScanRun, LiveView, Capture, Identification, Image)
    # What earlier tests of this process left is held, so that it cannot go meanwhile.
    earlier = [item for item in gc.get_objects() if type(item) in kinds]
    for _ in range(3):
        assert client.post("/api/v1/scan").status == 202
        assert ended(station)["phase"] == "done"
        gc.collect()
        alive = Counter(type(item) for item in gc.get_objects() if type(item) in kinds)
        alive.subtract(map(type, earlier))
        names = {thread.name for thread in threading.enumerate()}
        work = {name for name in names if name.startswith(("station", "live"))}
        seen.append((alive, work, len(list(Path("/proc/self/fd").iterdir()))))
    _, second, last = seen
    assert second[0][ScanRun] == 1 and second[0][LiveView] == 1, second
    assert last[0] == second[0] and last[1] == {"station-interlock", "station-web"}, last
    assert abs(last[2] - second[2]) <= 2, "sockets of requests under way"
    page.close()
