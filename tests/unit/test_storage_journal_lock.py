"""A journal says that it is being recorded, from its creation until its capture is written."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tagid.batch.inputs import collect, is_recording
from tagid.errors import DataError
from tagid.recording import session
from tagid.recording.long_recording import RecordingLimits, RecordingWatch, record_long
from tagid.recording.plan import RecordingPlan
from tagid.recording.radars import open_radar
from tagid.storage.journal import JournalWriter, being_recorded

HEADER = {"range_start_m": 1.0, "range_step_m": 0.009}


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
    assert process.stdout is not None and process.stdin is not None
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
