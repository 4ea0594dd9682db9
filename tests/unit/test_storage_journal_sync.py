"""The journal's durability policy, stated in the calls that implement it, and its mark while it is recorded.

A journal's name and header are on disk before the first scan is taken. Everything that was written is there
after every `sync_every` records, but not more often than every `sync_seconds`, and at the end. It says that
it is being recorded, from its creation until its capture is written.
"""

from __future__ import annotations

import errno
import os
import stat
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tagid import files, interrupts
from tagid.batch.inputs import collect, is_recording
from tagid.errors import DataError, DiskFullError, StorageError
from tagid.recording import session
from tagid.recording.long_recording import RecordingLimits, RecordingWatch, record_long
from tagid.recording.plan import RecordingPlan
from tagid.recording.radars import open_radar
from tagid.storage import journal as journal_module
from tagid.storage.journal import JournalScan, JournalWriter, being_recorded
from tagid.storage.journal_queue import JournalQueue
from tests.unit.storage_samples import read_journal

HEADER = {"range_start_m": 0.0, "range_step_m": 0.01}
SAMPLES = np.arange(4, dtype=np.int32)


class Syncs:
    """Every `os.fsync`: what was synced, and how large it was then. The real call is made, too."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.seen: list[tuple[str, int]] = []
        self._real = os.fsync
        monkeypatch.setattr(os, "fsync", self._sync)

    def _sync(self, descriptor: int) -> None:
        assert interrupts._state.depth, "a stop signal may interrupt the sync"
        facts = os.fstat(descriptor)
        self.seen.append(("folder", 0) if stat.S_ISDIR(facts.st_mode) else ("file", facts.st_size))
        self._real(descriptor)

    def take(self) -> list[tuple[str, int]]:
        """What came since the last call."""
        seen, self.seen = self.seen, []
        return seen


@pytest.fixture
def syncs(monkeypatch: pytest.MonkeyPatch) -> Syncs:
    return Syncs(monkeypatch)


def append(journal: JournalWriter, count: int, at_once: bool = False) -> None:
    first = journal.scans
    scans = [JournalScan(first + i, 0, 0.0, 0, SAMPLES) for i in range(count)]
    for batch in [scans] if at_once else [[scan] for scan in scans]:
        journal.append_all(batch)


def test_header_and_name_come_first_then_fifty_records_at_most_and_the_end_however_it_comes(
    tmp_path: Path, syncs: Syncs
) -> None:
    with pytest.raises(RuntimeError, match="fault"), JournalWriter(tmp_path / "j", HEADER) as journal:
        assert journal.size > 12
        assert syncs.take() == [("file", journal.size), ("folder", 0)]
        append(journal, 49)
        assert syncs.take() == []
        append(journal, 1)
        assert syncs.take() == [("file", journal.size)]
        append(journal, 2)
        assert syncs.take() == []
        raise RuntimeError("fault")
    assert syncs.take() == [("file", (tmp_path / "j").stat().st_size)]
    assert read_journal(tmp_path / "j").summary is None


def test_every_so_many_records_are_synced_with_all_before_them(tmp_path: Path, syncs: Syncs) -> None:
    with JournalWriter(tmp_path / "j", HEADER, sync_every=3) as journal:
        syncs.take()
        for count in range(1, 10):
            append(journal, 1)
            assert syncs.take() == ([("file", journal.size)] if count % 3 == 0 else []), count
        append(journal, 2)
        append(journal, 5, at_once=True)  # 7 since the last: one sync for all of them
        assert syncs.take() == [("file", journal.size)]
        append(journal, 2)
        assert syncs.take() == []  # counted again from the last sync


def test_without_a_number_only_the_end_is_synced(tmp_path: Path, syncs: Syncs) -> None:
    with JournalWriter(tmp_path / "j", HEADER, sync_every=0) as journal:
        syncs.take()
        append(journal, 60)
        assert syncs.take() == []
        journal.close({"turns": 1})
        assert syncs.take() == [("file", (tmp_path / "j").stat().st_size)]
    assert syncs.take() == []  # it is closed already


def test_syncs_are_at_least_so_many_seconds_apart_and_the_time_until_the_next_is_told(
    tmp_path: Path, syncs: Syncs, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr(journal_module, "time", SimpleNamespace(monotonic=lambda: now))
    with JournalWriter(tmp_path / "j", HEADER, sync_every=1, sync_seconds=2.0) as journal:
        syncs.take()
        assert journal.seconds_to_sync() is None  # nothing waits
        seen = []
        for at in (100.0, 101.0, 101.9, 102.0, 103.9, 104.1):
            now = at
            append(journal, 1)
            seen.append((len(syncs.take()), journal.seconds_to_sync()))
        counts, waits = zip(*seen, strict=True)
        assert counts == (1, 0, 0, 1, 0, 1)
        assert waits == (None, pytest.approx(1.0), pytest.approx(0.1), None, pytest.approx(0.1), None)
        now = 104.5
        append(journal, 1)
        now = 108.0
        assert journal.seconds_to_sync() == 0.0
        journal.sync()
        assert syncs.take() == [("file", journal.size)]
        assert journal.seconds_to_sync() is None
        append(journal, 1)
        assert journal.seconds_to_sync() == pytest.approx(2.0)  # from the sync that was asked for
    assert journal.seconds_to_sync() is None  # closed
    with JournalWriter(tmp_path / "k", HEADER, sync_every=0) as journal:
        append(journal, 1)
        assert journal.seconds_to_sync() is None  # left to the operating system


def test_a_failing_sync_is_said_with_its_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk may report a fault of earlier writes at the sync only."""

    def broken(descriptor: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    with JournalWriter(tmp_path / "j", HEADER, sync_every=2) as journal:
        append(journal, 1)
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", broken)
            with pytest.raises(StorageError, match="syncing the journal") as caught:
                append(journal, 1)
            assert str(tmp_path / "j") in caught.value.message
    with pytest.raises(StorageError, match="syncing"), JournalWriter(tmp_path / "k", HEADER) as journal:
        monkeypatch.setattr(os, "fsync", broken)
    # What is already being raised is not replaced by the sync's own error.
    monkeypatch.undo()
    with pytest.raises(RuntimeError, match="first"), JournalWriter(tmp_path / "l", HEADER) as journal:
        monkeypatch.setattr(os, "fsync", broken)
        raise RuntimeError("first")


def test_a_journal_that_cannot_be_begun_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(folder: Path) -> None:
        raise OSError(errno.EIO, "Input/output error")

    before = len(list(Path("/proc/self/fd").iterdir()))
    monkeypatch.setattr(files, "sync_folder", broken)
    with pytest.raises(OSError, match="Input/output"):
        JournalWriter(tmp_path / "j", HEADER)
    assert list(tmp_path.iterdir()) == []
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_records_that_still_fit_are_kept_where_the_batch_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk with room for 2.5 records: the third is removed again, and the first two are counted."""
    with JournalWriter(tmp_path / "j", HEADER) as journal:
        append(journal, 1)
        start = journal.size
        record = 16 + 32 + SAMPLES.nbytes
        room = start + int(2.5 * record)
        real = os.write

        def write(descriptor: int, data: memoryview) -> int:
            free = room - os.fstat(descriptor).st_size
            if free <= 0:
                raise OSError(errno.ENOSPC, "No space left on device")
            return real(descriptor, data[:free])

        with monkeypatch.context() as patch:
            patch.setattr(os, "write", write)
            with pytest.raises(DiskFullError):
                append(journal, 4, at_once=True)
        assert (journal.scans, journal.size) == (3, start + 2 * record)
        assert (tmp_path / "j").stat().st_size == journal.size
    journal_read = read_journal(tmp_path / "j")
    assert [scan.scan_id for scan in journal_read.scans] == [0, 1, 2]
    assert journal_read.bytes_dropped == 0


def test_the_last_scan_does_not_wait_for_another_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced = threading.Event()
    real = os.fsync

    def sync(descriptor: int) -> None:
        real(descriptor)
        if started:
            synced.set()

    started = False
    monkeypatch.setattr(os, "fsync", sync)
    with JournalWriter(tmp_path / "j", HEADER, sync_every=1, sync_seconds=0.1) as journal:
        append(journal, 1)
        started = True
        with JournalQueue(journal) as queue:
            queue.put(JournalScan(1, 0, 0.0, 0, SAMPLES))
            assert synced.wait(60), "the radar fell silent, and its last scans were never synced"
            assert journal.seconds_to_sync() is None


def test_readings_of_the_motion_count_as_records(tmp_path: Path, syncs: Syncs) -> None:
    readings = {"host_time_ns": [1], "angle_rad": [0.5], "sigma_rad": [0.1], "info": {"kind": "turntable"}}
    with JournalWriter(tmp_path / "j", HEADER, sync_every=3) as journal:
        syncs.take()
        append(journal, 2)
        journal.append_motion(readings)
        assert syncs.take() == [("file", journal.size)]
        journal.append_motion({**readings, "host_time_ns": [2], "info": {}})
    read = read_journal(tmp_path / "j")
    times, angles, sigmas = [1, 2], [0.5, 0.5], [0.1, 0.1]
    assert read.motion == {"host_time_ns": times, "angle_rad": angles, "sigma_rad": sigmas, "info": {}}
    assert len(read.scans) == 2


def test_a_recording_is_left_out_until_its_capture_is_verified(
    tmp_path: Path, tagid, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, journal = tmp_path / "a.tagid.h5", tmp_path / "a.tagid.journal"
    (tmp_path / "other.tagid.journal").write_bytes(b"of an earlier recording that was killed")
    seen: list[bool] = []
    original = session.check_all_read

    def look(where: Path, read: int, written: int) -> None:
        seen.append(being_recorded(where))
        original(where, read, written)

    monkeypatch.setattr(session, "check_all_read", look)
    refused: list[tuple[int, str]] = []

    def progress(state: object) -> None:
        if refused or not journal.exists():
            return
        result = collect([str(tmp_path)])
        assert [Path(source.location).name for source in result.sources] == ["other.tagid.journal"]
        assert result.being_recorded == (str(journal),) and not result.passed_over
        ran = tagid("recover", journal)
        refused.append((ran.code, ran.err))

    plan = RecordingPlan(None, 1.0)
    limits, watch = RecordingLimits(scans=300), RecordingWatch(progress)
    record_long(open_radar("emulator://helmet-120"), plan, limits, path, watch)
    assert refused and refused[0][0] == 1 and "still being recorded" in refused[0][1]
    assert seen == [True], "the capture is compared with a journal that nobody else may take"
    assert path.exists() and not journal.exists()


def test_the_mark_ends_with_the_process_however_it_ends(tmp_path: Path) -> None:
    journal = tmp_path / "killed.tagid.journal"
    code = (
        "import sys; from pathlib import Path; from tagid.storage.journal import JournalWriter\n"
        f"kept = JournalWriter(Path({str(journal)!r}), {HEADER!r})\n"
        "print('recording', flush=True); sys.stdin.read()\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"recording\n"
    assert being_recorded(journal) and not is_recording(journal)
    with pytest.raises(DataError, match="still being recorded"):
        collect([str(tmp_path)])
    process.kill()
    process.wait()
    process.stdin.close()
    process.stdout.close()
    assert not being_recorded(journal) and is_recording(journal)


def test_what_is_no_journal_is_not_being_recorded(tmp_path: Path) -> None:
    assert not being_recorded(tmp_path / "absent")
    assert not being_recorded(tmp_path)
    with JournalWriter(tmp_path / "a.tagid.journal", HEADER) as writer:
        with writer.locked():
            writer.close()
            assert being_recorded(writer.path)
        assert not being_recorded(writer.path)
