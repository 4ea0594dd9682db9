"""`tagid emulate p440` used by a client that shares no line with tagid, as third parties write them.

Everything here is written from the message tables with struct alone; sizes are checked exactly.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import struct
import subprocess
import time
import tty
from collections.abc import Callable
from pathlib import Path

import pytest
from command_server import Ran

from tests.processes import TAGID, emulated

CONFIG = struct.Struct(">IiiHH4H4BBBBB")
WANTED = CONFIG.pack(1, 15_000, 65_000, 32, 6, 0, 0, 0, 0, 0, 0, 0, 0, 2, 63, 0, 0)


class Udp:
    """A client with one socket."""

    def __init__(self, url: str) -> None:
        host, port = url.removeprefix("udp://").split(":")
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(10)
        self.socket.connect((host, int(port)))

    def send(self, packet: bytes) -> None:
        self.socket.send(packet)

    def receive(self) -> bytes:
        return self.socket.recv(4096)

    def close(self) -> None:
        self.socket.close()


def crc_xmodem(data: bytes) -> int:
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


class Serial:
    """A client that reads exactly what a frame says, without looking for lost borders."""

    def __init__(self, path: str, uart: bool) -> None:
        self.uart = uart
        self.port = os.open(path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.port)

    def send(self, packet: bytes) -> None:
        tail = struct.pack(">H", crc_xmodem(packet)) if self.uart else b""
        os.write(self.port, b"\xa5\xa5" + struct.pack(">H", len(packet)) + packet + tail)

    def receive(self) -> bytes:
        sync, size = struct.unpack(">HH", self.exactly(4))
        assert sync == 0xA5A5
        packet = self.exactly(size)
        if self.uart:
            assert struct.unpack(">H", self.exactly(2))[0] == crc_xmodem(packet)
        return packet

    def exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            assert select.select([self.port], [], [], 10)[0], "the emulator fell silent"
            data += os.read(self.port, count - len(data))
        return data

    def close(self) -> None:
        os.close(self.port)


def ask(
    client: Udp | Serial, request: int, confirm: int, size: int, body: bytes = b"", number: int = 77
) -> bytes:
    """Sends a request; the confirm must have its type, the same id and exactly this size."""
    client.send(struct.pack(">HH", request, number) + body)
    answer = client.receive()
    assert struct.unpack(">HH", answer[:4]) == (confirm, number)
    assert len(answer) == size
    return answer[4:]


def use_as_a_third_party(client: Udp | Serial, sleep_size: int = 12, status_size: int = 64) -> None:
    refused = ask(client, 0x1004, 0xF10C, 12, struct.pack(">IHBB", 0x7F000001, 21210, 1, 0))
    assert struct.unpack(">HHI", refused) == (0x1004, 77, 8)
    ask(client, 0x1003, 0x1103, 8, struct.pack(">HHI", 0, 0, 0))
    assert ask(client, 0xF004, 0xF104, 8) == struct.pack(">I", 1)
    assert ask(client, 0xF003, 0xF103, 12, struct.pack(">I", 1)) == struct.pack(">II", 1, 0)
    assert ask(client, 0xF006, 0xF106, sleep_size)[:4] == bytes(4)
    status = ask(client, 0xF001, 0xF101, status_size)
    assert status[-4:] == bytes(4)
    assert ask(client, 0x1001, 0x1101, 8, WANTED) == bytes(4)
    taken = ask(client, 0x1002, 0x1102, 44)
    start, stop = struct.unpack(">ii", taken[4:12])
    assert (start, taken[-4:]) == (14_999, bytes(4))
    assert 65_000 <= stop < 68_000
    # The first scan's id is the request's; fragments share id and timestamp; all are 1452 bytes.
    assert ask(client, 0x1003, 0x1103, 8, struct.pack(">HHI", 3, 0, 0), number=0xFFFE) == bytes(4)
    for scan_id in (0xFFFE, 0xFFFF, 0x0000):
        stamps = set()
        for index in range(3):
            packet = client.receive()
            assert len(packet) == 1452
            kind, number, _node, stamp = struct.unpack(">HHII", packet[:12])
            assert (kind, number) == (0xF201, scan_id)
            assert packet[12:28] == bytes(16)
            here, total, part, parts = struct.unpack(">HIHH", packet[42:52])
            assert (here, total, part, parts) == ((350, 350, 164)[index], 864, index, 3)
            assert packet[52 + 4 * here :] == bytes(1400 - 4 * here)
            stamps.add(stamp)
        assert len(stamps) == 1
    refused = ask(client, 0x1234, 0xF10C, 12)
    assert struct.unpack(">HHI", refused) == (0x1234, 77, 8)
    refused = ask(client, 0x1003, 0xF10C, 12, b"\0")
    assert struct.unpack(">HHI", refused) == (0x1003, 77, 5)


@pytest.mark.parametrize("framing", ["usb", "uart"])
def test_a_third_party_client_on_a_serial_port(home: dict[str, str], framing: str) -> None:
    options = ("--serial", "--framing", framing, "--baud", "0", "--scene", "empty")
    with emulated(home, "p440", *options) as (data, process):
        client = Serial(data["port"], framing == "uart")
        use_as_a_third_party(client)
        client.close()
        # The next client opens the same port.
        client = Serial(data["port"], framing == "uart")
        ask(client, 0xF004, 0xF104, 8)
        client.close()
        assert process.poll() is None


def test_other_firmware_is_emulated_when_asked_for(home: dict[str, str]) -> None:
    empty = ("--bind", "127.0.0.1:0", "--scene", "empty")
    with emulated(home, "p440", *empty, "--status-bytes", "32", "--sleep-bytes", "8") as (data, process):
        client = Udp(data["url"])
        use_as_a_third_party(client, sleep_size=8, status_size=32)
        client.close()
        assert process.poll() is None
    with emulated(home, "p440", *empty, "--server") as (data, _):
        client = Udp(data["url"])
        accepted = ask(client, 0x1004, 0x1104, 8, struct.pack(">IHBB", 0x7F000001, 21210, 1, 0))
        assert accepted == struct.pack(">I", 0)
        ask(client, 0x1007, 0x1107, 12)
        client.close()


def test_the_serial_port_s_path_is_printed_and_the_emulator_runs_until_it_is_stopped(tmp_path: Path) -> None:
    name = tmp_path / "radar"
    process = subprocess.Popen(
        [*TAGID, "emulate", "p440", "--serial", "--link", str(name), "--scene", "empty"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == f"serial://{name}\n"
    client = Serial(str(name), uart=False)
    ask(client, 0xF004, 0xF104, 8)
    time.sleep(0.2)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=10)
    client.close()
    assert (process.returncode, out) == (0, "")
    assert f"serial://{name}" in errors
    assert not name.is_symlink()


def test_wrong_options_are_named(tagid: Callable[..., Ran]) -> None:
    for wrong in (
        ("--serial", "--framing", "spi"),
        ("--serial", "--framing", "uart", "--baud", "7"),
        ("--status-bytes", "60"),
        ("--sleep-bytes", "9"),
        ("--serial", "--link", "/no/such/folder/radar"),
    ):
        done = tagid("emulate", "p440", "--scene", "empty", *wrong, "--output", "json")
        assert done.json["status"] == "error" and done.json["errors"][0]["remedy"]
        assert done.code in (1, 2)
