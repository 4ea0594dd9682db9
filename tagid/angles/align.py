"""Angles of scans from device readings: aligned on one time axis, and scaled by the period in the scans.

Before calibration, a robot's effective wheel base is known to a few per cent; the radar measures a full turn
to 0.1 %.

Scans and readings arrive with a positive delay, so each clock follows the lower envelope of its arrival
times (S. B. Moon, P. Skelly, D. Towsley, "Estimation and removal of clock skew from network delay
measurements", IEEE INFOCOM 1999).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tagid.angles.clock import UniformClock
from tagid.angles.period import NoPeriodError, PeriodEstimate, find_period
from tagid.angles.views import Angles
from tagid.errors import DataError
from tagid.metadata import ResolvedMotion, Track
from tagid.types import Floats

_WINDOW: Final = 33
"""Readings on each side that define the local lower envelope of the motion's arrival times."""
_MIN_SIGMA_S: Final = 1e-3
"""Rounding of radar and host timestamps to whole milliseconds."""
_UNEVEN: Final = 0.01
"""Relative speed change per turn of a free-running table."""
_GAP_S: Final = 0.1
"""Beyond the first or last reading by more than this, sigma marks the angle as unknown."""
_STEP_S: Final = 0.25
_MAX_DRIFT: Final = 1e-3
"""A change of the host's clock beyond this, s, plus this share of the duration is no drift of a crystal."""
TURN: Final = 2 * np.pi
_STEADY: Final = 0.7
"""Scans at less than this share of the usual speed (spinning up) are excluded from the search."""
_WIDEST: Final = 0.25
_DEFAULT_SCALE_SIGMA: Final = 0.01


class NotAlignedError(DataError):
    """The times at which scans and readings arrived do not tell which reading belongs to which scan."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """Angles of scans from a motion track.

    Attributes:
        angles_rad, sigma_rad: (scans,) of the scans, without the device's common scale error.
        drift: relative rate of the host clock against the radar clock.
        radar_residual_ms: RMS of the scans' arrival times after the clocks were aligned.
        motion_residual_ms: the same for the motion readings.
        clock_sigma_s: standard deviation of the time between radar and motion, up to a constant.
        outside: scans before the first or after the last reading.
    """

    angles_rad: Floats
    sigma_rad: Floats
    drift: float
    radar_residual_ms: float
    motion_residual_ms: float
    clock_sigma_s: float
    outside: int


def lower_edge(times_s: Floats, arrivals_s: Floats) -> tuple[float, float]:
    """(offset, slope) of the closest line below all arrivals.

    The sum of distances is smallest for the edge of the lower convex hull at the mean time.
    """
    if len(times_s) < 3 or np.ptp(times_s) <= 0:
        return float(np.min(arrivals_s - times_s)), 1.0
    hull: list[int] = []
    for i in range(len(times_s)):
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            cross = (times_s[b] - times_s[a]) * (arrivals_s[i] - arrivals_s[a]) - (
                arrivals_s[b] - arrivals_s[a]
            ) * (times_s[i] - times_s[a])
            if cross > 0:
                break
            hull.pop()
        hull.append(i)
    middle = float(np.mean(times_s))
    right = max(1, int(np.searchsorted(times_s[hull], middle)))
    a, b = hull[min(right, len(hull) - 1) - 1], hull[min(right, len(hull) - 1)]
    slope = float((arrivals_s[b] - arrivals_s[a]) / (times_s[b] - times_s[a]))
    return float(arrivals_s[a] - slope * times_s[a]), slope


def even_times(arrivals_s: Floats, step_s: float) -> Floats:
    """Times of uniformly paced readings, up to a constant: the local lower envelope of the arrivals.

    A delayed reading is moved to the time implied by its early neighbours; a lost one affects only half a
    second.
    """
    index = np.arange(len(arrivals_s)) * step_s
    late = arrivals_s - index
    padded = np.pad(late, _WINDOW, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _WINDOW + 1)
    return np.asarray(np.maximum.accumulate(index + windows.min(axis=1)))


def _refuse_step(times_s: Floats, arrivals_s: Floats) -> None:
    """Raises NotAlignedError if the earliest arrivals before and after a scan differ.

    The clock of this computer was set back where a scan seems to arrive before an earlier one. Scans that
    wait in a queue arrive late; if they do so to the end or from the start, a clock that was set looks alike.
    """
    late = arrivals_s - times_s
    before = np.minimum.accumulate(late)[:-1]
    after = np.minimum.accumulate(late[::-1])[::-1][1:]
    edge = len(late) // 10  # at the ends, a short stall of the network looks the same
    steps = (after - before)[edge : len(late) - edge]
    step = float(steps[np.argmax(np.abs(steps))]) if len(steps) else 0.0
    if abs(step) > _STEP_S + _MAX_DRIFT * (times_s[-1] - times_s[0]):
        why = f"scans arrived {abs(step):.1f} s late: this computer was busy, or its clock was set"
        if np.diff(arrivals_s).min() < -_STEP_S:
            why = f"this computer's clock was set by about {step:+.1f} s during the recording"
        raise NotAlignedError(
            f"{why}: the measured angles cannot be assigned to the scans",
            "Use the period from the scans: `motion.url=free`.",
        )


def align(clock: UniformClock, host_time_ns: NDArray[np.int64], track: Track) -> Alignment:
    """Angles of scans, of which the clock and the arrival times (scans,) are known, from a track of two
    readings or more.

    Raises DataError: no readings, or not one of them during the recording; NotAlignedError where scans
    arrived late throughout a part of the recording, or the host's clock was set meanwhile.
    """
    if len(track) < 2:
        raise DataError(
            f"the motion gave {len(track)} readings: the angles are unknown",
            "Use the period from the scans: `motion.url=free`.",
        )
    zero = int(host_time_ns[0])
    arrivals = np.asarray((host_time_ns - zero) * 1e-9, dtype=np.float64)
    _refuse_step(clock.times_s, arrivals)
    offset, slope = lower_edge(clock.times_s, arrivals)
    if abs(slope - 1) > 1e-2:
        # Larger than the drift of a crystal: the arrivals are too few or too noisy to measure it.
        offset, slope = float(np.min(arrivals - clock.times_s)), 1.0
    scan_times = offset + slope * clock.times_s
    heard = np.asarray((track.host_time_ns - zero) * 1e-9, dtype=np.float64)
    angles, spread = track.angles_rad, track.sigma_rad
    step = track.info.get("step_s")
    if isinstance(step, int | float) and step > 0:
        taken = even_times(heard, float(step))
    else:
        order = np.argsort(heard, kind="stable")
        heard, angles, spread = heard[order], angles[order], spread[order]
        taken = heard
    if scan_times[-1] < taken[0] or scan_times[0] > taken[-1]:
        raise DataError(
            "no scan was recorded between the first and last motion readings",
            "Check the clock of this computer.",
        )
    motion_residual = float(np.sqrt(np.mean((heard - taken) ** 2)))
    radar_residual = float(np.sqrt(np.mean((arrivals - scan_times) ** 2)))
    # An envelope from n arrivals with mean delay m is about m / n above the true one; that of the
    # motion is estimated every half second.
    lateness = float(np.mean(heard - taken))
    clock_sigma = float(np.hypot(_MIN_SIGMA_S, 3 * lateness / np.sqrt(_WINDOW)) + clock.sigma_s)
    if step is None:
        clock_sigma = max(clock_sigma, float(track.info.get("stamp_sigma_s") or 0.0))
    speed = np.abs(np.gradient(angles, taken)) if (np.diff(taken) > 0).all() else np.zeros(len(taken))
    fastest = float(np.percentile(speed, 95))
    beyond = np.maximum(np.maximum(taken[0] - scan_times, scan_times - taken[-1]), 0.0)
    at = np.interp(scan_times, taken, angles)
    if track.info.get("runs_on") and len(taken) > 2:
        # A free-running table also turns before the first reading and after the last.
        first = (angles[1] - angles[0]) / (taken[1] - taken[0])
        last = (angles[-1] - angles[-2]) / (taken[-1] - taken[-2])
        at += np.minimum(scan_times - taken[0], 0) * first + np.maximum(scan_times - taken[-1], 0) * last
        beyond = beyond * _UNEVEN
    outside = int(np.count_nonzero(beyond > _GAP_S))
    sigma = np.hypot(np.interp(scan_times, taken, spread), fastest * (clock_sigma + beyond))
    return Alignment(
        at,
        np.asarray(sigma),
        slope - 1,
        radar_residual * 1e3,
        motion_residual * 1e3,
        clock_sigma,
        outside,
    )


def turn_in_own_angle(
    samples: NDArray[Any], angles_rad: NDArray[np.floating], scale_sigma: float
) -> PeriodEstimate:
    """The device's angle of a full turn, and its sigma, rad, from the repetition of the scans over that
    angle.

    It is 2 pi for a correct scale. The search is over the device's angles (scans,), rad, instead of time and
    so independent of speed variations; `scale_sigma` is the relative standard deviation of their scale.

    Raises DataError: less than 1.1 turns, or no repetition near a full turn.
    """
    turned = np.abs(np.asarray(angles_rad, dtype=np.float64) - angles_rad[0])
    steps = np.diff(turned, prepend=turned[0])
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    moving = np.flatnonzero(steps >= _STEADY * usual)
    if usual <= 0 or len(moving) < 20:
        raise DataError("the object turned too little", "Record at least 1.1 turns.")
    inside = slice(moving[0], moving[-1] + 1)
    angle, seen = turned[inside], np.asarray(samples)[inside]
    rising = np.concatenate([[True], np.diff(np.maximum.accumulate(angle)) > 0.2 * usual])
    tolerance = float(np.clip(3.2 * scale_sigma, 0.03, _WIDEST))
    try:
        return find_period(seen[rising], angle[rising], TURN, tolerance=tolerance)
    except NoPeriodError as error:
        turns = float(np.ptp(angle)) / TURN
        raise DataError(
            f"the scans do not repeat within {turns:.2f} turns of the device", "Record at least 1.1 turns."
        ) from error


def measured_angles(
    samples: NDArray[Any], clock: UniformClock, host_time_ns: NDArray[np.int64], track: Track
) -> Angles:
    """Angle and sigma of every scan from readings, scaled by the radar's period if it is found; arguments and
    errors as `align`.
    """
    aligned = align(clock, host_time_ns, track)
    scale_sigma = float(track.info.get("scale_sigma", _DEFAULT_SCALE_SIGMA))
    scale = 1.0
    info: dict[str, Any] = {
        **track.info,
        "source": "measured",
        "clock_drift_ppm": aligned.drift * 1e6,
        "radar_arrival_residual_ms": aligned.radar_residual_ms,
        "motion_arrival_residual_ms": aligned.motion_residual_ms,
        "clock_sigma_ms": aligned.clock_sigma_s * 1e3,
        "scans_outside_motion": aligned.outside,
    }
    try:
        estimate = turn_in_own_angle(samples, aligned.angles_rad, scale_sigma)
    except DataError as error:
        info |= {"checked_by_radar": False, "reason": error.message}
    else:
        sigma = estimate.sigma_s / estimate.period_s
        info |= {
            "checked_by_radar": True,
            "radar_turn_in_own_rad": estimate.period_s,
            "radar_turn_sigma_rad": estimate.sigma_s,
            "quality": estimate.quality,
            "harmonic_ambiguous": estimate.harmonic_ambiguous,
        }
        if sigma < scale_sigma:
            scale, scale_sigma = TURN / estimate.period_s, sigma
    since = aligned.angles_rad - aligned.angles_rad[0]
    angles = scale * since
    spread = np.hypot(scale * aligned.sigma_rad, scale_sigma * np.abs(angles))
    turns = float(np.abs(angles).max() / TURN)
    seconds = float(clock.times_s[-1] - clock.times_s[0])
    info |= {"scale": scale, "scale_sigma": scale_sigma, "turns": turns}
    info["period_s"] = seconds / turns if turns > 0 else None
    return Angles(angles, np.asarray(spread, dtype=np.float64), ResolvedMotion.from_json(info))
