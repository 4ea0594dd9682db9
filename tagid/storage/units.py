"""Units of files from other programs: degrees or millimetres where radians and metres are expected.

Such a file is valid, number by number, and fails much later for another reason. Only what cannot be in the
stated unit is refused.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.errors import FileFormatError
from tagid.signal import median

_TURN_DEG = (355.0, 365.0)
_EVEN = 0.5
"""Steps within this part of the median step are even; measured angles of a table jitter."""
_MOST_UNEVEN = 0.1
"""Share of the steps that may be uneven: scans are lost."""
_LEAST_STEP = 0.1
"""Smallest step taken for degrees: 3600 views of a turn."""
_SURE_STEP = 0.9
"""Steps that are degrees without a whole turn, too: in radians 7 views a turn, of which no image is made."""
_SURE_SPAN = 4 * np.pi
_COARSE = 10.0
"""Samples this many range resolutions apart cannot be scans: half a resolution is needed."""


def check_units(path: Path, capture: Capture) -> None:
    """Refuse angles that are degrees and ranges that are millimetres.

    Angles are degrees if steps of 0.1 or more, most of them about even, make up one turn of 360; in radians,
    these would be 57.3 turns of at most 63 views. Steps of 0.9 or more need no whole turn, only more than
    12.6 in all, two turns of 7 views in radians. Ranges are millimetres if their step exceeds ten range
    resolutions c / (2 bandwidth), and a thousandth of it does not exceed one.

    Raises:
        FileFormatError: naming the field and the conversion.
    """
    angles = capture.angles_rad
    if angles is not None and _degrees(angles):
        raise FileFormatError(
            f"{path}: angles_rad from {angles.min():g} to {angles.max():g} in steps of about "
            f"{_step(angles):.3g}: these are degrees",
            "Store radians: angles_rad = numpy.deg2rad(angles); if they are radians, wrap them to one turn.",
        )
    resolution = capture.wave_speed_m_s / (2 * capture.bandwidth_hz)
    step = capture.range_step_m
    if step > _COARSE * resolution and step / 1000 <= resolution:
        raise FileFormatError(
            f"{path}: range_step_m is {step:g}, but scans of this bandwidth need a sample every "
            f"{resolution / 2:.2g} m: these are millimetres",
            "Divide range_start_m, range_step_m and axis_distance_m by 1000; if they are metres, add "
            "bandwidth_hz.",
        )


def _step(angles: NDArray[np.float64]) -> float:
    return float(median(np.abs(np.diff(angles))))


def _degrees(angles: NDArray[np.float64]) -> bool:
    if len(angles) < 4:
        return False
    step, span = _step(angles), float(np.ptp(angles))
    if step >= _SURE_STEP and span > max(_SURE_SPAN, 2 * step):
        return True
    # Degrees wrapped to 360 have one step back over the whole turn.
    steps = (np.diff(angles) + 180.0) % 360.0 - 180.0
    way = float(np.sign(median(steps)))
    uneven = float((np.abs(way * steps - step) > _EVEN * step).mean())
    return step >= _LEAST_STEP and uneven <= _MOST_UNEVEN and _TURN_DEG[0] <= span + step <= _TURN_DEG[1]
