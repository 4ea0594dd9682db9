"""The answers of a report in the history, each once, also after a kill or while the history is locked."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby, islice
from operator import itemgetter
from pathlib import Path

from tagid.batch.job import Job
from tagid.counting import counted
from tagid.errors import TagidError
from tagid.report.records import ItemRecord
from tagid.storage.database import BUSY_SECONDS
from tagid.storage.history import History

COMMAND = "report"
_BATCH = 500


class Remembering:
    """Writes the answers of a batch into the history. Errors are kept for `remarks`: the report goes on.

    An answer that could not be stored stays in the report's working file; `reconcile` stores it later. Of
    all calls, only the first that finds the history locked waits for it. Without a path nothing is stored.
    """

    def __init__(self, path: Path | None, job: Job) -> None:
        self._path = path
        self._settings, self._fingerprint = job.described(), job.fingerprint()
        self._run: int | None = None
        self._patience_s = BUSY_SECONDS
        self._missed = self._foreign = 0
        self._error: TagidError | None = None

    def add(self, record: ItemRecord) -> None:
        """Store a new answer, without waiting for other processes."""
        if self._path is None:
            return
        try:
            history = History(self._path, wait_s=0)
            if self._run is None:
                self._run = history.begin(COMMAND, self._settings)
            history.add(self._run, [record.document])
        except TagidError as error:
            self._missed, self._error = self._missed + 1, error

    def reconcile(self, answers: Iterable[tuple[str, ItemRecord]]) -> None:
        """Store what the history lacks, under the run that made it.

        Args:
            answers: fingerprints of their settings and records, sorted by fingerprint.
        """
        if self._path is None:
            return
        wait_s, self._patience_s = self._patience_s, 0.0
        try:
            history = History(self._path, wait_s)
            for fingerprint, group in groupby(answers, itemgetter(0)):
                run = history.run_with(COMMAND, fingerprint)
                if run is None and fingerprint == self._fingerprint:
                    run = self._run = history.begin(COMMAND, self._settings)
                while some := [record.document for _, record in islice(group, _BATCH)]:
                    if run is None:
                        self._foreign += len(some)
                    else:
                        history.add(run, some, once=True)
        except TagidError as error:
            self._error = error
        else:
            self._missed, self._error, self._patience_s = 0, None, wait_s

    @property
    def complete(self) -> bool:
        """Whether everything that was given is stored."""
        return self._error is None

    def remarks(self) -> list[str]:
        """What is not stored, and why."""
        lines = []
        if self._error is not None:
            what = counted(self._missed, "answer") if self._missed else "answers of an earlier run"
            lines.append(
                f"not stored in the history: {what}: {self._error.message}. {self._error.remedy} "
                "Then add `resume`."
            )
        if self._foreign:
            lines.append(
                f"not stored in the history: {counted(self._foreign, 'answer')} of an earlier run, "
                "whose settings it does not hold"
            )
        return lines
