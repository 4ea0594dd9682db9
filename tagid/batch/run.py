"""A batch from its inputs to its report: items are distributed, and every result is stored when it arrives.

The run may be stopped or killed at any moment; results so far are kept and the next run continues from there.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tagid import files, interrupts
from tagid.batch.expected import Comparison, Expectations
from tagid.batch.inputs import Collected, Source
from tagid.batch.job import Job, Known
from tagid.batch.local import Runner, Task, Tasks
from tagid.batch.remembering import Remembering
from tagid.batch.spool import FILE_NAME, Spool
from tagid.batch.tally import SUMMARY_VERSION, Tally
from tagid.batch.watch import FolderWatch
from tagid.report.page import PageSettings, write_page
from tagid.report.records import ItemRecord, StoredItem
from tagid.report.tables import write_csv, write_json, write_jsonl, write_junit
from tagid.storage.history import utc_text

FILES = ("report.html", "items.csv", "items.jsonl", "junit.xml", "summary.json")
_PAGE_SHARE = 10
"""While a folder is watched, writing reports takes at most 1/this of the time."""


@dataclass(frozen=True)
class BatchPlan:
    """Inputs, outputs and rules of a batch run.

    Attributes:
        inputs: the captures that exist at the start.
        watch: a folder whose new captures are identified, too; None to end with the inputs.
        out: the report's folder.
        page: settings of the HTML page.
        expectations: the manifest, if any.
        resume: reuse earlier answers for the same contents and settings.
        fail_fast: stop at the first item that fails.
    """

    inputs: Collected
    out: Path
    watch: FolderWatch | None = None
    page: PageSettings = field(default_factory=PageSettings)
    expectations: Expectations | None = None
    resume: bool = False
    fail_fast: bool = False


@dataclass(frozen=True)
class Hooks:
    """Callbacks during a run.

    Attributes:
        progress: called with (finished, total, items per second of this run, remaining seconds or None).
        stopped: polled often; True ends the run with a report of the finished items.
        history: file of the history where answers are stored; None stores none.
        item: called with every record.
    """

    progress: Callable[[int, int, float, float | None], None] = lambda done, total, rate, remaining_s: None
    stopped: Callable[[], bool] = lambda: False
    history: Path | None = None
    item: Callable[[ItemRecord], None] = lambda record: None


@dataclass(frozen=True)
class Finished:
    """Result of a batch.

    Attributes:
        summary: content of summary.json.
        exit_code: of the command, also for a run that the user interrupted.
        reused: number of answers reused from an earlier run.
        remarks: what is not stored in the history, and why.
    """

    summary: dict[str, Any]
    exit_code: int
    interrupted: bool
    reused: int
    remarks: tuple[str, ...] = ()


def run_batch(plan: BatchPlan, job: Job, runner: Runner, hooks: Hooks | None = None) -> Finished:
    """Identify all inputs and write the report's files into `plan.out`.

    During the run, `items.jsonl` grows by one line per finished item; at the end all files are rewritten in
    the order of the inputs.

    Raises:
        StorageError: the folder cannot be created or written, or another report is being written there.
        DiskFullError: no space left; finished items are kept for `resume`.
    """
    hooks = hooks or Hooks()
    files.make_folder(plan.out)
    with Spool(plan.out / FILE_NAME, fresh=not plan.resume) as spool:
        return _Run(plan, job, spool, hooks).go(runner)


class GrowingLines:
    """A new, empty file to which whole lines are added, so that it may be read while it grows.

    Raises StorageError if it cannot be written, DiskFullError without space; it then ends with the line
    before.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor = files.open_in_place(path, os.O_APPEND | os.O_TRUNC)

    def reopen(self) -> None:
        """Append to the path again, after the file was closed and replaced."""
        self._descriptor = files.open_in_place(self._path, os.O_APPEND)

    def add(self, line: str) -> None:
        """Add a line, atomically."""
        with interrupts.deferred():
            end = os.fstat(self._descriptor).st_size
            try:
                files.write_all(self._descriptor, line.encode())
            except OSError as error:
                os.ftruncate(self._descriptor, end)
                raise files.storage_error(error, self._path, "adding a result") from error

    def close(self) -> None:
        """Close the file; it is kept."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


class _Run:
    def __init__(self, plan: BatchPlan, job: Job, spool: Spool, hooks: Hooks) -> None:
        self._plan, self._spool, self._hooks = plan, spool, hooks
        self._fingerprint = job.fingerprint()
        self._history = Remembering(hooks.history, job)
        if plan.resume:
            with closing(spool.answers()) as answers:
                self._history.reconcile(answers)
        self._job = replace(job, known=spool.take_over(self._fingerprint))
        self._sources: list[Source] = list(plan.inputs.sources)
        self._started = utc_text()
        self._clock = time.monotonic()
        self._reused = 0
        self._written = (0.0, 0.0)
        self._count_written = 0
        self._copies: dict[int, str] = {}

    def go(self, runner: Runner) -> Finished:
        interrupted = False
        done = 0
        lines = GrowingLines(self._plan.out / "items.jsonl")
        with closing(lines), closing(runner(self._tasks(), self._job)) as results:
            for result in results:
                if result is not None:
                    task, outcome = result.task, result.outcome
                    with interrupts.deferred():
                        record = self._spool.put(task.position, task.source.name, self._fingerprint, outcome)
                        lines.add(self._judged(record, task.position).to_json() + "\n")
                        if isinstance(outcome, Known):
                            self._reused += 1
                        else:
                            self._history.add(record)
                        done += 1
                    self._hooks.item(record)
                    self._tell(done)
                    if self._plan.fail_fast and record.status == "failed":
                        break
                elif self._plan.watch is not None and self._due(done):
                    with interrupts.deferred():
                        lines.close()
                        self._write(done, interrupted=False)
                        lines.reopen()
                if self._hooks.stopped():
                    interrupted = True
                    break
        if self._reused or not self._history.complete:  # an answer is reused for a copy, too
            with closing(self._spool.answers()) as answers:
                self._history.reconcile(answers)
        with interrupts.deferred():
            return self._write(done, interrupted)

    def _tasks(self) -> Tasks:
        watch = self._plan.watch
        # Made before the first input is read: one that changes while it is read comes again.
        arrivals = iter(()) if watch is None else watch.arrivals(self._sources)
        yield from (Task(position, source) for position, source in enumerate(list(self._sources)))
        positions = {source.location: position for position, source in enumerate(self._sources)}
        for source in arrivals:
            if source is None:
                yield None
                continue
            # A file that changed after its answer, e.g. one that was still being copied, keeps its position.
            position = positions.setdefault(source.location, len(self._sources))
            if position == len(self._sources):
                self._sources.append(source)
            yield Task(position, source)

    def _tell(self, done: int) -> None:
        fresh = done - self._reused
        seconds = time.monotonic() - self._clock
        rate = fresh / seconds if seconds > 0 else 0.0
        # A watched file that changed is processed twice.
        remaining_s = max(len(self._sources) - done, 0) / rate if rate > 0 else None
        self._hooks.progress(min(done, len(self._sources)), len(self._sources), rate, remaining_s)

    def _judged(self, record: ItemRecord, position: int) -> ItemRecord:
        """The record with its expected answer and, once all are written, the item that it copies."""
        expectations = self._plan.expectations.by_location if self._plan.expectations else {}
        expected = expectations.get(self._sources[position].location)
        return record.judged(expected, self._copies.get(position))

    def _items(self) -> Iterator[StoredItem]:
        for item in self._spool.items():
            yield replace(item, record=self._judged(item.record, item.position))

    def _records(self) -> Iterator[ItemRecord]:
        return (item.record for item in self._items())

    def _due(self, done: int) -> bool:
        """Whether a watched folder's report should be rewritten."""
        at, took = self._written
        return time.monotonic() - at > _PAGE_SHARE * took and done != self._count_written

    def _write(self, done: int, interrupted: bool) -> Finished:
        began = time.monotonic()
        self._copies = self._spool.copies()
        tally = Tally(comparison=Comparison() if self._plan.expectations else None)
        longest = []
        for record in self._records():
            tally.add(record)
            longest.append(record.total_s)
        summary = self._summary(tally, sorted(longest), done, interrupted)
        out = self._plan.out
        write_csv(out / "items.csv", self._records())
        write_jsonl(out / "items.jsonl", self._records())
        write_junit(out / "junit.xml", self._records(), summary)
        write_page(out / "report.html", self._items, self._spool.pictures, summary, self._plan.page)
        # The last file written proves that the others exist.
        write_json(out / "summary.json", summary)
        self._written = (time.monotonic(), time.monotonic() - began)
        self._count_written = done
        remarks = tuple(self._history.remarks())
        return Finished(summary, tally.exit_code(), interrupted, self._reused, remarks)

    def _summary(self, tally: Tally, seconds: list[float], done: int, interrupted: bool) -> dict[str, Any]:
        wall = time.monotonic() - self._clock
        fresh = done - self._reused
        inputs = self._plan.inputs
        return {
            "schema": "tagid.report.summary",
            "schema_version": SUMMARY_VERSION,
            "title": self._plan.page.title,
            "started_utc": self._started,
            "written_utc": utc_text(),
            "complete": tally.items == len(self._sources) and not interrupted,
            "interrupted": interrupted,
            "inputs": len(self._sources),
            **tally.to_dict(),
            "reused": self._reused,
            "seconds": {
                "wall_s": round(wall, 3),
                "items_s": round(tally.items_s, 3),
                "median_item_s": seconds[len(seconds) // 2] if seconds else None,
                "longest_item_s": seconds[-1] if seconds else None,
            },
            "items_per_s": round(fresh / wall, 4) if wall > 0 else None,
            "manifest": self._plan.expectations.path if self._plan.expectations else None,
            "passed_over": {"count": len(inputs.passed_over), "first": list(inputs.passed_over[:50])},
            "unreadable_folders": list(inputs.unreadable),
            "dangling_links": list(inputs.dangling),
            "settings": self._job.described(),
            "settings_sha256": self._fingerprint,
        }
