"""Faults of single items: each costs itself, and the others keep their answers (test_report_cluster, too)."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path
from typing import Any

import pytest
from report_batches import in_this_process, records_of

from tagid.batch import work as work_module
from tagid.batch.inputs import collect
from tagid.batch.job import Job
from tagid.batch.run import BatchPlan, Hooks, run_batch
from tagid.batch.watch import FolderWatch


def test_any_exception_is_its_items_failure_with_type_and_place(
    make_report,
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    real = work_module.read
    faults = {"a.tagid.h5": RuntimeError("boom"), "b.tagid.h5": UnicodeEncodeError("utf-8", "x", 0, 1, "y")}

    def read(setup: Any, path: Path, *rest: Any) -> Any:
        if path.name in faults:
            raise faults[path.name]
        return real(setup, path, *rest)

    monkeypatch.setattr(work_module, "read", read)
    folder = tmp_path / "captures"
    folder.mkdir()
    for name in (*faults, "good.tagid.h5"):
        shutil.copy(recorded / "helmet-120.tagid.h5", folder / name)
    with caplog.at_level(logging.WARNING, "tagid"):
        make_report(folder)
    result = records_of(tmp_path / "report")
    assert result["good.tagid.h5"]["layout"] == "helmet-120"
    for name, error in faults.items():
        assert result[name]["status"] == "failed"
        assert type(error).__name__ in result[name]["error"]["message"]
        (line,) = [record.getMessage() for record in caplog.records if name in record.getMessage()]
        assert type(error).__name__ in line and f"{Path(__file__).name}:" in line


def test_a_watched_file_that_failed_and_came_again_has_one_entry(
    job: Job, recorded: Path, tmp_path: Path
) -> None:
    folder, out = tmp_path / "drop", tmp_path / "report"
    folder.mkdir()
    arrived = folder / "late.tagid.h5"
    arrived.write_bytes(b"\x89HDF\r\n\x1a\n, and the rest is still being copied")
    finished = 0

    def progress(done: int, of: int, rate: float, remaining: float | None) -> None:
        nonlocal finished
        finished += 1
        if finished == 1:
            shutil.copy(recorded / "helmet-120.tagid.h5", arrived)

    plan = BatchPlan(collect([str(arrived)]), out, FolderWatch(folder, interval_s=0.0, idle_stop_s=30.0))
    summary = run_batch(plan, job, in_this_process, Hooks(progress, lambda: finished == 2)).summary
    assert (summary["items"], summary["by_status"]["identified"]) == (1, 1)
    (record,) = records_of(out).values()
    assert record["layout"] == "helmet-120" and record["error"] is None
    assert (out / "items.csv").read_text().count("late.tagid.h5") == 1
