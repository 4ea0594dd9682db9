"""`tagid radar config` and `record`: what is asked, what is taken, and hours of scans in constant memory."""

from __future__ import annotations

import os
import signal
import subprocess
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tagid.capture import ViewFlag
from tagid.errors import DeviceTimeoutError, DiskFullError
from tagid.metadata import ObjectInfo
from tagid.motion.urls import open_motion
from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.emulator import ServeOptions
from tagid.radar.emulation.memory import MemoryLink
from tagid.radar.p440 import P440
from tagid.radar.settings import RadarConfig
from tagid.recording.long_recording import RecordingLimits, RecordingWatch, record_long
from tagid.recording.plan import RecordingPlan
from tagid.recording.recorder import record
from tagid.storage import journal as journal_module
from tagid.storage.importers import read_any
from tagid.storage.journal_capture import write_captures
from tests.emulators import UdpEmulator
from tests.processes import TAGID, journal_bytes, wait_until

SMALL = RadarConfig(scan_start_ps=10_000, scan_stop_ps=15_000, base_integration_index=6)


class Numbered:
    def scan(self, index: int, time_s: float, config: RadarConfig) -> np.ndarray:
        return (np.arange(config.samples) + index).astype(np.int32)


def radar(config: RadarConfig = SMALL) -> P440:
    return P440(MemoryLink(EmulatorCore(Numbered(), config)))


PLAN = RecordingPlan(None, 1.0)


def test_a_recording_leaves_number_and_code_channel_of_the_radar(tmp_path: Path) -> None:
    """By the code channel radars that are near each other are told apart."""
    own = replace(SMALL, node_id=7, code_channel=3)
    plan = RecordingPlan(SMALL, 1.0, scans=4)
    capture = record(radar(own), open_motion("free?rpm=60"), plan, tmp_path / "a.tagid.h5")
    config = capture.radar.config
    assert config is not None and (config.node_id, config.code_channel) == (7, 3)


def test_config_sets_only_what_is_asked_and_shows_both_sides(tagid) -> None:
    with UdpEmulator(EmulatorCore(Numbered(), SMALL), ServeOptions(port=0)) as device:
        words = ("radar", "config", "--radar", device.url)
        shown = tagid(*words, "--output", "json").json["data"]
        assert (shown["asked"], shown["taken"]) == ({}, shown["before"])
        done = tagid(*words, "--start", "1.0", "--stop", "2.5", "--cable-delay", "10000", "--gain", "20",
                     "--output", "json")  # fmt: skip
        data = done.json["data"]
        # 1 m is 6671 ps there and back, 2.5 m is 16678 ps; the cables come on top.
        assert data["asked"] == {"scan_start_ps": 16_671, "scan_stop_ps": 26_678, "transmit_gain": 20}
        taken = data["taken"]
        assert abs(taken["scan_start_ps"] - 16_671) <= 2
        assert taken["scan_stop_ps"] >= 26_678
        assert (taken["transmit_gain"], taken["base_integration_index"], taken["persist"]) == (20, 6, 0)
        assert data["window_m"][0] == pytest.approx(1.0, abs=1e-3)
        assert data["window_m"][1] >= 2.5
        assert data["samples"] % 96 == 0
        again = tagid(*words)
        assert "20" in again.out
        for name in ("before", "asked", "taken", "scan_start_ps", "scans per second"):
            assert name in again.out
        for bad in (
            ("--gain", "64"),
            ("--start", "9"),
            ("--start", "1", "--start-ps", "5"),
            ("--start", "nan"),
        ):
            assert tagid(*words, *bad, "--output", "json").code == 2, bad
        assert tagid(*words, "--output", "json").json["data"]["before"] == taken


def test_records_to_one_file_with_the_radars_own_settings(tagid, tmp_path: Path) -> None:
    with UdpEmulator(EmulatorCore(Numbered(), SMALL), ServeOptions(port=0, rate=0)) as device:
        done = tagid("radar", "record", "--radar", device.url, "--scans", "200", "--save-dir", "day",
                     "--note", "yard", "--output", "json")  # fmt: skip
    assert done.code == 0, done.err
    (path,) = (tmp_path / "day").iterdir()
    assert str(path.relative_to(tmp_path)) == done.json["data"]["path"]
    capture = read_any(path)
    assert capture.samples.shape == (200, 96)
    np.testing.assert_array_equal(np.diff(capture.samples[:, 0]), np.diff(capture.scan_id))
    assert capture.complete
    assert capture.object == ObjectInfo(note="yard")
    assert capture.radar.config.base_integration_index == 6


def test_a_long_recording_becomes_parts_that_join_without_a_seam(tmp_path: Path) -> None:
    limits = RecordingLimits(scans=250, part_bytes=100 * 96 * 4)
    written = record_long(radar(), PLAN, limits, tmp_path / "a.tagid.h5")
    assert [path.name for path in written.paths] == ["a.tagid.h5", "a.part2.tagid.h5", "a.part3.tagid.h5"]
    parts = [read_any(path) for path in written.paths]
    assert [part.views for part in parts] == [100, 100, 50]
    np.testing.assert_array_equal(
        np.diff(np.concatenate([part.samples[:, 0] for part in parts])), np.ones(249)
    )
    assert len({part.uuid for part in parts}) == 3
    assert {part.radar.recording.uuid for part in parts} == {parts[0].uuid}
    assert [part.radar.recording.part for part in parts] == [1, 2, 3]
    assert not list(tmp_path.glob("*.journal"))


def test_memory_does_not_grow_with_the_scans(tmp_path: Path) -> None:
    held: list[int] = []

    def progress(state) -> None:
        journal, still, last = tmp_path / "a.tagid.journal", 0, -1
        while still < 10:  # the queue is empty where the journal no longer grows
            size = journal.stat().st_size
            still = still + 1 if size == last and size >= state.scans * 384 else 0
            last = size
            time.sleep(0.005)
        held.append(tracemalloc.get_traced_memory()[0])

    watch = RecordingWatch(progress)
    tracemalloc.start()
    record_long(radar(), PLAN, RecordingLimits(scans=3000), tmp_path / "a.tagid.h5", watch)
    tracemalloc.stop()
    assert len(held) >= 4
    # A journal that waits for the disk grows as little: the least of each half was taken with an empty queue.
    middle = len(held) // 2
    assert min(held[middle:]) - min(held[:middle]) < 100_000  # 1500 scans of 384 bytes in between


def test_memory_does_not_grow_with_the_journal(tmp_path: Path) -> None:
    def peak(scans: int) -> int:
        journal = tmp_path / f"{scans}.tagid.journal"
        header = {"range_start_m": 0.0, "range_step_m": 0.01}
        with journal_module.JournalWriter(journal, header, sync_every=0) as writer:
            for number in range(scans):
                writer.append(number, number, float(number), np.full(96, number, np.int32))
            writer.close({})
        tracemalloc.start()
        write_captures(journal, lambda part: tmp_path / f"{scans}.tagid.h5")
        worst = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return worst

    peak(600)  # What is imported and kept at the first use counts once.
    assert peak(12_000) - peak(6_000) < 50_000  # 2.3 MB of samples more


def test_the_users_stop_ends_in_good_order(tmp_path: Path) -> None:
    for limits, complete in ((RecordingLimits(), True), (RecordingLimits(scans=10_000), False)):
        asked: list[int] = []
        watch = RecordingWatch(
            lambda state, asked=asked: asked.append(1) if state.scans > 600 else None,
            lambda asked=asked: bool(asked),
        )
        path = tmp_path / f"{complete}.tagid.h5"
        written = record_long(radar(), PLAN, limits, path, watch)
        assert written.views > 600
        assert written.complete is read_any(path).complete is complete


def test_ctrl_c_on_the_command_line(home: dict[str, str], tmp_path: Path) -> None:
    with UdpEmulator(EmulatorCore(Numbered(), SMALL), ServeOptions(port=0)) as device:
        child = subprocess.Popen(
            [*TAGID, "radar", "record", "--radar", device.url, "--save-dir", "x", "--output", "json"],
            cwd=tmp_path, env=home, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        wait_until(lambda: journal_bytes(tmp_path / "x") > 50_000, child)
        child.send_signal(signal.SIGINT)
        out, err = child.communicate(timeout=60)
    assert child.returncode == 0, err
    assert "Traceback" not in err
    (path,) = (tmp_path / "x").iterdir()
    assert path.name in out
    assert read_any(path).complete


def test_a_radar_that_dies_leaves_what_arrived(tmp_path: Path) -> None:
    core = EmulatorCore(Numbered(), SMALL)
    link = MemoryLink(core)
    seen = 0

    def progress(state) -> None:
        nonlocal seen
        seen = state.scans
        if state.scans > 1000:
            link.receive = lambda timeout: None  # type: ignore[method-assign]

    with pytest.raises(DeviceTimeoutError) as caught:
        record_long(
            P440(link, timeout=0.02),
            PLAN,
            RecordingLimits(),
            tmp_path / "a.tagid.h5",
            RecordingWatch(progress),
        )
    assert "a.tagid.h5" in caught.value.remedy
    capture = read_any(tmp_path / "a.tagid.h5")
    assert capture.views >= seen > 1000
    assert not capture.complete
    assert capture.flags is not None
    assert capture.flags[0] == ViewFlag.FIRST


def test_a_full_disk_keeps_the_journal_and_says_how_to_go_on(tmp_path: Path, monkeypatch) -> None:
    real, written = os.write, 0

    def write(descriptor: int, data: bytes) -> int:
        nonlocal written
        if written + len(data) > 100_000:  # a refused write takes no space
            raise OSError(28, os.strerror(28))
        written += len(data)
        return real(descriptor, data)

    monkeypatch.setattr(journal_module.files.os, "write", write)
    with pytest.raises(DiskFullError) as caught:
        record_long(radar(), PLAN, RecordingLimits(), tmp_path / "a.tagid.h5")
    monkeypatch.undo()
    assert "tagid recover" in caught.value.remedy
    assert read_any(tmp_path / "a.tagid.journal").views > 100
    assert not (tmp_path / "a.tagid.h5").exists()
