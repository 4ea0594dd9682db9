"""The scans of a running recording in memory, for everything that reads them while it runs."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tagid.radar.assembler import Scan
    from tagid.recording.session import Session


class ScanStream:
    """The scans of one recording, in order; one thread appends, any number of threads read.

    A reader counts the scans that it has read: `while stream.wait(count)`, it takes `stream.since(count)`. It
    holds the lock only while it copies references, so that a slow one never delays the recording.

    Attributes:
        session: the recording.
        newest_s: when the newest scan was appended, s of `time.monotonic`; None before the first.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self.newest_s: float | None = None
        self._awaits_s: float | None = None
        self._scans: list[Scan] = []
        self._ended = False
        self._changed = threading.Condition()

    def __len__(self) -> int:
        return len(self._scans)

    @property
    def ended(self) -> bool:
        """Whether no further scan follows."""
        return self._ended

    def append(self, scan: Scan) -> None:
        """Add the next scan."""
        with self._changed:
            self._scans.append(scan)
            self.newest_s, self._awaits_s = time.monotonic(), None
            self._changed.notify_all()

    def await_next(self) -> None:
        """Report that the recording waits for its next scan, having dealt with the newest one."""
        self._awaits_s = time.monotonic()

    @property
    def silent_s(self) -> float:
        """Seconds for which the recording has waited for its next scan; 0 while it does not wait."""
        since = self._awaits_s
        return 0.0 if since is None or self._ended else time.monotonic() - since

    def end(self) -> None:
        """Report that no further scan follows; `record` does so however it ends."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def since(self, number: int = 0) -> list[Scan]:
        """The scans so far from this number on, counted from 0."""
        with self._changed:
            return self._scans[number:]

    def wait(self, number: int, timeout_s: float | None = None) -> bool:
        """Wait for scan `number`, counted from 0; False if the recording or the time ended before it."""
        with self._changed:
            self._changed.wait_for(lambda: self._ended or len(self._scans) > number, timeout_s)
            return len(self._scans) > number
