"""From a recording without angles to one revolution of views with angles, as required by imaging.

It combines clock, motion device and decimation of views; live scans and files use the same code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from tagid.angles.views import average_into_views, select_views
from tagid.capture import Capture
from tagid.errors import DataError
from tagid.metadata import ResolvedMotion

if TYPE_CHECKING:
    from tagid.angles.clock import UniformClock


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

    Args:
        capture: any capture.
        motion: URL of the motion device. None keeps the angles or antenna positions of the capture, or else
            estimates the period from the data. Measuring devices use the angles of the recording.

    Raises:
        UsageError: invalid URL. DataError: no times, or no period in the data and no speed given.
    """
    known = has_angles(capture)
    if motion is None and known:
        return capture
    from tagid.angles.measured import measured_angles
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
        if device.nominal_s is not None:
            _check_speed(clock.period_s, device.nominal_s)
        angles = device.resolve(capture.samples, clock.times_s, clock.sigma_s)
    found = replace(angles.info, scan_period_s=clock.period_s, clock_residual_ms=clock.residual_ms)
    return replace(
        capture,
        angles_rad=angles.angles_rad,
        angle_sigma_rad=angles.sigma_rad,
        antenna_positions_m=None,
        receive_positions_m=None,
        motion=capture.motion.without_track(url=motion or "free", resolved=found),
    )


def _check_speed(period_s: float, nominal_s: float) -> None:
    """Raise DataError if a turn would have no views."""
    if period_s <= nominal_s / _FEWEST_A_TURN:
        return
    raise DataError(
        f"the scans are {period_s:.3g} s apart, and a turn takes {nominal_s:.3g} s",
        "Check the speed, and the unit of the times: timestamps_s is in seconds.",
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
    told = (
        f"the stated speed of {stated:.3g} rpm ({60 / stated:.1f} s per turn) is not that of the scans: "
        f"they show {one_of([f'{rpm:.3g}' for rpm in shown])} rpm "
        f"({one_of([f'{60 / rpm:.1f}' for rpm in shown])} s per turn)"
    )
    return told + (": the object repeats within a turn, so that several fit" if len(shown) > 1 else "")


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
    inside = select_views(capture.angles_rad)
    if not len(inside):
        raise DataError(
            "no views lie within one turn",
            "Check the angles, or the unit of the times: timestamps_s is in seconds.",
        )
    if len(inside) > max_views:
        return average_into_views(capture, max_views)
    return capture if len(inside) == capture.views else capture.select(inside)
