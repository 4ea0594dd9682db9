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
_EVEN = 0.1
_LEAST_STEP = 0.1
"""Smallest step taken for degrees: 3600 views of a turn."""
_COARSE = 10.0
"""Samples this many range resolutions apart cannot be scans: half a resolution is needed."""


def check_units(path: Path, capture: Capture) -> None:
    """Refuse angles that are degrees and ranges that are millimetres.

    Angles are degrees if their even steps of 0.1 or more make up one turn of 360; in radians, these would be
    57.3 turns of at most 63 views. Ranges are millimetres if their step exceeds ten range resolutions
    c / (2 bandwidth), and a thousandth of it does not exceed one.

    Raises:
        FileFormatError: naming the field and the conversion.
    """
    angles = capture.angles_rad
    if angles is not None and _degrees(angles):
        raise FileFormatError(
            f"{path}: angles_rad from {angles.min():g} to {angles.max():g} in even steps: these are degrees",
            "Store radians: angles_rad = numpy.deg2rad(angles).",
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


def _degrees(angles: NDArray[np.float64]) -> bool:
    if len(angles) < 4:
        return False
    steps = np.diff(angles)
    step = float(median(np.abs(steps)))
    turn = float(np.ptp(angles)) + step
    even = float(np.ptp(steps)) <= _EVEN * step
    return step >= _LEAST_STEP and even and _TURN_DEG[0] <= turn <= _TURN_DEG[1]
