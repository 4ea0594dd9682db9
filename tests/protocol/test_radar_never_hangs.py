"""Recordings that end whatever arrives: fragments without whole scans, stopped clocks, foreign senders."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

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
from tagid.radar.scan_info import read_fragment
from tagid.radar.settings import RadarConfig
from tagid.radar.urls import open_link
from tagid.recording.long_recording import RecordingLimits, RecordingWatch, record_long
from tagid.recording.plan import RecordingPlan
from tagid.recording.radars import open_radar
from tagid.recording.session import start_journal
from tagid.storage.importers import read_any
from tests.processes import TAGID


class Incomplete(EmulatorCore):
    """A radar that sends `whole` whole scans, and no second fragment of those after them."""

    def __init__(self, whole: int = 0) -> None:
        super().__init__(Numbered(), THREE_FRAGMENTS)
        self._whole = whole
        self.incomplete = threading.Event()

    def step(self) -> list[bytes]:
        packets = super().step()
        self._whole -= 1
        if self._whole >= 0:
            return packets
        self.incomplete.set()
        return packets[:1] + packets[2:]


class StandingClock(EmulatorCore):
    """A radar whose timestamps, bytes 8 to 11 of a scan, are all the same."""

    def step(self) -> list[bytes]:
        return [packet[:8] + bytes(4) + packet[12:] for packet in super().step()]


def test_a_radar_that_comes_back_without_a_whole_scan_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """It answers every request, so only the time since the last whole scan can end this."""
    monkeypatch.setattr(p440_module, "_WHOLE_S", 0.3)
    with udp(Incomplete(whole=100)) as device, P440(UdpLink(*device.address), timeout=0.7) as radar:
        radar.set_config(THREE_FRAGMENTS)
        run = steady_scans(radar, resume_s=0.5)
        assert len([next(run) for _ in range(50)]) == 50
        missing = r"\d+ packets arrived .* no complete scan: fragments are missing"
        with pytest.raises(DeviceTimeoutError, match=missing):
            list(run)
        assert not device.core.scanning


def test_the_caller_is_asked_while_no_whole_scan_comes() -> None:
    """So Ctrl-C and limits work at once; without it this would last for the patience of five seconds."""
    asked = []

    def until() -> bool:
        asked.append(time.monotonic())
        return len(asked) == 3

    with udp(Incomplete()) as device, P440(UdpLink(*device.address)) as radar:
        radar.set_config(THREE_FRAGMENTS)
        assert list(radar.scans(until=until)) == []
        assert len(asked) == 3
        assert radar.get_config().samples == 864  # the client is still usable


def test_a_limit_holds_where_the_radars_clock_stands_still(tmp_path: Path) -> None:
    with udp(StandingClock(Numbered()), rate=1.0) as device:
        plan, limits = RecordingPlan(THREE_FRAGMENTS, 1.0), RecordingLimits(seconds=0.2)
        written = record_long(open_radar(device.url), plan, limits, tmp_path / "a.tagid.h5")
    assert written.complete
    assert written.views > 0
    assert np.ptp(read_any(written.paths[0]).radar_time_ms) == 0


def test_stop_ends_a_recording_of_a_radar_that_sends_no_whole_scan_after_a_while(tmp_path: Path) -> None:
    stop = threading.Event()
    with udp(Incomplete(whole=3000)) as device:
        watch = RecordingWatch(progress=lambda state: stop.set(), stop=stop.is_set)
        plan = RecordingPlan(THREE_FRAGMENTS, 1.0)
        written = record_long(open_radar(device.url), plan, RecordingLimits(), tmp_path / "a.tagid.h5", watch)
    assert written.complete
    assert 0 < written.views <= 3000


@pytest.mark.parametrize("wire", [udp, pty])
def test_something_that_answers_but_not_as_a_p440_is_told_from_silence(wire: Callable[[], Any]) -> None:
    with wire() as device:

        def answer(packet: bytes) -> list[bytes]:
            if wire is udp:
                return [b"HTTP/1.1 400 Bad Request"]
            device.wire._frames.append(b"$GPGGA,123519,4807.038,N*47\r\n")
            return []

        device.order(lambda: setattr(device.core, "handle", answer))
        radar = P440(open_link(device.url)(), timeout=0.3)
        with pytest.raises(DeviceTimeoutError, match=r"answers at .*, but not as a P440"):
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
    count = 65_535 if stall_s < 2 else 60_000  # without an end, or with one
    radar.handle(encode(MessageType.CONTROL_REQUEST, 10, scan_count=count))
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
            plan, limits = RecordingPlan(None, 1.0), RecordingLimits(seconds=3600)
            record_long(open_radar(device.url), plan, limits, folder / "a.tagid.h5", watch)
    assert not list(tmp_path.rglob("*.h5"))


def test_the_first_ctrl_c_ends_a_recording_while_only_fragments_come(
    home: dict[str, str], tmp_path: Path
) -> None:
    """The whole command, over UDP, after twenty whole scans."""
    radar = Incomplete(whole=20)
    with udp(radar, rate=1.0) as device:
        process = subprocess.Popen(
            [*TAGID, "radar", "record", "--radar", device.url, "--save-dir", str(tmp_path)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=home,
        )  # fmt: skip
        assert radar.incomplete.wait(60)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    (path,) = tmp_path.glob("*.tagid.h5")
    assert 0 < read_any(path).views <= 20
