"""Attacks on the station: its interlock, its places, its pairing, and the numbers in its requests."""

from __future__ import annotations

import http.client
import json
import logging
import os
import shutil
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.attacks import Outcome, attack

ROOT = Path(__file__).resolve().parents[2]
TAGID = [sys.executable, "-m", "tagid"]
OWN = {"tagid-station": "1", "content-type": "application/json"}
STILL_S = 6.0
"""Longest motion after the operator is lost: 5 s and a little."""

NO_THREAD = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <pthread.h>
#include <stdlib.h>
#include <unistd.h>
/* pthread_create fails with EAGAIN while the file $NOTHREAD exists, as with pids.max or RLIMIT_NPROC. */
int pthread_create(pthread_t *t, const pthread_attr_t *a, void *(*f)(void *), void *x) {
  static int (*real)(pthread_t *, const pthread_attr_t *, void *(*)(void *), void *);
  if (!real) real = dlsym(RTLD_NEXT, "pthread_create");
  const char *flag = getenv("NOTHREAD");
  if (flag && access(flag, F_OK) == 0) return EAGAIN;
  return real(t, a, f, x);
}
"""

FLOOD = r"""
import json, socket, sys
port = int(sys.argv[1])
ask = (f"GET /api/v1/live HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
       f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {'A' * 22}==\r\ntagid-station: 1\r\n\r\n").encode()
hello = b'{"type": "hello"}'
frame = lambda kind, body: bytes([0x80 | kind, 0x80 | len(body)]) + bytes(4) + body
flood = (frame(9, b"a" * 120) * 9 + frame(1, b'{"type": "release"}')) * 10
while True:
    try:
        with socket.create_connection(("127.0.0.1", port), 5) as line:
            line.sendall(ask + frame(1, hello))
            while True:
                line.sendall(flood)
    except OSError:
        pass
"""
"""Sends pings and messages as fast as it can, and connects again when it is disconnected."""


def _environment(**more: str) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **more}


@contextmanager
def _command(*words: str, **more: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [*TAGID, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=_environment(**more)
    )
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.communicate(timeout=60)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


def _first_line(process: subprocess.Popen[str]) -> dict[str, Any]:
    assert process.stdout is not None
    result: dict[str, Any] = json.loads(process.stdout.readline())["data"]
    return result


@dataclass(frozen=True)
class Table:
    """A station with an emulated table that moves on command.

    Attributes:
        port: of the station.
        truth: address that tells the table's state.
    """

    port: int
    truth: tuple[str, int]

    @property
    def moving(self) -> bool:
        """Whether the table turns."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
            line.settimeout(5)
            line.sendto(json.dumps({"at": time.monotonic()}).encode(), self.truth)
            return bool(json.loads(line.recv(512))["moving"])

    def still_after(self, limit_s: float = 30.0) -> float:
        """Seconds until it is still; the limit if it is not."""
        began = time.monotonic()
        while self.moving and time.monotonic() - began < limit_s:
            time.sleep(0.05)
        return time.monotonic() - began


@contextmanager
def _table(folder: Path, **more: str) -> Iterator[Table]:
    with _command("emulate", "comxim", "--output", "json") as emulator:
        result = _first_line(emulator)
        host, _, port = result["truth"].rpartition(":")
        words = (
            "--radar",
            f"emulator://helmet-120?rate=1&turned_by={result['truth']}",
            "--motion",
            result["url"],
        )
        place = ("--axis-distance", "1.0", "--save-dir", str(folder / "out"), "--bind", "127.0.0.1:0")
        with _command("station", *words, *place, "--output", "json", **more) as station:
            url = _first_line(station)["url"]
            yield Table(int(url.rpartition(":")[2]), (host, int(port)))


class Operator:
    """A WebSocket connection that can vanish."""

    def __init__(self, port: int) -> None:
        self.line = socket.create_connection(("127.0.0.1", port), 60)
        words = {
            "Host": f"127.0.0.1:{port}",
            "Upgrade": "websocket",
            "Connection": "Upgrade",
            "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": f"{'A' * 22}==",
            "tagid-station": "1",
        }
        lines = "".join(f"{name}: {value}\r\n" for name, value in words.items())
        self.line.sendall(f"GET /api/v1/live HTTP/1.1\r\n{lines}\r\n".encode())
        self._buffer = b""
        while b"\r\n\r\n" not in self._buffer:
            self._buffer += self._received()
        self._buffer = self._buffer.partition(b"\r\n\r\n")[2]
        self.say(type="hello")

    def _received(self) -> bytes:
        part = self.line.recv(65536)
        if not part:
            raise ConnectionError("the station closed the connection")
        return part

    def frame(self, kind: int, body: bytes) -> None:
        """Send a frame of at most 125 bytes."""
        self.line.sendall(bytes([0x80 | kind, 0x80 | len(body)]) + bytes(4) + body)

    def say(self, **message: Any) -> None:
        """Send a message."""
        self.frame(1, json.dumps(message).encode())

    def _take(self, count: int) -> bytes:
        while len(self._buffer) < count:
            self._buffer += self._received()
        taken, self._buffer = self._buffer[:count], self._buffer[count:]
        return taken

    def read(self) -> tuple[int, bytes]:
        """(opcode, payload) of the next frame; pings are answered."""
        head, size = self._take(2)
        if size in (126, 127):
            size = int.from_bytes(self._take(2 if size == 126 else 8), "big")
        kind, body = head & 15, self._take(size)
        if kind == 9:
            self.frame(10, body)
        return kind, body

    def until(self, kind: str, test: Any = bool) -> dict[str, Any]:
        """The next message of a type that passes a test."""
        while True:
            opcode, body = self.read()
            if opcode == 8:
                raise ConnectionError("closed")
            if opcode == 1 and (message := json.loads(body))["type"] == kind and test(message):
                return dict(message)

    def abort(self) -> None:
        """End without a word, with a reset."""
        self.line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.line.close()


def _get(port: int, path: str, timeout_s: float = 5.0) -> int:
    line = http.client.HTTPConnection("127.0.0.1", port, timeout=timeout_s)
    try:
        line.request("GET", path)
        return line.getresponse().status
    finally:
        line.close()


def _post(port: int, path: str, body: bytes = b"{}", timeout_s: float = 60.0) -> int:
    line = http.client.HTTPConnection("127.0.0.1", port, timeout=timeout_s)
    try:
        line.request("POST", path, body, OWN)
        return line.getresponse().status
    finally:
        line.close()


@attack(
    "F1a",
    "one thread start fails in a health check: the interlock and the page go on",
    before="no tick in 8 s, operated for ever, close raises RuntimeError",
    test="tests/e2e/test_station_faults.py::test_a_health_check_that_cannot_start_is_shown_and_tried_again",
)
def no_thread_for_a_health_check(folder: Path) -> Outcome:
    from tagid.operate.workplace import Workplace
    from tagid.station.server import Server
    from tagid.station.station import Source, Station

    station = Station(Source(lambda: Workplace({})), lambda config: [])
    ticks: list[int] = []
    tick = station.tick
    station.tick = lambda: (ticks.append(0), tick())[1]  # type: ignore[method-assign, assignment]
    with Server(station, "127.0.0.1", 0) as server:
        key = station.operators.join()
        time.sleep(2)
        start, failed = threading.Thread.start, []

        def no_thread(self: threading.Thread) -> None:
            failed.append(self.name)
            raise RuntimeError("can't start new thread")

        threading.Thread.start = no_thread  # type: ignore[method-assign]
        station._health_due = 0.0
        while not failed:
            time.sleep(0.05)
        threading.Thread.start = start  # type: ignore[method-assign]
        before = len(ticks)
        station.operators.take(key)
        station.operators.leave(key)
        time.sleep(8)
        seen, taken, running = len(ticks) - before, station.operators.taken, server.running
    return Outcome(
        f"{seen} ticks in 8 s, operated {taken}, running {running}", seen > 20 and not taken and running
    )


@attack(
    "F1b",
    "no thread can start for 30 s; then a scan, and the operator is gone",
    before="table still after: never (30 s)",
    test="tests/e2e/test_station.py::test_a_dead_page_stops_the_motion_and_ends_the_station",
)
def no_threads_then_no_operator(folder: Path) -> Outcome:
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        return Outcome("no C compiler", False)
    (folder / "nothread.c").write_text(NO_THREAD)
    library, flag = folder / "nothread.so", folder / "flag"
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-o", library, folder / "nothread.c", "-ldl"], check=True, cwd=folder
    )
    with _table(folder, LD_PRELOAD=str(library), NOTHREAD=str(flag)) as table:
        operator = Operator(table.port)
        operator.until("status")
        flag.touch()
        end = time.monotonic() + 30
        while time.monotonic() < end:
            operator.until("status")
        flag.unlink()
        operator.say(type="scan")
        operator.until("frame", lambda message: message["scan"]["scans"] > 5)
        turned = table.moving
        operator.abort()
        seconds = table.still_after()
    return Outcome(f"turned {turned}, table still after {seconds:.1f} s", turned and seconds < STILL_S)


@attack(
    "F1c",
    "the operator is gone while 0, 4, 16, 32 connections send pings and messages",
    before="table still after 5.1, 7.2, 13.3 s (0, 4, 16)",
    test="tests/e2e/test_station.py::test_the_interlock_needs_neither_the_loop_nor_the_page",
)
def flooded(folder: Path) -> Outcome:
    figures = []
    with _table(folder) as table:
        for count in (0, 4, 16, 32):
            operator = Operator(table.port)
            operator.say(type="scan")
            operator.until(
                "frame", lambda message: message["scan"]["running"] and message["scan"]["scans"] > 5
            )
            assert table.moving
            words = [sys.executable, "-S", "-c", FLOOD, str(table.port)]
            floods = [subprocess.Popen(words) for _ in range(count)]
            try:
                end = time.monotonic() + 2
                while time.monotonic() < end:
                    operator.read()
                stopped = not table.moving  # its guardian: this program did not get the processor
                operator.abort()
                figures.append((table.still_after(), " stopped by the guardian before" if stopped else ""))
            finally:
                for flood in floods:
                    flood.kill()
                for flood in floods:
                    flood.wait()
            operator = Operator(table.port)
            operator.until("status", lambda message: not message["scan"]["running"])
            operator.say(type="take")
            operator.until("operator", lambda message: message["you"])
            operator.say(type="release")
            operator.until("operator", lambda message: not message["you"])
            operator.abort()
    text = ", ".join(f"{seconds:.1f}{remark}" for seconds, remark in figures)
    return Outcome(f"table still after {text} s (0, 4, 16, 32)", max(figures)[0] < STILL_S)


@contextmanager
def _demo(folder: Path) -> Iterator[int]:
    """The port of a demonstration."""
    words = ("station", "--demo", "--bind", "127.0.0.1:0", "--save-dir", str(folder / "s"))
    with _command(*words, "--output", "json") as station:
        yield int(_first_line(station)["url"].rpartition(":")[2])


def _slow_clients(folder: Path, kind: str) -> Outcome:
    """Three hundred slow clients for 20 s; an ordinary request twice a second."""
    words = (
        "station",
        "--demo",
        "--bind",
        "127.0.0.1:0",
        "--save-dir",
        str(folder / "s"),
        "--output",
        "json",
    )
    with _command(*words) as station:
        port = int(_first_line(station)["url"].rpartition(":")[2])
        head = f"Host: 127.0.0.1:{port}\r\n"
        opening = {
            "body": f"POST /api/v1/pair HTTP/1.1\r\n{head}Content-Type: application/json\r\n"
            "tagid-station: 1\r\nContent-Length: 100\r\n\r\n{",
            "unread": f"GET /api/v1/openapi.json HTTP/1.1\r\n{head}\r\n" * 40,
        }[kind].encode()
        lines: list[socket.socket] = []
        good = bad = 0
        due = time.monotonic() + 1
        while good + bad < 40:
            for line in list(lines):
                line.setblocking(False)
                try:
                    gone = line.recv(1) == b""
                except BlockingIOError:
                    gone = False
                except OSError:
                    gone = True
                if gone:
                    line.close()
                    lines.remove(line)
            while len(lines) < 300:
                line = socket.socket()
                line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
                line.settimeout(1)
                lines.append(line)
                try:
                    line.connect(("127.0.0.1", port))
                    line.sendall(opening)
                except OSError:
                    line.close()
                    lines.pop()
                    break
            if time.monotonic() > due:
                due = time.monotonic() + 0.5
                try:
                    good += _get(port, "/api/v1/status") == 200
                except (OSError, http.client.HTTPException):
                    bad += 1
            time.sleep(0.05)
        for line in lines:
            line.close()
    return Outcome(f"answered {good} of 40", good == 40)


@attack(
    "F8a",
    "300 clients with unfinished bodies; ordinary requests beside them",
    before="answered 1 of 34",
    test="tests/e2e/test_station_faults.py::test_connections_that_ask_for_nothing_keep_nobody_out",
)
def unfinished_bodies(folder: Path) -> Outcome:
    return _slow_clients(folder, "body")


@attack(
    "F8b",
    "300 clients that do not read their answers; ordinary requests beside them",
    before="answered 25 of 30",
    test="tests/e2e/test_station_faults.py::test_connections_that_ask_for_nothing_keep_nobody_out",
)
def unread_answers(folder: Path) -> Outcome:
    return _slow_clients(folder, "unread")


@attack(
    "F9",
    "2 and 10 guessers while a person takes 4 s to type the newest code",
    before="paired 0 of 6 and 0 of 6; 13 and 60 codes printed",
    test="tests/e2e/test_station.py::test_all_guesses_have_one_limit_and_a_right_code_its_turn",
)
def guessers(folder: Path) -> Outcome:
    from tagid.operate.workplace import Workplace
    from tagid.station.server import Server
    from tagid.station.station import Source, Station

    codes: list[str] = []
    station = Station(Source(lambda: Workplace({})), lambda config: [])
    figures, held = [], True
    with Server(station, "127.0.0.1", 0, codes.append) as server:
        stop = threading.Event()

        def pair(code: str) -> int:
            return _post(server.port, "/api/v1/pair", json.dumps({"code": code}).encode())

        def guess() -> None:
            while not stop.is_set():
                pair("BBBB-BBBB")

        for count in (2, 10):
            stop.clear()
            threads = [threading.Thread(target=guess) for _ in range(count)]
            for thread in threads:
                thread.start()
            paired, before = 0, len(codes)
            for _ in range(6):
                code = codes[-1]
                time.sleep(4)
                paired += pair(code) == 200
            stop.set()
            for thread in threads:
                thread.join()
            printed = len(codes) - before
            figures.append(f"{count} guessers: paired {paired} of 6, {printed} codes printed")
            held = held and paired == 6 and printed <= 8
    return Outcome("; ".join(figures), held)


@attack(
    "F17 HTTP",
    "dates, numbers, texts and a configuration that no request may answer with 500",
    before="23 of 30 answered 500, 20 lines of at most 5181 characters logged",
    test="tests/e2e/test_station.py::test_no_request_is_answered_with_500",
)
def no_answer_500(folder: Path) -> Outcome:
    from tagid.operate.workplace import Workplace
    from tagid.station.server import Server
    from tagid.station.station import Source, Station

    logged: list[str] = []

    class Kept(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            logged.append(record.getMessage())

    logging.getLogger("tagid").addHandler(Kept())
    late, early = "9999-12-31T23:59:59-23:59", "0001-01-01T00:00%2B14:00"
    dates = [
        f"/api/v1/{path}?{side}={date}"
        for path in ("history", "history.csv", "history.json", "history/captures.zip")
        for side in ("since", "until")
        for date in (late, early)
    ]
    numbers = [
        "/api/v1/history/" + "9" * 4400 + "/picture",
        "/api/v1/reports/" + "1" * 5000,
        "/api/v1/reports/" + "0" * 5000 + "1/items.csv",
    ]
    texts = [b'{"code": "\\ud800"}', b'{"key": "\\udfff"}', b'{"name": "\\ud800", "note": "\\ud800"}']

    statuses = []
    (folder / "broken.toml").write_text("[radar\n")
    os.environ["TAGID_CONFIG"] = str(folder / "broken.toml")
    station = Station(Source(lambda: Workplace({})), lambda config: [])
    with Server(station, "127.0.0.1", 0) as server:
        statuses += [_get(server.port, path) for path in (*dates, *numbers)]
        for path in ("pair", "scan", "enrolment"):
            statuses += [_post(server.port, f"/api/v1/{path}", text) for text in texts]
        statuses += [_post(server.port, "/api/v1/scan"), _get(server.port, "/api/v1/history/1/capture")]
        with socket.create_connection(("127.0.0.1", server.port)) as line:
            head = f"POST /api/v1/scan/stop HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n"
            words = "Content-Type: application/json\r\ntagid-station: 1\r\nContent-Length: 100\r\n\r\n{"
            line.sendall((head + words).encode())
            time.sleep(0.5)
        time.sleep(0.5)
    wrong = sum(status >= 500 and status != 503 for status in statuses)
    longest = max(map(len, logged), default=0)
    figure = (
        f"{wrong} of {len(statuses)} answered 500, {len(logged)} lines of at most {longest} characters logged"
    )
    return Outcome(figure, not wrong and not logged)


@attack(
    "N2",
    "more messages than are allowed end with code 1008, at once",
    before="messages: 1008; pings: not closed in 180 s",
    test="tests/e2e/test_station.py::test_a_flood_ends_with_1008_and_is_not_read_on",
)
def a_flood_is_closed(folder: Path) -> Outcome:
    words = (
        "station",
        "--demo",
        "--bind",
        "127.0.0.1:0",
        "--save-dir",
        str(folder / "s"),
        "--output",
        "json",
    )
    with _command(*words) as station:
        port = int(_first_line(station)["url"].rpartition(":")[2])
        codes, slowest = [], 0.0
        for kind, body in ((1, b'{"type": "stop"}'), (9, b"a" * 100), (10, b"b"), (0, b"")):
            line = Operator(port)
            line.until("hello")
            began = time.monotonic()
            with suppress(OSError):
                for _ in range(60):
                    line.frame(kind, body)
            code = 1006
            with suppress(OSError):
                while (recovered := line.read())[0] != 8:
                    pass
                code = int.from_bytes(recovered[1][:2], "big")
            codes.append(code)
            slowest = max(slowest, time.monotonic() - began)
    held = codes[:3] == [1008] * 3 and slowest < 5
    return Outcome(f"closed with {', '.join(map(str, codes))} within {slowest:.1f} s", held)
