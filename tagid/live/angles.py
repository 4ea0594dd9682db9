"""The angle of each scan during the recording, as far as known.

They are for display; the stored capture gets its angles from the whole recording (`tagid.pipeline.resolve`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tagid.angles.align import align
from tagid.angles.clock import fit_clock
from tagid.angles.period import MIN_TURNS, NOMINAL_TOLERANCE
from tagid.angles.standstill import LEAST_TURNS, Still, find_standstill
from tagid.errors import DataError
from tagid.live.views import capture_so_far
from tagid.metadata import Track
from tagid.motion.device import Motion
from tagid.pipeline.resolve import standstill_facts, stopped_words
from tagid.pipeline.turn import resolve_turn
from tagid.radar.assembler import Scan

if TYPE_CHECKING:
    from tagid.recording.session import Session

_FEWEST_FITTED = 8
_FEWEST_SEARCHED = 40
"""Scans from which on a period is searched."""
_SEARCHED_TURNS = MIN_TURNS + 0.02
"""Turns at the nominal speed after which the period is estimated."""
_LOOK_S, _LOOK_SHARE = 1.0, 0.05
"""Least time between two searches for a standstill, s, and their largest share of the time."""
_MOST_SEARCHED = 1000
"""Maximum number of scans of a search and of the alignment; more are decimated. A search that finds a period
takes 0.15 s then."""


class LiveAngles:
    """Angles of the scans so far: measured, from the nominal speed, or from the period in the scans.

    Attributes:
        stopped: where the object stopped, in words, if the scans show it at a nominal speed; else empty.
    """

    def __init__(self, motion: Motion) -> None:
        self._motion = motion
        self._period_s = motion.nominal_s
        self._from_data = False
        self._tried = False
        self._still: Still | None = None
        self._next_look_s = 0.0
        self.stopped = ""

    def learn(self, period_s: float) -> None:
        """Use a period that was found in the scans, s per turn."""
        self._period_s, self._from_data = period_s, True

    def of(self, scans: Sequence[Scan]) -> NDArray[np.float64] | None:
        """(scans,) angle relative to the first scan, rad; None while unknown."""
        if not scans:
            return None
        if self._motion.measures:
            return _measured(scans, self._motion.track())
        times = _times_s(scans)
        self._search(scans, times)
        if self._period_s is None:
            return None
        turns = times / self._period_s
        if self._motion.nominal_s is not None:
            self._look_for_a_stop(scans, times, turns)
        if self._still is not None:
            last = min(self._still.stop, len(turns) - 1)
            stood = turns[last] - turns[self._still.first]
            turns[self._still.stop :] -= stood
            turns[self._still.first : self._still.stop] = turns[self._still.first]
        return np.asarray(self._motion.direction * 2 * math.pi * turns)

    def _look_for_a_stop(
        self, scans: Sequence[Scan], times: NDArray[np.float64], turns: NDArray[np.float64]
    ) -> None:
        """Look for a standstill, from time to time, within a small share of the time."""
        now = time.monotonic()
        if now < self._next_look_s or turns[-1] < LEAST_TURNS:
            return
        every = -(-len(scans) // _MOST_SEARCHED)
        samples = np.stack([scan.samples for scan in scans[::every]])
        still = find_standstill(samples, turns[::every], NOMINAL_TOLERANCE)
        self._next_look_s = time.monotonic() + max(_LOOK_S, (time.monotonic() - now) / _LOOK_SHARE)
        if still is not None:
            last = still.stop == len(samples)
            still = Still(still.first * every, len(scans) if last else still.stop * every)
        self._still = still
        self.stopped = "" if still is None else stopped_words(standstill_facts(still, times, turns))

    def _search(self, scans: Sequence[Scan], times: NDArray[np.float64]) -> None:
        """Correct a nominal speed once the scans cover more than one turn.

        Without nominal speed the repetition may be a fraction of a turn, which only imaging can resolve; the
        recording does that, see `learn`.
        """
        nominal = self._motion.nominal_s
        if nominal is None or self._from_data or self._tried or len(scans) < _FEWEST_SEARCHED:
            return
        if float(times[-1]) < _SEARCHED_TURNS * nominal:
            return
        self._tried = True
        every = -(-len(scans) // _MOST_SEARCHED)
        samples = np.stack([scan.samples for scan in scans[::every]])
        try:
            resolved = self._motion.resolve(samples, times[::every]).info
        except DataError:
            return
        if resolved.source == "data" and resolved.period_s:
            self.learn(resolved.period_s)


def _measured(scans: Sequence[Scan], track: Track | None) -> NDArray[np.float64] | None:
    """(scans,) angle relative to the first scan by the device's readings, rad; None while there are too few.

    Scans and readings arrive late on a busy computer, so both clocks are aligned as for the stored capture.
    """
    if track is None or len(scans) < _FEWEST_FITTED:
        return None
    try:
        clock = fit_clock(*_stamps(scans))
        last = len(scans) - 1
        some = np.unique(np.append(np.arange(0, last, -(-len(scans) // _MOST_SEARCHED)), last))
        arrived = np.array([scans[number].host_time_ns for number in some], dtype=np.int64)
        times = clock.times_s[some]
        aligned = align(replace(clock, times_s=times, index=clock.index[some]), arrived, track)
    except DataError:
        return None
    angles = np.interp(clock.times_s, times, aligned.angles_rad)
    return np.asarray(angles - angles[0])


def _stamps(scans: Sequence[Scan]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """(scans,) radar time, ms, and number of each scan."""
    stamps = np.array([scan.radar_time_ms for scan in scans], dtype=np.float64)
    return stamps, np.array([scan.scan_id for scan in scans], dtype=np.int64)


def _times_s(scans: Sequence[Scan]) -> NDArray[np.float64]:
    """(scans,) seconds since the first scan, by the radar's clock."""
    stamps, numbers = _stamps(scans)
    if len(scans) >= _FEWEST_FITTED:
        try:
            return fit_clock(stamps, numbers).times_s
        except DataError:
            pass
    return np.asarray((stamps - stamps[0]) * 1e-3)


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
        """A new estimate of the period from all scans so far, s; None without one, or if no search is due."""
        if len(scans) < _FEWEST_SEARCHED:
            return None
        seconds = (scans[-1].radar_time_ms - scans[0].radar_time_ms) * 1e-3
        if seconds < self._searched_s * (_LONGER_KNOWN if self._known else _LONGER):
            return None
        self._searched_s = seconds
        some = scans[:: -(-len(scans) // _MOST_SEARCHED)]
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
