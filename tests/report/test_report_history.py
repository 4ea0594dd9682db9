"""The answers of reports in the history: each once, whatever happened in between."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from tagid.batch import remembering
from tagid.batch.run import Hooks
from tagid.storage.history import Filter, History


def names(history: Path) -> list[str]:
    return sorted(Path(entry.file).name for entry in History(history).find())


def test_what_a_killed_run_left_is_stored_by_the_next(make_report, captures: Path, tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    hooks = Hooks(history=path)
    assert make_report(captures, hooks=hooks).remarks == ()
    assert len(names(path)) == 5
    with sqlite3.connect(path) as connection:  # as if killed before the last ones were stored
        connection.execute("DELETE FROM identification WHERE id > 2")
    connection.close()
    (captures / "empty.tagid.h5").rename(captures / "renamed.tagid.h5")
    # Another run with other settings finds what the first one left, and keeps it under that one.
    assert make_report(captures / "renamed.tagid.h5", hooks=hooks, resume=True).remarks == ()
    assert len(names(path)) == 5 and "renamed.tagid.h5" not in names(path)
    assert make_report(captures, hooks=hooks, resume=True).remarks == ()
    # Failures that may pass are tried again; here, all answers were reused.
    assert len(names(path)) == 5
    with sqlite3.connect(path) as connection:
        assert connection.execute("SELECT COUNT(DISTINCT run_id) FROM identification").fetchone() == (1,)
    connection.close()


def test_a_locked_history_is_told_and_waited_for_once(
    make_report, captures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "history.sqlite"
    History(path)
    waits = []
    real = remembering.History

    def counted(path: Path, wait_s: float) -> History:
        waits.append(wait_s)
        return real(path, min(wait_s, 0.1))

    monkeypatch.setattr(remembering, "History", counted)
    holder = sqlite3.connect(path, isolation_level=None)
    holder.execute("BEGIN IMMEDIATE")
    (remark,) = make_report(captures, hooks=Hooks(history=path)).remarks
    assert remark.startswith("not stored in the history: 5 answers: cannot use the history")
    assert "--resume" in remark
    assert [wait for wait in waits if wait] == [remembering.BUSY_SECONDS]
    holder.close()
    assert make_report(captures, hooks=Hooks(history=path), resume=True).remarks == ()
    assert len(names(path)) == 5
    assert History(path).count(Filter(command="report", status="failed")) == 1
