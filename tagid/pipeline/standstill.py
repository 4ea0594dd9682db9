"""Turns that stopped: the angle is held while the object stood, and the answer says where.

A free table is not monitored; a device that measures its angle may turn without the object.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tagid.angles.period import NOMINAL_TOLERANCE
from tagid.angles.standstill import Still, find_standstill
from tagid.capture import Capture
from tagid.errors import DataError
from tagid.metadata import ResolvedMotion, Standstill
from tagid.pipeline.resolve import clock_of
from tagid.reading.verdict import ADVICE, Code

if TYPE_CHECKING:
    from tagid.motion.device import Motion

_SCALES = 3.2
_LEAST_SCALE = 0.03
"""Tolerance of a measured angle: that many standard deviations of its scale, and no less than this."""
_ASSUMED_TURNS = 4.0
"""Without a speed: turns that a recording would hold which lasted until its time limit."""
_MOVED = 0.25
"""Without a speed: largest share of the recording before the stop. An object that turned would have shown
its other sides in the rest."""
REMEDY = ADVICE[Code.STOPPED]


class TurnStoppedError(DataError):
    """The object stopped before the scans showed how fast it turned."""

    code = "turn_stopped"


def held(capture: Capture, found: Capture, table: Motion) -> Capture | None:
    """The capture with its angle held where the object stood; None if the scans show no stop.

    Args:
        capture: as recorded.
        found: the same with angles, as if it had turned throughout.
        table: the motion of these angles: a stated speed, or measured.
    """
    resolved, angles = found.motion.resolved, found.angles_rad
    if resolved is None or angles is None or capture.views < 3:
        return None
    times = clock_of(capture).times_s
    if table.measures:
        turns = np.maximum.accumulate(np.abs(angles - angles[0])) / (2 * np.pi)
        tolerance = max(_LEAST_SCALE, _SCALES * (resolved.scale_sigma or 0.0))
    elif table.nominal_s is not None:
        turns, tolerance = (times - times[0]) / table.nominal_s, NOMINAL_TOLERANCE
    else:
        return None
    still = find_standstill(capture.samples, turns, tolerance)
    if still is None:
        return None
    moving = _moving(still, capture.views)
    if table.measures:
        first, stop = still.first, min(still.stop, capture.views - 1)
        kept = angles.copy()
        kept[still.first : still.stop] = angles[first]
        kept[still.stop :] -= angles[stop] - angles[first]
        sigma, info = found.angle_sigma_rad, resolved
    else:
        # Without the pause the scans may repeat after a turn, and then tell the period.
        on = times - times[0]
        on[still.stop :] -= times[min(still.stop, len(on) - 1)] - times[still.first]
        some = table.resolve(capture.samples[moving], on[moving])
        kept = np.full(capture.views, some.angles_rad[int(moving[: still.first].sum()) - 1])
        spread = np.full(capture.views, some.sigma_rad[-1])
        kept[moving], spread[moving] = some.angles_rad, some.sigma_rad
        sigma, info = spread, replace(some.info, scan_period_s=resolved.scan_period_s)
        info = replace(info, clock_residual_ms=resolved.clock_residual_ms)
    turned = np.abs(kept - kept[0]) / (2 * np.pi)
    info = replace(info, turns=float(turned.max()), standstill=standstill_facts(still, times, turned))
    motion = replace(found.motion, resolved=info)
    return replace(found, angles_rad=kept, angle_sigma_rad=sigma, motion=motion)


def stopped_error(capture: Capture) -> TurnStoppedError | None:
    """The error of a recording without a known speed whose object stopped; None if the scans show no stop."""
    try:
        times = clock_of(capture).times_s
    except DataError:
        return None
    if capture.views < 3:
        return None
    turns = _ASSUMED_TURNS * (times - times[0]) / (times[-1] - times[0])
    still = find_standstill(capture.samples, turns, 0.0)
    if still is None or still.stop < capture.views or still.first > _MOVED * capture.views:
        return None
    where = stopped_words(standstill_facts(still, times, None))
    return TurnStoppedError(f"{where}, and no turn was complete", REMEDY)


def stopped_words(found: Standstill) -> str:
    """Where an object stopped, in words without a full stop.

    >>> stopped_words(Standstill(185, 283, 468, 23.6, 183.2))
    'the turn stopped at about 183 degrees (scan 186 of 468)'
    >>> stopped_words(Standstill(185, 100, 468, 8.3, None, True))
    'the turn stopped (scan 186 of 468) and went on after 8.3 s'
    """
    where = "" if found.turned_deg is None else f" at about {found.turned_deg:.0f} degrees"
    after = f" and went on after {found.seconds:.1f} s" if found.goes_on else ""
    return f"the turn stopped{where} (scan {found.first_scan + 1} of {found.of_scans}){after}"


def without_standstill(capture: Capture) -> Capture:
    """The capture with one of the scans during a standstill, if these are still among its views."""
    resolved: ResolvedMotion | None = capture.motion.resolved
    found = None if resolved is None else resolved.standstill
    if found is None or capture.views != found.of_scans:
        return capture
    still = Still(found.first_scan, found.first_scan + found.scans)
    return capture.select(np.flatnonzero(_moving(still, capture.views)))


def _moving(still: Still, count: int) -> NDArray[np.bool_]:
    """(count,) True for the scans before and after a standstill, and for its first one."""
    moving = np.ones(count, dtype=bool)
    moving[still.first + 1 : still.stop] = False
    return moving


def standstill_facts(
    still: Still, times: NDArray[np.float64], turns: NDArray[np.float64] | None
) -> Standstill:
    """A standstill as it is stored.

    Args:
        still: its scans.
        times: (scans,) s.
        turns: (scans,) turns since the first scan; None where the speed is not known.
    """
    turned_deg = None if turns is None else 360 * float(turns[still.first])
    goes_on = still.stop < len(times)
    seconds = float(times[min(still.stop, len(times) - 1)] - times[still.first])
    return Standstill(still.first, still.stop - still.first, len(times), seconds, turned_deg, goes_on)
