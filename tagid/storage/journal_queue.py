"""A bounded queue before the journal, so that a temporarily slow disk loses no scan.

The radar sends at its own pace. Scans wait here in bounded memory; those that do not fit are dropped and
counted, never silently.
"""

from __future__ import annotations

import threading
from collections import deque
from types import TracebackType
from typing import Any, Final, Self

from tagid import interrupts
from tagid.counting import counted
from tagid.errors import StorageError, TagidError
from tagid.storage.journal import JournalScan, JournalWriter
from tagid.workers import Worker

QUEUE_BYTES: Final = 64 << 20
"""Limit for waiting samples, bytes: 40 s at the radar's highest data rate of 1.5 MB/s."""

_PER_SCAN: Final = 512
"""Approximate memory of a waiting scan besides its samples, bytes."""
_BATCH: Final = 256
_STALL_S: Final = 60.0
"""Longest wait at the end for a disk that writes nothing, s; hard disks wake within 30 s."""


class JournalQueue:
    """Writes scans to a journal, which the caller closes, on its own thread.

    It is a context manager whose exit waits for all of them, or `stall_s` for a disk that writes nothing.
    Whatever ends that thread is an error of the recording: from then on every method raises it, with the
    number of accepted scans that were not written.

    Attributes:
        accepted: number of scans in the journal or waiting for it.
        dropped: number of scans dropped because the queue was full.

    Raises StorageError if the thread cannot be started.
    """

    def __init__(
        self, journal: JournalWriter, limit_bytes: int = QUEUE_BYTES, stall_s: float = _STALL_S
    ) -> None:
        self.accepted = journal.scans
        self.dropped = 0
        self.journal = journal
        self._limit = limit_bytes
        self._stall_s = stall_s
        self._waiting: deque[JournalScan] = deque()
        self._readings: deque[dict[str, Any]] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._ending = False
        self._busy = False
        self._worker = Worker(self._work, "journal")
        try:
            self._worker.start()
        except RuntimeError as error:
            raise StorageError(
                f"{journal.path}: the journal cannot be written: {error}",
                "Free memory, or raise the limit of processes and threads, then record again.",
            ) from error

    def put(self, scan: JournalScan) -> bool:
        """Add a scan; False if it was dropped because the disk is too slow.

        Raises DiskFullError, StorageError or DataError if writing an earlier scan failed.
        """
        size = scan.samples.nbytes + _PER_SCAN
        with self._changed:
            self.check()
            if self._bytes + size > self._limit:
                self.dropped += 1
                return False
            self._waiting.append(scan)
            self.accepted += 1
            self._bytes += size
            if not self._busy:
                self._changed.notify_all()
        return True

    def put_motion(self, readings: dict[str, Any]) -> None:
        """Add motion readings, see `JournalWriter.append_motion`; never dropped. Raises as `put`."""
        with self._changed:
            self.check()
            self._readings.append(readings)
            if not self._busy:
                self._changed.notify_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with interrupts.deferred():
            with self._changed:
                self._ending = True
                self._changed.notify_all()
            self._wait_for_the_disk()
        if error is None:
            self.check()

    def check(self) -> None:
        """Raise DiskFullError, StorageError or DataError if the scans are no longer written."""
        failure = self._worker.failure
        if failure is None:
            return
        missing = self.accepted - self.journal.scans
        lost = f"; {counted(missing, 'scan')} that had arrived could not be written" if missing else ""
        if isinstance(failure, TagidError):
            raise type(failure)(f"{failure.message}{lost}", failure.remedy) from failure
        why = f"{type(failure).__name__}: {failure}".removesuffix(": ")
        raise StorageError(
            f"{self.journal.path}: writing the journal failed ({why}){lost}",
            "Check the memory of this computer, then record again.",
        ) from failure

    def _wait_for_the_disk(self) -> None:
        """Wait until everything is written. Raises StorageError if nothing is for too long."""
        size = -1
        while not self._worker.join(self._stall_s):
            if self.journal.size == size:
                self.journal.abandon()
                missing = counted(self.accepted - self.journal.scans, "scan")
                raise StorageError(
                    f"{self.journal.path}: the disk has written nothing for {self._stall_s:g} s; "
                    f"{missing} that had arrived may be lost",
                    "Check the disk and its connection.",
                )
            size = self.journal.size

    def _work(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                idle = False
                while not (self._waiting or self._readings or self._ending or idle):
                    # If scans arrive slowly or stop, sync without waiting for the next one.
                    idle = not self._changed.wait(self.journal.seconds_to_sync())
                if self._ending and not self._waiting and not self._readings:
                    return
                readings = list(self._readings)
                self._readings.clear()
                batch = [self._waiting.popleft() for _ in range(min(len(self._waiting), _BATCH))]
                self._busy = True
            if batch:
                self.journal.append_all(batch)
            for reading in readings:
                self.journal.append_motion(reading)
            if not batch and not readings:
                self.journal.sync()
            with self._changed:
                self._bytes -= sum(scan.samples.nbytes + _PER_SCAN for scan in batch)


def drop_note(dropped: int) -> str:
    """The message about scans that were dropped because of a slow disk."""
    return f"{dropped} scans were dropped because the disk was too slow: record to a faster disk"
