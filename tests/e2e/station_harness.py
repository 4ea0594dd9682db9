"""A station on a real socket with a radar in memory, and a WebSocket client that can misbehave."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from http.client import HTTPConnection
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from tagid.doctor import Finding
from tagid.operate.workplace import Workplace
from tagid.station import server, web_scans
from tagid.station.security import UPLOAD_PATH
from tagid.station.server import Server
from tagid.station.station import Source, Station

OWN = {"tagid-station": "1"}
"""The header of the page's own requests."""

RPM = 45
"""Speed of the objects: 24 views a turn, which are read in half the time that 134 take."""
FAST = f"emulator://helmet-120?rpm={RPM}&seed=2"
"""As fast as the scans are taken: a turn within a second."""
ENDLESS = "emulator://helmet-120?rpm=0.5&seed=2&rate=1"
"""In real time, two minutes and a half for a turn and its overlap: it is stopped long before."""
WAIT_S = 180.0


def source(
    folder: Path, radar: str | Callable[[], str] = FAST, rpm: float | None = None, resume_s: float = 20.0
) -> Source:
    """Scans of an emulated helmet into a folder; a function gives each scan its own radar."""
    settings = {
        "motion.url": f"free?rpm={rpm or (0.5 if radar == ENDLESS else RPM):g}",
        "motion.axis_distance_m": 1.0,
        "radar.integration": 15,
        "radar.timeout_s": 1.0,
        "radar.resume_s": resume_s,
        "imaging.method": "bp",
        "imaging.pixels": 64,
        "storage.folder": str(folder),
    }
    urls: dict[int, str] = {}

    def place() -> Workplace:
        if isinstance(radar, str):
            return Workplace({**settings, "radar.url": radar})
        recorded = len(list(folder.glob("*.tagid.h5")))
        if recorded not in urls:
            urls[recorded] = radar()
        return Workplace({**settings, "radar.url": urls[recorded]})

    return Source(place)


def healthy(config: object) -> list[Finding]:
    return [Finding("radar", "problem", "no answer <b>", "Check the cable.", answers=False)]


def wait(condition: Callable[[], Any], seconds: float = WAIT_S) -> Any:
    """The first true value; generous, for a machine that is busy."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if result := condition():
            return result
        time.sleep(0.1)
    raise AssertionError("it did not happen")


@dataclass
class Answer:
    status: int
    headers: dict[str, str]
    content: bytes

    @property
    def text(self) -> str:
        return self.content.decode()

    def json(self) -> Any:
        return json.loads(self.content)


class Asks:
    """Requests to a station, each over a connection of its own."""

    def __init__(self, url: str, headers: dict[str, str]) -> None:
        self._host, self._headers = url.removeprefix("http://"), headers

    def get(self, path: str) -> Answer:
        return self.ask("GET", path, None, {})

    def post(self, path: str, **values: Any) -> Answer:
        body = json.dumps(values).encode()
        media = "application/octet-stream" if path == UPLOAD_PATH else "application/json"
        return self.ask("POST", path, body, {"content-type": media})

    def ask(self, method: str, path: str, body: bytes | None, headers: dict[str, str]) -> Answer:
        connection = HTTPConnection(self._host, timeout=WAIT_S)
        try:
            connection.request(method, path, body, {**self._headers, **headers})
            reply = connection.getresponse()
            return Answer(reply.status, {k.lower(): v for k, v in reply.getheaders()}, reply.read())
        finally:
            connection.close()


@contextmanager
def alone(place: Path) -> Iterator[Server]:
    """One station for the tests of a file, with folders of its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TAGID_DATA", str(place / "data"))
        patch.setenv("TAGID_CONFIG", str(place / "c.toml"))
        patch.setattr(server, "PING_S", 120.0)
        with Server(Station(source(place), healthy), "127.0.0.1", 0) as station:
            wait(lambda: Asks(station.url, {}).get("/").status == 200)
            yield station


PLACES = np.array([(0.11, 0.0), (-0.02, 0.09), (-0.05, -0.07)])
"""Reflectors of `own_object`, m."""
POSES = ((0.006, -0.002, 10.0), (-0.004, 0.005, 130.0), (0.001, 0.008, 250.0))
"""Centre (m) and rotation (degrees) of the object in one capture after the other."""


def own_object(folder: Path) -> str:
    """Options of the emulator for the object `mine`, which is not enrolled."""
    rows = ", ".join(f"[{x}, {y}]" for x, y in PLACES)
    (folder / "mine.toml").write_text(f'name = "mine"\nkind = "other"\npositions_m = [{rows}]\n')
    return f"file={folder / 'mine.toml'}&reflector=octahedron"


def poses(scene: str, options: str = "", seed: int = 1) -> Iterator[str]:
    """Radars of a scene in one pose after the other."""
    while True:
        for x, y, turn in POSES:
            seed += 1
            pose = f"centre={x},{y}&rotation={turn}"
            yield f"emulator://{scene}?rpm={RPM}&seed={seed}&{pose}&{options}".rstrip("&")


def stations(place: Path, patch: pytest.MonkeyPatch) -> Iterator[Callable[..., Server]]:
    """For a fixture: a function that starts stations; afterwards none of their threads may be left."""
    patch.setenv("TAGID_DATA", str(place / "data"))
    patch.setenv("TAGID_CONFIG", str(place / "c.toml"))
    patch.setattr(web_scans, "GUESS_S", 0.0)
    patch.setattr(server, "PING_S", 120.0)  # clients here answer a ping when they next read
    (place / "out").mkdir()
    open_ones: list[Server] = []
    before = set(threading.enumerate())

    def start(
        radar: str | Callable[[], str] = FAST,
        announce: Callable[[str], None] | None = None,
        port: int = 0,
        check: Callable[..., list[Finding]] = healthy,
        **more: float,
    ) -> Server:
        handle = Server(Station(source(place / "out", radar, **more), check), "127.0.0.1", port, announce)
        handle.__enter__()
        open_ones.append(handle)
        wait(lambda: Asks(handle.url, {}).get("/").status == 200)
        return handle

    yield start
    for handle in open_ones:
        handle.close()
    names = [thread.name for thread in set(threading.enumerate()) - before]
    assert [name for name in names if name.startswith(("station-", "live-"))] == []


def ended(station: Server) -> dict[str, Any]:
    """The newest scan when it has ended."""
    client = Asks(station.url, {})
    return wait(lambda: (s := client.get("/api/v1/scan").json()) and not s.get("running", True) and s)


class Raw:
    """A WebSocket client of a few lines over a plain socket, which can misbehave."""

    opened: ClassVar[list[Raw]] = []

    def __init__(
        self, port: int, headers: dict[str, str] | None = None, receive_bytes: int | None = None
    ) -> None:
        self.socket = socket.socket()
        self.opened.append(self)
        if receive_bytes:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_bytes)
        self.socket.settimeout(WAIT_S)
        self.socket.connect(("127.0.0.1", port))
        words = {
            "Host": f"127.0.0.1:{port}",
            "Upgrade": "websocket",
            "Connection": "Upgrade",
            "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": base64.b64encode(os.urandom(16)).decode(),
            "Origin": f"http://127.0.0.1:{port}",
            **(headers or {}),
        }
        lines = "".join(f"{name}: {value}\r\n" for name, value in words.items() if value)
        self.socket.sendall(f"GET /api/v1/live HTTP/1.1\r\n{lines}\r\n".encode())
        self.buffer = b""
        while b"\r\n\r\n" not in self.buffer:
            part = self.socket.recv(4096)
            if not part:
                break
            self.buffer += part
        self.head, _, self.buffer = self.buffer.partition(b"\r\n\r\n")
        self.status = int(self.head.split()[1]) if self.head else 0

    def body(self) -> str:
        """The text of a response that refuses the WebSocket."""
        lines = self.head.decode().lower().splitlines()
        size = next(int(line.partition(":")[2]) for line in lines if line.startswith("content-length:"))
        return (self._take(size) or b"").decode()

    def frame(self, payload: bytes, opcode: int = 1, masked: bool = True) -> None:
        """Send one frame."""
        size, bit = len(payload), 0x80 if masked else 0
        if size < 126:
            head = bytes([0x80 | opcode, bit | size])
        else:
            small = size < 1 << 16
            head = bytes([0x80 | opcode, bit | (126 if small else 127)])
            head += struct.pack("!H" if small else "!Q", size)
        mask = os.urandom(4) if masked else b""
        body = bytes(b ^ mask[i % 4] for i, b in enumerate(payload)) if masked else payload
        self.socket.sendall(head + mask + body)

    def say(self, **message: Any) -> None:
        """Send a JSON message."""
        self.frame(json.dumps(message).encode())

    def read(self) -> tuple[int, bytes]:
        """(opcode, payload) of the next frame; (8, b"") where the connection ended."""
        need = self._take(2)
        if need is None:
            return 8, b""
        opcode, size = need[0] & 15, need[1] & 127
        if size in (126, 127):
            more = self._take(2 if size == 126 else 8) or b"\0\0"
            size = int.from_bytes(more, "big")
        return opcode, self._take(size) or b""

    def _take(self, count: int) -> bytes | None:
        while len(self.buffer) < count:
            try:
                part = self.socket.recv(65536)
            except OSError:
                return None
            if not part:
                return None
            self.buffer += part
        result, self.buffer = self.buffer[:count], self.buffer[count:]
        return result

    def until(self, kind: str, test: Callable[[dict[str, Any]], Any] = bool) -> dict[str, Any]:
        """The next message of a type that passes a test; pings are answered."""
        while True:
            opcode, payload = self.read()
            if opcode == 8:
                raise AssertionError(f"closed before {kind}")
            if opcode == 9:
                self.frame(payload, 10)
            elif opcode == 1:
                message = json.loads(payload)
                if message["type"] == kind and test(message):
                    return message

    def closed(self) -> int:
        """The code with which the station closes; 1006 where it just ended."""
        while True:
            opcode, payload = self.read()
            if opcode == 8:
                return int.from_bytes(payload[:2], "big") if len(payload) >= 2 else 1006

    def close(self) -> None:
        """End without a word, as a tablet that loses its network."""
        with suppress(OSError):
            self.socket.close()


def joined(port: int, key: str | None = None, **headers: str) -> tuple[Raw, str]:
    """A connection that said hello, and its key."""
    client = Raw(port, headers)
    assert client.status == 101
    client.say(type="hello", key=key)
    return client, client.until("hello")["key"]
