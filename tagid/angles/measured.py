"""Angles of a capture from device readings, scaled by the period found in the scans.

Before calibration, a robot's effective wheel base is known to a few per cent; the radar measures a full turn
to 0.1 %.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tagid.angles.align import align
from tagid.angles.clock import UniformClock
from tagid.angles.period import NoPeriodError, PeriodEstimate, find_period
from tagid.angles.views import Angles
from tagid.errors import DataError
from tagid.metadata import ResolvedMotion, Track

TURN: Final = 2 * np.pi
_STEADY: Final = 0.7
"""Scans at less than this share of the usual speed (spinning up) are excluded from the search."""
_WIDEST: Final = 0.25
_DEFAULT_SCALE_SIGMA: Final = 0.01


def turn_in_own_angle(
    samples: NDArray[Any], angles_rad: NDArray[np.floating], scale_sigma: float
) -> PeriodEstimate:
    """The device's angle of a full turn, from the repetition of the scans over that angle.

    The search is over angle instead of time and so independent of speed variations.

    Args:
        samples: (scans, bins).
        angles_rad: (scans,) from the device, rad.
        scale_sigma: relative standard deviation of the device's scale.

    Returns:
        the period and its sigma in the device's radians: 2 pi for a correct scale.

    Raises:
        DataError: less than 1.1 turns, or no repetition near a full turn.
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
    """Angle and sigma of every scan from readings, scaled by the radar's period if it is found.

    Args:
        samples: (scans, bins).
        clock: clock of the scans.
        host_time_ns: (scans,) arrival times.
        track: motion readings.

    Raises:
        DataError: see `align`.
    """
    aligned = align(clock, host_time_ns, track)
    scale_sigma = float(track.info.get("scale_sigma", _DEFAULT_SCALE_SIGMA))
    scale = 1.0
    info: dict[str, Any] = {**track.info, "source": "measured", **aligned.facts()}
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
