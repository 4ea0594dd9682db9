"""Reports over captures of the history, one at a time, each in a separate thread with a worker process."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from tagid.batch.inputs import Collected, Source
from tagid.batch.job import Job
from tagid.batch.local import run_local
from tagid.batch.run import FILES, BatchPlan, Hooks, run_batch
from tagid.errors import TagidError, UsageError
from tagid.operate.workplace import Workplace
from tagid.report.page import PageSettings
from tagid.station.background import BackgroundRun
from tagid.station.errors import BusyError, reported

MOST_CAPTURES = 200
_KEPT = 20
"""Reports that can be opened on the page; the folders of older ones stay on the disk."""
_PAGE_MEGABYTES = 8.0
"""Pictures of a report's page: a tablet opens it."""


class ReportRun(BackgroundRun):
    """A running or finished report in a new folder.

    Attributes:
        number: counts the station's reports.
        left_out: what the selection held in addition, and why it is left out; empty if nothing.
        total, done: number of captures, and of finished ones.
        error: why it failed; None if it did not.
        complete: whether all its files are written.
    """

    def __init__(self, number: int, folder: Path, captures: Sequence[Path], left_out: str, job: Job) -> None:
        self.number = number
        self.folder = folder
        self.left_out = left_out
        self.total = len(captures)
        self.done = 0
        self.error: TagidError | None = None
        self.complete = False
        self._captures = [str(path) for path in captures]
        self._job = job
        super().__init__(f"station-report-{number}")

    def _run(self) -> None:
        sources = tuple(Source(path, Path(path).name) for path in self._captures)
        page = PageSettings("Captures of the station", _PAGE_MEGABYTES, self.left_out)
        hooks = Hooks(self._progress, self._stop.is_set)
        plan = BatchPlan(Collected(sources), self.folder, page=page)
        run_batch(plan, self._job, partial(run_local, workers=1), hooks)
        self.complete = True

    def _fail(self, error: BaseException) -> None:
        self.error = reported(error)

    def _progress(self, done: int, total: int, rate: float, remaining_s: float | None) -> None:
        self.done = done


class Reports:
    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._runs: dict[int, ReportRun] = {}
        self._count = 0

    @property
    def newest(self) -> ReportRun | None:
        """The newest report; None before the first one."""
        return self._runs.get(self._count)

    def get(self, number: int) -> ReportRun | None:
        """A report by its number; None if there is none, or no longer."""
        return self._runs.get(number)

    def start(self, captures: Sequence[Path], left_out: str, place: Workplace) -> ReportRun:
        """Begin a report over captures; `left_out` as in `ReportRun`.

        Raises BusyError if one is running, UsageError if there are no captures or too many.
        """
        if not 1 <= len(captures) <= MOST_CAPTURES:
            raise UsageError(
                left_out or f"{len(captures)} captures are selected",
                f"Select 1 to {MOST_CAPTURES} scans of the station's folder.",
            )
        with self._lock:
            if self.newest is not None and self.newest.running:
                raise BusyError("a report is being written", "Wait for its end, or stop it.")
            number = self._count + 1
            job = Job.of(place.setup(as_recorded=True))
            run = ReportRun(number, _new_folder(place.folder()), captures, left_out, job)
            run.start()
            self._runs[number] = run
            self._count = number
            for old in [run for run in self._runs if run <= number - _KEPT]:
                del self._runs[old]
            return run

    def close(self, seconds: float) -> None:
        """Stop a running report, and wait for its end."""
        if self.newest is not None:
            self.newest.stop()
            self.newest.join(seconds)


def _new_folder(folder: Path) -> Path:
    """A path for a report, named after the second, that does not exist."""
    stem = time.strftime("report-%Y%m%d-%H%M%S")
    number, path = 1, folder / stem
    while path.exists():
        number += 1
        path = folder / f"{stem}-{number}"
    return path


MEDIA = {
    "report.html": "text/html; charset=utf-8",
    "items.csv": "text/csv; charset=utf-8",
    "items.jsonl": "application/x-ndjson",
    "junit.xml": "application/xml",
    "summary.json": "application/json",
}
"""Files of a report that can be requested, with their media types."""
assert set(MEDIA) == set(FILES)
