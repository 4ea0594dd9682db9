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
from tagid.errors import TagidError
from tagid.storage.journal import JournalScan, JournalWriter

QUEUE_BYTES: Final = 64 << 20
"""Limit for waiting samples, bytes: 40 s at the radar's highest data rate of 1.5 MB/s."""

_PER_SCAN: Final = 512
"""Approximate memory of a waiting scan besides its samples, bytes."""
_BATCH: Final = 256


class JournalQueue:
    """Writes scans to a journal on its own thread; a context manager whose exit waits for all of them.

    Args:
        writer: the journal; the caller closes it afterwards.
        limit_bytes: memory limit for waiting scans.

    Attributes:
        dropped: number of scans dropped because the queue was full.
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
        """Add a scan; False if it was dropped because the disk is too slow.

        Raises DiskFullError, StorageError or DataError if writing an earlier scan failed.
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
        """Add motion readings, see `JournalWriter.append_motion`; never dropped. Raises as `put`."""
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
                idle = False
                while not (self._waiting or self._readings or self._ending or idle):
                    # Scans that come slowly, or no more, are not to wait for the next one to be synced.
                    idle = not self._changed.wait(self._writer.seconds_to_sync())
                if self._ending and not self._waiting and not self._readings:
                    return
                readings = list(self._readings)
                self._readings.clear()
                batch = [self._waiting.popleft() for _ in range(min(len(self._waiting), _BATCH))]
                self._busy = True
            try:
                if batch:
                    self._writer.append_all(batch)
                for reading in readings:
                    self._writer.append_motion(reading)
                if not batch and not readings:
                    self._writer.sync()
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
    """The message about scans that were dropped because of a slow disk."""
    return f"{dropped} scans were dropped because the disk was too slow: record to a faster disk"
