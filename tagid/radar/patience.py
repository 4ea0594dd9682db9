"""Timeouts of a run: for a packet, for a complete scan, and between stop checks."""

from __future__ import annotations

import time
from typing import Final

STOP_POLL_S: Final = 0.1
"""Longest interval between two calls that check whether to stop, s."""
AWAY_S: Final = 0.5
"""A pass of the receive loop that takes longer means that this process was suspended or got no CPU, s."""


class Patience:
    """How long a run waits for any fragment and, while fragments arrive, for a complete scan.

    Time in which this process did not run does not count: packets that arrived wait in the receive buffer.

    Args:
        quiet_s: time without a fragment after which the radar is considered silent, s.
        whole_s: time without a complete scan after which the run is aborted although fragments arrive, s.

    Attributes:
        fragments: packets since the last complete scan.
        whole_scans: number of complete scans when the timeout was last restarted.
    """

    def __init__(self, quiet_s: float, whole_s: float) -> None:
        self.quiet_s, self.whole_s = quiet_s, whole_s
        self.fragments = self.whole_scans = 0
        self._now = self._asked = time.monotonic()
        self._quiet_at = self._now + quiet_s
        self._whole_at = self._now + whole_s

    def tick(self) -> bool:
        """Record the time for the checks below; return whether to check for a stop now."""
        before, self._now = self._now, time.monotonic()
        away = self._now - before
        if away > AWAY_S:
            self._quiet_at += away
            self._whole_at += away
        due = self._now >= self._asked + STOP_POLL_S
        if due:
            self._asked = self._now
        return due

    def wait_s(self) -> float:
        """How long to wait for the next packet, s."""
        return max(min(self._quiet_at, self._whole_at, self._asked + STOP_POLL_S) - self._now, 0.0)

    def heard(self) -> None:
        """Note that a fragment arrived."""
        self._quiet_at = time.monotonic() + self.quiet_s

    def renew(self, whole_scans: int) -> None:
        """Note that a complete scan arrived and the caller has processed it."""
        self.whole_scans, self.fragments = whole_scans, 0
        self._now = time.monotonic()
        self._quiet_at = self._now + self.quiet_s
        self._whole_at = self._now + self.whole_s

    def silent(self) -> bool:
        """Whether no fragment arrived for too long."""
        return self._now >= self._quiet_at

    def fruitless(self) -> bool:
        """Whether fragments arrived for too long without forming a complete scan."""
        return self._now >= self._whole_at
