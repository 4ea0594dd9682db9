"""A recording when the plug is pulled, the disk is slow, or the disk is full; radar and files are real."""

from __future__ import annotations

import itertools
import json
import os
import resource
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from command_server import Ran
from radar_ends import numbered, pty, udp

from tagid.capture import ViewFlag
from tagid.errors import DiskFullError, StorageError, TagidError
from tagid.motion.urls import open_motion
from tagid.operate.words import notes
from tagid.radar.assembler import Scan
from tagid.radar.framing import Framing
from tagid.radar.settings import RadarConfig
from tagid.recording.intake import Intake
from tagid.recording.plan import RecordingPlan
from tagid.recording.radars import open_radar
from tagid.recording.recorder import Watch, record
from tagid.storage.importers import read_any
from tagid.storage.journal import JournalScan, JournalWriter, open_journal
from tagid.storage.journal_queue import JournalQueue
from tests.processes import TAGID
from tests.unit.storage_samples import read_journal

HEADER = {"range_start_m": 1.0, "range_step_m": 0.009}
FAST = RadarConfig(12_000, 17_000, base_integration_index=6)


@pytest.mark.parametrize("framing", list(Framing))
def test_a_recording_goes_on_after_the_plug_was_out_and_marks_the_gap(
    tmp_path: Path, framing: Framing
) -> None:
    with pty(framing, link=tmp_path / "radar", rate=1.0) as device:
        pulled = threading.Event()

        def progress(count: int, seconds: float) -> None:
            if not pulled.is_set():
                pulled.set()
                device.unplug()
                threading.Timer(0.2, device.plug).start()

        plan = RecordingPlan(FAST, 1.0, scans=1100)
        path = tmp_path / "x.tagid.h5"
        radar = open_radar(device.url, 0.5)
        capture = record(radar, open_motion("free?rpm=6"), plan, path, Watch(progress))
    assert pulled.is_set()
    assert capture.complete
    assert capture.radar.gap_count == 1
    (gap,) = capture.radar.gaps
    (at,) = np.flatnonzero(capture.flags & ViewFlag.AFTER_GAP)
    assert capture.flags[at] & ViewFlag.AFTER_LOSS
    assert gap.seconds >= 0.2 and not gap.restarted, "the radar kept its power and its clock"
    assert "disappeared" in gap.reason
    assert capture.scan_id[at - 1] == gap.after_scan
    assert capture.radar_time_ms[at] - capture.radar_time_ms[at - 1] == pytest.approx(
        gap.seconds * 1e3, abs=1
    )
    for k in (0, at - 1):
        np.testing.assert_array_equal(capture.samples[k], numbered(k, 96))
    for k in (at, capture.views - 1):
        np.testing.assert_array_equal(capture.samples[k], numbered(k - at, 96))
    assert "was lost once" in notes(capture.radar)[0]
    assert read_any(path).radar.gaps == capture.radar.gaps


def scan_of(index: int, samples: int = 1000) -> JournalScan:
    return JournalScan(index, index, float(index), 0, numbered(index, samples))


class SlowDisk:
    """A pipe in the journal's place: nothing is written unless it is read here."""

    def __init__(self, path: Path) -> None:
        os.mkfifo(path)
        self.path = path
        self.data = bytearray()
        self._open = threading.Event()
        self._go = threading.Event()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        with self.path.open("rb", buffering=0) as stream:
            self.data += stream.read(65_536)  # the journal's header
            self._open.set()
            self._go.wait(30)
            while chunk := stream.read(65_536):
                self.data += chunk

    def recover(self) -> None:
        """The disk is fast again."""
        self._go.set()

    def journal(self, path: Path) -> Path:
        self._thread.join(30)
        path.write_bytes(self.data)
        return path


def test_a_slow_disk_costs_counted_scans_and_never_memory(tmp_path: Path) -> None:
    """The disk stands still: the queue fills, then scans are dropped and counted; the rest is there."""
    with udp() as device, open_radar(device.url) as radar:
        radar.set_config(FAST)
        disk = SlowDisk(tmp_path / "pipe")
        with JournalWriter(disk.path, HEADER) as journal:
            with JournalQueue(journal, limit_bytes=200_000) as queue:
                intake = Intake(radar, queue)
                arrived: list[Scan] = []
                for scan in intake.scans(2000):
                    arrived.append(scan)
                    assert queue._bytes <= 200_000
                disk.recover()
            summary = intake.counted()
            journal.close({"radar": summary.to_json()})
    read = read_journal(disk.journal(tmp_path / "copy.tagid.journal"))
    assert summary.scans_lost == 0
    assert summary.scans_dropped == 2000 - len(read.scans) > 1000
    assert len(arrived) == len(read.scans) == intake.scans_taken > 200
    assert read.summary is not None
    assert read.summary["radar"]["scans_dropped"] == summary.scans_dropped
    ids = [scan.scan_id for scan in read.scans]
    assert ids == sorted(set(ids))
    first = radar.statistics.complete_scans - 2000 + ids[0]
    for scan in read.scans:
        np.testing.assert_array_equal(scan.samples, numbered(scan.scan_id - first, 96))
    assert any("disk was too slow" in note for note in notes(summary))


def test_a_disk_that_is_slow_for_a_moment_costs_nothing(tmp_path: Path) -> None:
    disk = SlowDisk(tmp_path / "pipe")
    with JournalWriter(disk.path, HEADER) as journal, JournalQueue(journal) as queue:
        for index in range(2000):
            assert queue.put(scan_of(index))
        disk.recover()
    read = read_journal(disk.journal(tmp_path / "copy.tagid.journal"))
    assert [scan.scan_id for scan in read.scans] == list(range(2000))
    assert queue.dropped == 0


def test_a_disk_that_fills_keeps_what_fits_and_says_so(tmp_path: Path) -> None:
    """The file may not grow beyond 100 kB: as many whole scans as fit are kept, batch or not."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    path = tmp_path / "x.tagid.journal"
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with (
            pytest.raises(DiskFullError, match="full"),
            JournalWriter(path, HEADER) as journal,
            JournalQueue(journal) as queue,
        ):
            for index in range(200):
                queue.put(scan_of(index))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    with open_journal(path) as stream:
        kept = [scan.scan_id for scan in stream.scans()]
        assert stream.bytes_dropped == 0
    assert kept == list(range(len(kept)))
    assert len(kept) == (100_000 - 200) // 4050
    assert journal.scans == len(kept)


def test_a_full_disk_in_the_middle_of_a_scan_is_one_clear_error_and_nothing_is_lost(
    tagid: Callable[..., Ran], home: dict[str, str], tmp_path: Path
) -> None:
    with udp() as device:
        done = subprocess.run(
            [*TAGID, "scan", "--radar", device.url, "--axis-distance", "1", "--save-dir", str(tmp_path),
             "--scans", "2000", "--output", "json"],
            capture_output=True, text=True, env=home, timeout=60,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000)),
        )  # fmt: skip
        assert not device.core.scanning
    assert "Traceback" not in done.stderr
    (error,) = json.loads(done.stdout)["errors"]
    (journal,) = tmp_path.glob("*.journal")
    assert (done.returncode, error["code"]) == (1, "disk_full")
    assert f"tagid recover {journal}" in error["remedy"]
    assert not list(tmp_path.glob("*.h5"))
    assert tagid("recover", journal).code == 0
    (capture,) = tmp_path.glob("*.h5")
    assert read_any(capture).views > 50


class _FailingJournal(JournalWriter):
    """A journal whose second write ends with an exception that no part of the program foresees."""

    writes = 0

    def append_all(self, scans: Sequence[JournalScan]) -> None:
        self.writes += 1
        if self.writes == 2:
            raise MemoryError
        super().append_all(scans)


def test_a_journal_thread_that_dies_accepts_nothing_more_and_counts_what_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "x.tagid.journal"
    with _FailingJournal(path, HEADER) as journal:
        queue = JournalQueue(journal)
        queue.put(scan_of(0))
        while journal.scans < 1:
            queue.check()
        accepted = 1
        with pytest.raises(StorageError, match="MemoryError") as refused:
            for index in range(1, 1_000_000):
                queue.put(scan_of(index))
                accepted += 1
        missing = "1 scan" if accepted == 2 else f"{accepted - 1} scans"
        assert f"{missing} that had arrived could not be written" in refused.value.message
        with pytest.raises(StorageError, match="MemoryError"):
            queue.put_motion({})
        with pytest.raises(StorageError, match="MemoryError"), queue:
            pass
    assert queue.accepted == accepted
    assert [scan.scan_id for scan in read_journal(path).scans] == [0]


def test_a_dead_journal_ends_a_recording_also_if_no_further_scan_arrives(tmp_path: Path) -> None:
    with udp(rate=1.0) as device, open_radar(device.url, 0.2) as radar:
        radar.set_config(FAST)
        with _FailingJournal(tmp_path / "x.tagid.journal", HEADER) as journal:
            journal.writes = 1
            queue = JournalQueue(journal)
            intake = Intake(radar, queue)
            with pytest.raises(StorageError, match="1 scan that had arrived"), queue:
                for _ in intake.scans(2, 300_000):
                    device._stop.set()
            assert intake.scans_taken == 1


def test_a_recording_whose_journal_dies_ends_with_an_error_and_keeps_the_journal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tagid.recording.session.JournalWriter", _FailingJournal)
    path = tmp_path / "x.tagid.h5"
    plan = RecordingPlan(FAST, 1.0, scans=60_000)
    with udp() as device, pytest.raises(StorageError, match="could not be written") as reported:
        record(open_radar(device.url), open_motion("free?rpm=6"), plan, path)
    journal = tmp_path / "x.tagid.journal"
    assert f"tagid recover {journal}" in reported.value.remedy
    assert not path.exists()
    assert len(read_journal(journal).scans) >= 1


def test_scans_that_were_accepted_and_never_written_are_an_error_whoever_lost_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The files are compared with what was accepted, not with what was written."""
    real, number = JournalWriter.append_all, itertools.count()
    monkeypatch.setattr(
        JournalWriter,
        "append_all",
        lambda self, scans: real(self, [scan for scan in scans if next(number) != 10]),
    )
    plan = RecordingPlan(FAST, 1.0, scans=100)
    with udp() as device, pytest.raises(StorageError, match="of the 100 recorded scans"):
        record(open_radar(device.url), open_motion("free?rpm=6"), plan, tmp_path / "x.tagid.h5")
    assert (tmp_path / "x.tagid.journal").exists()


def test_a_fault_of_the_program_during_a_recording_costs_no_scan(tmp_path: Path) -> None:
    def progress(count: int, seconds: float) -> None:
        raise ZeroDivisionError("division by zero")

    path = tmp_path / "x.tagid.h5"
    plan = RecordingPlan(FAST, 1.0, scans=60_000)
    with udp() as device, pytest.raises(TagidError, match="ZeroDivisionError") as reported:
        record(open_radar(device.url), open_motion("free?rpm=6"), plan, path, Watch(progress))
    assert str(path) in reported.value.remedy
    assert read_any(path).views > 0


def test_a_disk_that_stands_still_at_the_end_is_waited_for_only_so_long(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    with JournalWriter(pipe, HEADER) as journal:
        descriptor = journal._descriptor
        queue = JournalQueue(journal, stall_s=0.05)
        for index in range(100):
            queue.put(scan_of(index))
        with pytest.raises(StorageError, match=r"\d+ scans that had arrived may be lost"), queue:
            pass
    os.close(reader)
    assert queue._worker.join(10)
    os.close(descriptor)


def test_a_journal_without_a_thread_is_one_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with JournalWriter(tmp_path / "x.tagid.journal", HEADER) as journal:
        monkeypatch.setattr(threading.Thread, "start", refused)
        with pytest.raises(StorageError, match="can't start new thread"):
            JournalQueue(journal)


class _GatedJournal(JournalWriter):
    """A journal that writes one scan for each permit, and gives itself one whenever its size is asked."""

    def __init__(self, path: Path) -> None:
        self.permits, self.entered = threading.Semaphore(0), threading.Semaphore(0)
        super().__init__(path, HEADER)

    def append_all(self, scans: Sequence[JournalScan]) -> None:
        self.entered.release()
        for scan in scans:
            assert self.permits.acquire(timeout=30)
            super().append_all([scan])

    @property
    def size(self) -> int:
        before = self.scans
        self.permits.release()
        for _ in range(3000):
            if self.scans > before or before == 5:
                break
            time.sleep(0.001)
        return super().size


def test_a_disk_that_goes_on_writing_is_waited_for(tmp_path: Path) -> None:
    with _GatedJournal(tmp_path / "x.tagid.journal") as journal:
        with JournalQueue(journal, stall_s=0.02) as queue:
            for index in range(5):
                queue.put(scan_of(index))
        assert journal.scans == 5


def test_scans_that_are_being_written_count_as_memory_until_they_are(tmp_path: Path) -> None:
    with _GatedJournal(tmp_path / "x.tagid.journal") as journal:
        with JournalQueue(journal, limit_bytes=5 * (4000 + 512)) as queue:
            taken = [queue.put(scan_of(0))]
            assert journal.entered.acquire(timeout=30)
            taken += [queue.put(scan_of(index)) for index in range(1, 6)]
            journal.permits.release()
            assert journal.entered.acquire(timeout=30)
            taken += [queue.put(scan_of(index)) for index in range(6, 9)]
            for _ in range(5):
                journal.permits.release()
        assert taken == [True] * 5 + [False, True, False, False]
        assert (queue.dropped, journal.scans) == (3, 6)
