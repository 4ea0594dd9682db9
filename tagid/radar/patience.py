"""How long a run waits for a packet, for a whole scan, and until it asks its caller whether to stop."""

from __future__ import annotations

import time
from typing import Final

STOP_POLL_S: Final = 0.1
"""Longest time between two questions to the caller whether to stop, s."""
AWAY_S: Final = 0.5
"""A pass of the receiving loop that takes longer means that this process was stopped or got no CPU, s."""


class Patience:
    """How long a run waits: for any fragment, and, while fragments come, for a whole scan.

    Time in which this process did not run does not count: what came meanwhile waits in the receive buffer.

    Args:
        quiet_s: time without a fragment after which the radar counts as silent, s.
        whole_s: time without a whole scan after which the run is given up although fragments come, s.

    Attributes:
        fragments: packets since the last whole scan.
        whole_scans: whole scans when the time was last renewed.
    """

    def __init__(self, quiet_s: float, whole_s: float) -> None:
        self.quiet_s, self.whole_s = quiet_s, whole_s
        self.fragments = self.whole_scans = 0
        self._now = self._asked = time.monotonic()
        self._quiet_at = self._now + quiet_s
        self._whole_at = self._now + whole_s

    def tick(self) -> bool:
        """Takes the time for the checks below; whether the caller is to be asked whether to stop."""
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
        """A fragment came."""
        self._quiet_at = time.monotonic() + self.quiet_s

    def renew(self, whole_scans: int) -> None:
        """A whole scan came, and the caller has taken it."""
        self.whole_scans, self.fragments = whole_scans, 0
        self._now = time.monotonic()
        self._quiet_at = self._now + self.quiet_s
        self._whole_at = self._now + self.whole_s

    def silent(self) -> bool:
        """Whether no fragment came for too long."""
        return self._now >= self._quiet_at

    def fruitless(self) -> bool:
        """Whether fragments came for too long without making a whole scan."""
        return self._now >= self._whole_at
