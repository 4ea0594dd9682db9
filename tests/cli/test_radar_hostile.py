"""Nothing from the network writes outside the capture folder, grows the memory, or changes a setting."""

from __future__ import annotations

import random
import socket
import threading
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from tagid.errors import TagidError
from tagid.radar.emulation.core import EmulatorCore, Identity
from tagid.radar.emulation.emulator import ServeOptions
from tagid.radar.links import UdpLink
from tagid.radar.messages import MAX_SAMPLES_PER_SCAN, MessageType, encode
from tagid.radar.p440 import P440
from tagid.radar.settings import RadarConfig
from tagid.storage.importers import read_any
from tests.emulators import UdpEmulator

NAMES = ("../../../evil", "/etc/evil\0x", "\x1b]0;evil\x07${HOME}")
CONFIG = RadarConfig(scan_start_ps=10_000, scan_stop_ps=15_000, base_integration_index=6)


class Ramp:
    def scan(self, index: int, time_s: float, config: RadarConfig) -> np.ndarray:
        return np.full(config.samples, index, np.int32)


def tree(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if "site-packages" not in str(path)}


@pytest.mark.parametrize("name", NAMES)
def test_a_radar_with_a_hostile_name_writes_in_the_capture_folder_only(
    tagid, tmp_path: Path, name: str
) -> None:
    core = EmulatorCore(Ramp(), CONFIG, Identity(package=name))
    with UdpEmulator(core, ServeOptions(port=0, rate=0)) as device:
        before = tree(tmp_path)
        done = tagid("radar", "record", "--radar", device.url, "--scans", "30", "--save-dir", "captures",
                     "--output", "json")  # fmt: skip
        info = tagid("radar", "info", "--radar", device.url)
    assert done.code == 0, done.err
    new = tree(tmp_path) - before - {"home"}
    (path,) = (entry for entry in new if entry != "captures")
    assert path == done.json["data"]["path"]
    assert path.startswith("captures/scan-")
    assert read_any(tmp_path / path).views == 30
    assert "\x1b]0;" not in info.out  # what a radar says must not steer the terminal


@contextmanager
def liar(answer) -> Iterator[tuple[str, int]]:
    """A host that answers each packet with whatever `answer(packet)` gives."""
    stop = threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.settimeout(0.02)

        def serve() -> None:
            while not stop.is_set():
                try:
                    packet, sender = sock.recvfrom(65535)
                except TimeoutError:
                    continue
                for reply in answer(packet):
                    sock.sendto(reply, sender)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield sock.getsockname()
        finally:
            stop.set()
            thread.join()


def hostile(rng: random.Random):
    """Well-formed answers, lies in every field, and noise, in one stream."""
    honest = EmulatorCore(Ramp(), CONFIG)

    def answer(packet: bytes) -> list[bytes]:
        replies = [*honest.handle(packet), *honest.step()]
        for _ in range(40):
            fields = {
                "timestamp_ms": rng.getrandbits(32),
                "message_samples": rng.choice([0, 1, 350, 65535]),
                "total_samples": rng.choice([1, 96, 8400, 2**32 - 1]),
                "message_index": rng.randrange(30),
                "message_count": rng.choice([1, 3, 24, 65535]),
            }
            replies.append(encode(MessageType.SCAN_INFO, rng.getrandbits(16), **fields))
            replies.append(rng.randbytes(rng.randrange(1500)))
            kind = rng.choice(list(MessageType))
            replies.append(bytes([kind >> 8, kind & 255]) + rng.randbytes(rng.randrange(80)))
        rng.shuffle(replies)
        return replies

    return answer


@pytest.mark.parametrize("seed", range(2))
def test_a_flood_of_lies_takes_bounded_memory_and_ends_in_a_value_or_an_error(seed: int) -> None:
    with liar(hostile(random.Random(seed))) as address:
        P440(UdpLink(*address), timeout=0.01, attempts=1).close()  # what is imported late
        tracemalloc.start()
        for _ in range(6):
            radar = P440(UdpLink(*address), timeout=0.05, attempts=2)
            try:
                radar.connect()
                radar.status()
                for count, scan in enumerate(radar.scans(50)):
                    assert len(scan.samples) <= MAX_SAMPLES_PER_SCAN
                    if count > 20:
                        break
            except TagidError as error:
                assert error.message
            finally:
                radar.close()
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 24 << 20, f"{peak >> 20} MB"


def test_neither_scans_nor_lies_change_the_configuration(tagid, tmp_path: Path) -> None:
    file = tmp_path / "home" / "config.toml"
    assert tagid("config", "set", "radar.gain", "40").code == 0
    before = file.read_bytes()
    with liar(hostile(random.Random(9))) as address:
        url = f"udp://{address[0]}:{address[1]}"
        for words in (
            ("radar", "record", "--seconds", "0.2", "--save-dir", "c"),
            ("radar", "monitor", "--seconds", "0.2"),
            ("radar", "info"),
            ("radar", "config", "--gain", "10"),
            ("radar", "calibrate", "--distance", "2", "--scans", "16"),
        ):
            done = tagid(*words, "--radar", url, "--output", "json", TAGID_RADAR_TIMEOUT_S="0.05")
            assert done.code in (0, 1, 4), (words, done.out)
            for error in done.json["errors"]:
                assert not error["message"].startswith("unexpected"), (words, error)
    assert file.read_bytes() == before
    assert {path.parts[0] for path in map(Path, tree(tmp_path))} <= {"home", "c"}
