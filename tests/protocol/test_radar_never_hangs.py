"""Recordings that end whatever arrives: fragments without whole scans, stopped clocks, foreign senders."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from radar_ends import THREE_FRAGMENTS, Numbered, pty, udp

from tagid.errors import DeviceTimeoutError, StorageError
from tagid.radar import p440 as p440_module
from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.links import UdpLink
from tagid.radar.messages import MessageType, encode
from tagid.radar.p440 import P440
from tagid.radar.resume import steady_scans
from tagid.radar.scan_info import SCAN_INFO_HEAD, read_fragment
from tagid.radar.settings import RadarConfig
from tagid.radar.urls import open_link
from tagid.recording.long_recording import RecordingLimits, RecordingWatch, record_long
from tagid.recording.plan import RecordingPlan
from tagid.recording.radars import open_radar
from tagid.recording.session import start_journal
from tagid.storage.importers import read_any


class Incomplete(UdpLink):
    """Loses the second fragment of every scan from `after` fragments on."""

    def __init__(self, address: tuple[str, int], after: int = 0, clock_ms: int | None = None) -> None:
        super().__init__(*address)
        self._left, self._clock_ms = after, clock_ms

    @property
    def incomplete(self) -> bool:
        """Whether it has begun to lose fragments."""
        return self._left < 0

    def receive(self, timeout: float) -> bytes | None:
        packet = super().receive(timeout)
        if packet is None or not packet.startswith(SCAN_INFO_HEAD):
            return packet
        fragment = read_fragment(packet)
        assert fragment is not None
        self._left -= 1
        if self._left < 0 and fragment.part == 1:
            return self.receive(0.0)
        if self._clock_ms is not None:  # timestamp: bytes 8 to 11
            packet = packet[:8] + self._clock_ms.to_bytes(4, "big") + packet[12:]
        return packet


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """A radar without whole scans is given up after a second, not five."""
    monkeypatch.setattr(p440_module, "_WHOLE_S", 0.3)


@pytest.mark.usefixtures("soon")
def test_fragments_that_never_make_a_scan_end_the_run_and_say_so() -> None:
    with udp() as device, P440(Incomplete(device.address), timeout=0.7) as radar:
        radar.set_config(THREE_FRAGMENTS)
        with pytest.raises(DeviceTimeoutError, match=r"\d+ packets arrived .* no complete scan: fragments"):
            list(radar.scans())
        assert not device.core.scanning


@pytest.mark.usefixtures("soon")
def test_a_radar_that_comes_back_without_a_whole_scan_is_given_up() -> None:
    """It answers every request, so only the time since the last whole scan can end this."""
    with udp() as device, P440(Incomplete(device.address, after=300), timeout=0.7) as radar:
        radar.set_config(THREE_FRAGMENTS)
        run = steady_scans(radar, resume_s=0.5)
        assert len([next(run) for _ in range(50)]) == 50
        with pytest.raises(DeviceTimeoutError, match="no complete scan: fragments are missing"):
            list(run)


def test_the_caller_is_asked_while_no_whole_scan_comes() -> None:
    """So Ctrl-C and limits work at once; without it this would last for the patience of five seconds."""
    asked = []

    def until() -> bool:
        asked.append(time.monotonic())
        return len(asked) == 3

    with udp() as device, P440(Incomplete(device.address)) as radar:
        radar.set_config(THREE_FRAGMENTS)
        assert list(radar.scans(until=until)) == []
        assert len(asked) == 3
        assert radar.get_config().samples == 864  # the client is still usable


def test_a_limit_holds_where_the_radars_clock_stands_still(tmp_path: Path) -> None:
    with udp(rate=1.0) as device:
        radar = P440(Incomplete(device.address, after=10**9, clock_ms=5000))
        limits = RecordingLimits(seconds=0.2)
        written = record_long(radar, RecordingPlan(THREE_FRAGMENTS, 1.0), limits, tmp_path / "a.tagid.h5")
    assert written.complete
    assert written.views > 0
    assert np.ptp(read_any(written.paths[0]).radar_time_ms) == 0


def test_stop_ends_a_recording_of_a_radar_that_sends_no_whole_scan_after_a_while(tmp_path: Path) -> None:
    stop = threading.Event()
    with udp() as device:
        radar = P440(Incomplete(device.address, after=9000))
        watch = RecordingWatch(progress=lambda state: stop.set(), stop=stop.is_set)
        plan = RecordingPlan(THREE_FRAGMENTS, 1.0)
        written = record_long(radar, plan, RecordingLimits(), tmp_path / "a.tagid.h5", watch)
    assert written.complete
    assert 0 < written.views <= 3000


class Echo:
    """A UDP port that answers, but is no radar."""

    def __init__(self, answer: bytes) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._answer = answer
        self.address = self._socket.getsockname()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def _work(self) -> None:
        while True:
            try:
                asked, sender = self._socket.recvfrom(2048)
            except OSError:
                return
            if asked == b"end":
                return
            self._socket.sendto(self._answer, sender)

    def __enter__(self) -> Echo:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.sendto(b"end", self.address)
        self._thread.join(5)
        self._socket.close()


def test_something_that_answers_but_not_as_a_p440_is_told_from_silence() -> None:
    with Echo(b"HTTP/1.1 400 Bad Request") as peer:
        radar = P440(UdpLink(*peer.address), timeout=0.2)
        with pytest.raises(DeviceTimeoutError, match=r"answers at .*, but not as a P440"):
            radar.connect()
        radar.close()


def test_a_serial_device_that_sends_other_bytes_is_told_from_silence() -> None:
    with pty() as device:

        def answer(packet: bytes) -> list[bytes]:
            device.wire.write_raw(b"$GPGGA,123519,4807.038,N*47\r\n")
            return []

        device.order(lambda: setattr(device.core, "handle", answer))
        radar = P440(open_link(device.url)(), timeout=0.3)
        with pytest.raises(DeviceTimeoutError, match="but not as a P440"):
            radar.connect()
        radar.close()


class TimeTeller:
    """The first sample of a scan is the time that its scene is at, in tenths of a millisecond."""

    def scan(self, index: int, time_s: float, config: RadarConfig) -> np.ndarray:
        return np.full(config.samples, round(time_s * 1e4), np.int32)


@pytest.mark.parametrize("stall_s", [0.4, 1.9, 7.0])
def test_an_emulator_that_stalls_keeps_scene_and_timestamps_on_one_clock(stall_s: float) -> None:
    """Ids, timestamps and the scene's time go on together; what could not be sent is a lost scan."""
    config = RadarConfig(base_integration_index=11, scan_start_ps=1000, scan_stop_ps=6000)
    radar = EmulatorCore(TimeTeller(), config, booted_s=0.0)
    period = radar.config.scan_period_s
    fragments = []
    radar.handle(encode(MessageType.CONTROL_REQUEST, 10, scan_count=65_535))
    now = 0.0
    while now < 1.0:
        now += period / 2
        fragments += radar.advance_by_one(now)
    now += stall_s
    stalled_at = len(fragments)
    while now < 1.0 + stall_s + 2.0:
        now += period / 2
        fragments += radar.advance_by_one(now)
    results = [read_fragment(packet) for packet in fragments]
    scene_ms = np.array([f.samples[0] / 10 for f in results])
    stamps = np.array([f.timestamp_ms for f in results])
    ids = np.array([f.id for f in results])
    np.testing.assert_allclose(stamps - scene_ms, period * 1e3, atol=1.1)
    np.testing.assert_allclose(stamps - stamps[0], (ids - ids[0]) * period * 1e3, atol=1.01)
    assert stamps[-1] * 1e-3 > now - 0.6  # it has caught up with the clock
    lost = ids[-1] - ids[0] + 1 - len(ids)
    assert (lost > 0) == (stall_s > 0.5)
    gap = (stamps[stalled_at] - stamps[stalled_at - 1]) * 1e-3
    assert gap < 0.1 if stall_s < 2 else gap == pytest.approx(stall_s, abs=0.1)


def test_two_recordings_that_start_in_one_second_get_two_names(tmp_path: Path) -> None:
    """Twenty threads ask for one name at once, as scripts that start in the same second do."""
    header = {"range_start_m": 1.0, "range_step_m": 0.009}
    path = tmp_path / "scan-20260101-000000.tagid.h5"
    journals, ready = [], threading.Barrier(20)

    def start() -> None:
        ready.wait()
        journals.append(start_journal(path, header, renumber=True))

    threads = [threading.Thread(target=start) for _ in range(20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({journal.path for journal in journals}) == 20
    with pytest.raises(StorageError, match="another recording is writing it") as caught:
        start_journal(path, header)
    assert "recover" not in caught.value.remedy, "it would take a live recording"
    for journal in journals:
        journal.close()
    with pytest.raises(StorageError, match="a recording was interrupted") as caught:
        start_journal(path, header)
    assert "tagid recover" in caught.value.remedy and "move" not in caught.value.remedy


@pytest.mark.parametrize("fate", ["vanish", "shrink", "folder"])
def test_a_journal_that_vanishes_or_shrinks_ends_the_recording_with_an_error(
    fate: str, tmp_path: Path
) -> None:
    folder = tmp_path / "day"
    folder.mkdir()

    def progress(state: object) -> None:
        journal = folder / "a.tagid.journal"
        if not journal.exists():
            return
        if fate == "vanish":
            journal.unlink()
        elif fate == "folder":
            folder.rename(tmp_path / "moved")
        else:
            os.truncate(journal, 200)

    with udp(rate=1.0) as device:
        watch = RecordingWatch(progress)
        with pytest.raises(StorageError, match="while it was recorded to"):
            record_long(
                open_radar(device.url),
                RecordingPlan(None, 1.0),
                RecordingLimits(seconds=3600),
                folder / "a.tagid.h5",
                watch,
            )
    assert not list(tmp_path.rglob("*.h5"))


def test_the_first_ctrl_c_ends_a_recording_while_only_fragments_come(tmp_path: Path) -> None:
    """The whole command, over UDP, with every second fragment lost on the way after twenty whole scans."""
    relay = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    relay.bind(("127.0.0.1", 0))
    relay.settimeout(0.01)
    flooding, over = threading.Event(), threading.Event()

    def work() -> None:
        client = None
        up = Incomplete(device.address, after=60)
        while not over.is_set():
            try:
                packet, client = relay.recvfrom(4096)
                up.send(packet)
            except TimeoutError:
                pass
            while (answer := up.receive(0.0)) is not None:
                if up.incomplete:
                    flooding.set()
                relay.sendto(answer, client)
        up.close()

    with udp(EmulatorCore(Numbered(), THREE_FRAGMENTS), rate=1.0) as device:
        thread = threading.Thread(target=work)
        thread.start()
        command = [sys.executable, "-m", "tagid", "radar", "record", "--output", "json", "--radar"]
        url = "udp://{}:{}".format(*relay.getsockname())
        process = subprocess.Popen(
            [*command, url, "--save-dir", str(tmp_path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        assert flooding.wait(60)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
        over.set()
        thread.join()
    relay.close()
    assert process.returncode == 0, errors
    (path,) = tmp_path.glob("*.tagid.h5")
    assert 0 < read_any(path).views <= 20
