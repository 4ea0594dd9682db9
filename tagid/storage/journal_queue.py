"""A bounded queue before the journal, so that a disk that is slow for a moment does not cost a scan.

The radar sends whether the disk is ready or not. Scans wait here in bounded memory; what does not fit is
dropped and counted, never silently.
"""

from __future__ import annotations

import threading
from collections import deque
from types import TracebackType
from typing import Any, Final, Self

from tagid import interrupts
from tagid.errors import TagidError
from tagid.storage.journal import JournalScan, JournalWriter

QUEUE_BYTES: Final = 64 << 20
"""Samples that may wait: 40 s at the radar's highest data rate of 1.5 MB/s."""

_PER_SCAN: Final = 512
"""What a waiting scan takes beside its samples, bytes, roughly."""
_BATCH: Final = 256


class JournalQueue:
    """Hands scans to a journal on a thread of its own; a context manager whose end waits for all of them.

    Args:
        writer: the journal; it stays the caller's to close, after this.
        limit_bytes: memory that waiting scans may take.

    Attributes:
        dropped: scans that found the queue full.
    """

    def __init__(self, writer: JournalWriter, limit_bytes: int = QUEUE_BYTES) -> None:
        self.dropped = 0
        self._writer = writer
        self._limit = limit_bytes
        self._waiting: deque[JournalScan] = deque()
        self._readings: deque[dict[str, Any]] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._ending = False
        self._busy = False
        self._error: TagidError | None = None
        self._thread = threading.Thread(target=self._work, name="journal", daemon=True)
        self._thread.start()

    def put(self, scan: JournalScan) -> bool:
        """Adds a scan; False where it was dropped because the disk is too slow.

        Raises DiskFullError, StorageError or DataError where writing an earlier scan failed.
        """
        size = scan.samples.nbytes + _PER_SCAN
        with self._changed:
            self._raise_failure()
            if self._bytes + size > self._limit:
                self.dropped += 1
                return False
            self._waiting.append(scan)
            self._bytes += size
            if not self._busy:
                self._changed.notify_all()
        return True

    def put_motion(self, readings: dict[str, Any]) -> None:
        """Adds readings of the motion, see `JournalWriter.append_motion`; never dropped. Raises as `put`."""
        with self._changed:
            self._raise_failure()
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
            self._thread.join()
        if error is None:
            self._raise_failure()

    def _raise_failure(self) -> None:
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                while not self._waiting and not self._readings and not self._ending:
                    self._changed.wait()
                if not self._waiting and not self._readings:
                    return
                readings = list(self._readings)
                self._readings.clear()
                batch = [self._waiting.popleft() for _ in range(min(len(self._waiting), _BATCH))]
                self._busy = True
            try:
                self._writer.append_all(batch)
                for reading in readings:
                    self._writer.append_motion(reading)
            except TagidError as error:
                with self._changed:
                    self._error = error
                    self.dropped += len(self._waiting)
                    self._waiting.clear()
                    self._busy = False
                    self._changed.notify_all()
                return
            with self._changed:
                self._bytes -= sum(scan.samples.nbytes + _PER_SCAN for scan in batch)


def drop_note(dropped: int) -> str:
    """What to tell a user of scans that the disk was too slow for."""
    return f"{dropped} scans were dropped because the disk was too slow: record to a faster one"
