"""The answers of reports in the history: each once, whatever happened in between."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from report_batches import of_another_registry

from tagid.batch import remembering
from tagid.batch.job import Job
from tagid.batch.run import Hooks
from tagid.storage.history import Filter, History


def names(history: Path) -> list[str]:
    return sorted(Path(entry.file).name for entry in History(history).find())


def forget_the_last(history: Path) -> None:
    """As if the run had been killed before they were stored."""
    with closing(sqlite3.connect(history, isolation_level=None)) as connection:
        connection.execute("DELETE FROM identification WHERE id > 2")


def test_what_a_killed_run_left_is_stored_by_the_next(
    make_report, job: Job, captures: Path, tmp_path: Path
) -> None:
    path = tmp_path / "history.sqlite"
    hooks = Hooks(history=path)
    assert make_report(captures, hooks=hooks).remarks == ()
    assert len(names(path)) == 5
    forget_the_last(path)
    (captures / "empty.tagid.h5").rename(captures / "renamed.tagid.h5")
    assert make_report(captures / "renamed.tagid.h5", hooks=hooks, resume=True).reused == 1
    assert len(names(path)) == 6, "every answer once, and one more for the new name"
    forget_the_last(path)
    # Also a run with other settings finds them, and stores them under the run that made them.
    other = of_another_registry(job)
    assert make_report(captures / "bad.tagid.h5", hooks=hooks, job=other, resume=True).remarks == ()
    assert len(names(path)) == 7
    with closing(sqlite3.connect(path)) as connection:
        counts = connection.execute("SELECT run_id, COUNT(*) FROM identification GROUP BY 1").fetchall()
    assert counts == [(1, 6), (2, 1)]


def test_a_resumed_run_stores_copies_as_a_fresh_one_does(make_report, recorded: Path, tmp_path: Path) -> None:
    folder = tmp_path / "copies"
    folder.mkdir()
    copies = [f"{number}.tagid.h5" for number in range(4)]
    for name in copies:
        shutil.copy(recorded / "empty.tagid.h5", folder / name)
    for how in ("fresh", "resumed"):
        hooks = Hooks(history=tmp_path / f"{how}.sqlite")
        if how == "resumed":
            make_report(folder / copies[2], hooks=hooks)
        for _ in range(3):
            make_report(folder, hooks=hooks, resume=how == "resumed")
            if how == "fresh":
                break
        assert names(tmp_path / f"{how}.sqlite") == copies


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
    assert "`resume`" in remark
    assert [wait for wait in waits if wait] == [remembering.BUSY_SECONDS]
    holder.close()
    assert make_report(captures, hooks=Hooks(history=path), resume=True).remarks == ()
    assert len(names(path)) == 5
    assert History(path).count(Filter(command="report", status="failed")) == 1
