"""From a recording without angles to one revolution of views with angles, as required by imaging.

It combines clock, motion device and decimation of views; live scans and files use the same code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tagid.angles.period import NOMINAL_TOLERANCE
from tagid.angles.standstill import Still, find_standstill
from tagid.angles.views import average_into_views, first_turn
from tagid.capture import Capture
from tagid.errors import DataError
from tagid.metadata import ResolvedMotion, Standstill
from tagid.reading.verdict import ADVICE, Code

if TYPE_CHECKING:
    from tagid.angles.clock import UniformClock
    from tagid.motion.device import Motion

_FEWEST_A_TURN = 6
"""Views a turn of which no image is made."""


def clock_of(capture: Capture) -> UniformClock:
    """The clock of a capture: from the radar's timestamps if any, else from the host's arrival times.

    Raises:
        DataError: neither is known, or they do not advance.
    """
    from tagid.angles.clock import fit_clock

    if capture.radar_time_ms is not None:
        return fit_clock(capture.radar_time_ms, capture.scan_id)
    if capture.host_time_ns is not None:
        # Relative to the first scan, because nanoseconds since the epoch do not fit a float64.
        return fit_clock((capture.host_time_ns - capture.host_time_ns[0]) * 1e-6, capture.scan_id)
    raise DataError(
        "the capture holds neither angles nor the times of its scans",
        "Import it with angles_rad, timestamps_s or antenna_positions_m.",
    )


def with_angles(capture: Capture, motion: str | None = None) -> Capture:
    """The capture with an angle and its sigma for every scan.

    Without the URL of a motion device the capture keeps its angles or antenna positions, or else the period
    is estimated from the data. Measuring devices use the angles of the recording.

    Raises UsageError: invalid URL. DataError: no times, or no period in the data and no speed given.
    """
    known = has_angles(capture)
    if motion is None and known:
        return capture
    from tagid.angles.align import measured_angles
    from tagid.motion.urls import open_motion

    device = open_motion(motion or "free")
    track = capture.motion.track
    if device.measures and track is None and known:
        return capture
    clock = clock_of(capture)
    if track is not None and capture.host_time_ns is not None and (motion is None or device.measures):
        angles = measured_angles(capture.samples, clock, capture.host_time_ns, track)
        motion = motion or capture.motion.url
    else:
        if device.measures and capture.motion.not_resolved:
            raise DataError(
                f"the measured angles were not assigned to the scans: {capture.motion.not_resolved}",
                "Use the period from the scans: `motion.url=free`.",
            )
        if device.nominal_s is not None and clock.period_s > device.nominal_s / _FEWEST_A_TURN:
            raise DataError(
                f"the scans are {clock.period_s:.3g} s apart, and a turn takes {device.nominal_s:.3g} s",
                "Check the speed, and the unit of the times: timestamps_s is in seconds.",
            )
        angles = device.resolve(capture.samples, clock.times_s, clock.sigma_s)
    info = replace(angles.info, scan_period_s=clock.period_s, clock_residual_ms=clock.residual_ms)
    return replace(
        capture,
        angles_rad=angles.angles_rad,
        angle_sigma_rad=angles.sigma_rad,
        antenna_positions_m=None,
        receive_positions_m=None,
        motion=capture.motion.without_track(url=motion or "free", resolved=info),
    )


def has_angles(capture: Capture) -> bool:
    """Whether a capture knows where the antenna was in each view."""
    return capture.angles_rad is not None or capture.antenna_positions_m is not None


def with_measured_angles(capture: Capture) -> Capture:
    """A recovered capture with the angles measured by its motion device, if any; else unchanged."""
    if capture.motion.track is None:
        return capture
    try:
        return with_angles(capture)
    except DataError as error:
        return replace(capture, motion=capture.motion.without_track(not_resolved=error.message))


def speed_contradiction(resolved: ResolvedMotion | None) -> str:
    """One sentence with what the scans show if they contradict the stated speed; otherwise "".

    >>> speed_contradiction(ResolvedMotion(nominal_rpm=6.0, measured_rpm=10.02))
    'the stated speed of 6 rpm (10.0 s per turn) is not that of the scans: they show 10 rpm (6.0 s per turn)'
    >>> speed_contradiction(ResolvedMotion(nominal_rpm=6.0, likely_rpms=(20.0, 10.0)))[70:]
    'they show 20 or 10 rpm (3.0 or 6.0 s per turn): the object repeats within a turn, so that several fit'
    >>> speed_contradiction(ResolvedMotion(nominal_rpm=12.0, repeats=False))
    'the scans do not repeat after the stated 5.0 s'
    """
    if resolved is None or not resolved.nominal_rpm:
        return ""
    if not resolved.shown_rpms:
        stated_s = 60 / resolved.nominal_rpm
        return (
            f"the scans do not repeat after the stated {stated_s:.1f} s" if resolved.repeats is False else ""
        )
    stated, shown = resolved.nominal_rpm, resolved.shown_rpms
    words = (
        f"the stated speed of {stated:.3g} rpm ({60 / stated:.1f} s per turn) is not that of the scans: "
        f"they show {one_of([f'{rpm:.3g}' for rpm in shown])} rpm "
        f"({one_of([f'{60 / rpm:.1f}' for rpm in shown])} s per turn)"
    )
    return words + (": the object repeats within a turn, so that several fit" if len(shown) > 1 else "")


def one_of(words: Sequence[str]) -> str:
    """Alternatives in words.

    >>> one_of(["3", "4", "6"])
    '3, 4 or 6'
    """
    return " or ".join(filter(None, (", ".join(words[:-1]), words[-1])))


def one_turn(capture: Capture, max_views: int) -> Capture:
    """At most `max_views` views, evenly spaced over one turn.

    Denser scans are averaged into views, which lowers the noise; otherwise the scans of the first turn are
    kept. A capture with free antenna positions is only decimated.
    """
    if capture.angles_rad is None:
        every = -(-capture.views // max_views)
        return capture if every == 1 else capture.select(slice(None, None, every))
    inside = first_turn(capture.angles_rad)
    if not len(inside):
        raise DataError(
            "no views lie within one turn",
            "Check the angles, or the unit of the times: timestamps_s is in seconds.",
        )
    if len(inside) > max_views:
        return average_into_views(capture, max_views)
    return capture if len(inside) == capture.views else capture.select(inside)


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


def held(capture: Capture, resolved_capture: Capture, table: Motion) -> Capture | None:
    """The capture as recorded, with its angle held where the object stood; None if the scans show no stop.

    `resolved_capture` is the same with the angles of `table`, a stated speed or measured, as if it had turned
    throughout.
    """
    resolved, angles = resolved_capture.motion.resolved, resolved_capture.angles_rad
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
        sigma, info = resolved_capture.angle_sigma_rad, resolved
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
    motion = replace(resolved_capture.motion, resolved=info)
    return replace(resolved_capture, angles_rad=kept, angle_sigma_rad=sigma, motion=motion)


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


def stopped_words(standstill: Standstill) -> str:
    """Where an object stopped, in words without a full stop.

    >>> stopped_words(Standstill(185, 283, 468, 23.6, 183.2))
    'the turn stopped at about 183 degrees (scan 186 of 468)'
    >>> stopped_words(Standstill(185, 100, 468, 8.3, None, True))
    'the turn stopped (scan 186 of 468) and went on after 8.3 s'
    """
    where = "" if standstill.turned_deg is None else f" at about {standstill.turned_deg:.0f} degrees"
    after = f" and went on after {standstill.seconds:.1f} s" if standstill.goes_on else ""
    return f"the turn stopped{where} (scan {standstill.first_scan + 1} of {standstill.of_scans}){after}"


def without_standstill(capture: Capture) -> Capture:
    """The capture with one of the scans during a standstill, if these are still among its views."""
    resolved: ResolvedMotion | None = capture.motion.resolved
    standstill = None if resolved is None else resolved.standstill
    if standstill is None or capture.views != standstill.of_scans:
        return capture
    still = Still(standstill.first_scan, standstill.first_scan + standstill.scans)
    return capture.select(np.flatnonzero(_moving(still, capture.views)))


def _moving(still: Still, count: int) -> NDArray[np.bool_]:
    """(count,) True for the scans before and after a standstill, and for its first one."""
    moving = np.ones(count, dtype=bool)
    moving[still.first + 1 : still.stop] = False
    return moving


def standstill_facts(
    still: Still, times: NDArray[np.float64], turns: NDArray[np.float64] | None
) -> Standstill:
    """A standstill as it is stored, from the (scans,) times, s, and turns, None without a speed."""
    turned_deg = None if turns is None else 360 * float(turns[still.first])
    goes_on = still.stop < len(times)
    seconds = float(times[min(still.stop, len(times) - 1)] - times[still.first])
    return Standstill(still.first, still.stop - still.first, len(times), seconds, turned_deg, goes_on)
