"""The period of a turn, found in the scans during the recording, if the speed of the table is not known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tagid.errors import DataError
from tagid.live.views import capture_so_far
from tagid.pipeline.turn import resolve_turn

if TYPE_CHECKING:
    from tagid.radar.assembler import Scan
    from tagid.recording.session import Session

_FEWEST = 40
_MOST = 1000
"""Maximum number of scans of a search; more are decimated. A search that finds a period takes 0.15 s then."""
_LONGER, _LONGER_KNOWN = 1.02, 1.25
"""Growth of the recording after which the period is searched again, before and after it is known."""
_ALIKE = 0.02
"""Largest relative difference of two successive periods that confirm each other, as in `FreeTurntable`."""


class GrowingSpeed:
    """Searches the scans so far for the period of a turn.

    The period is known once two successive searches agree: for a tag that looks the same after a third of a
    turn, after 0.4 turns, for others after 1.2. Which multiple of the shortest repetition is a turn is
    decided by imaging (`resolve_turn`), as for the stored capture.
    """

    def __init__(self) -> None:
        self._searched_s = 0.0
        self._last_s: float | None = None
        self._known = False

    def period_s(self, session: Session, scans: Sequence[Scan]) -> float | None:
        """A new estimate of the period, s; None if there is none or no search is due.

        Args:
            session: the recording.
            scans: all of its scans so far.
        """
        if len(scans) < _FEWEST:
            return None
        seconds = (scans[-1].radar_time_ms - scans[0].radar_time_ms) * 1e-3
        if seconds < self._searched_s * (_LONGER_KNOWN if self._known else _LONGER):
            return None
        self._searched_s = seconds
        some = scans[:: -(-len(scans) // _MOST)]
        stamps = np.array([scan.radar_time_ms for scan in some], dtype=np.float64)
        try:
            capture = replace(capture_so_far(session, some), radar_time_ms=stamps)
            resolved = resolve_turn(capture, session.plan.motion).motion.resolved
        except DataError:
            self._last_s = None
            return None
        last, self._last_s = self._last_s, None if resolved is None else resolved.period_s
        if last is None or self._last_s is None or abs(self._last_s - last) > _ALIKE * last:
            return None
        self._known = True
        return float(self._last_s)
