"""Units of files from other programs: degrees, millimetres or ticks instead of radians, metres and seconds.

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


_UNSEEN, _SPARSE = 20.0, 8.0
"""A path this many times as long as the largest recorded range, in steps of so many wavelengths, is none in
metres; nor one whose steps exceed that range: no view would see what the one before it saw."""
_DEGREE_M = 111e3
"""A degree of latitude, m."""
_TINY = 0.25
"""A path shorter than this many wavelengths, in metres, shows everything from one place."""
_LONGEST_STEP_S, _USUAL_STEP_S = 30.0, 5.0
"""Time between two scans that is taken for seconds, and in the unit that is suggested."""
_LATEST_S = 1e11
"""Later times, the year 5138, are not seconds since 1970."""
_DATES = (1e8, 5e9)
"""The years 1973 to 2128, s since 1970."""
_TIMES = (
    ("milliseconds", 1e3, 0.0),
    ("microseconds", 1e6, 0.0),
    ("ticks of 100 ns", 1e7, 62_135_596_800.0),
    ("nanoseconds", 1e9, 0.0),
)
"""Units: name, parts of a second, and the start of 1970 in seconds."""


def check_times(path: Path, seconds: NDArray[np.float64]) -> None:
    """Refuse timestamps_s (views,) in another unit: times beyond the year 5138, or scans 30 s and more apart.

    Raises FileFormatError: naming the unit and the conversion.
    """
    if len(seconds) < 2:
        return
    step, largest = float(median(np.abs(np.diff(seconds)))), float(np.abs(seconds).max())
    if largest <= _LATEST_S and step <= _LONGEST_STEP_S:
        return
    dated = [
        (name, unit) for name, unit, year_1970 in _TIMES if _DATES[0] < largest / unit - year_1970 < _DATES[1]
    ]
    likely = [(name, unit) for name, unit, _ in _TIMES if _LONGEST_STEP_S < step <= _USUAL_STEP_S * unit]
    if not dated + likely:
        return
    name, unit = (*dated, *likely)[0]
    raise FileFormatError(
        f"{path}: timestamps_s reaches {largest:g} in steps of about {step:g}: these are {name}",
        f"Divide timestamps_s by {unit:g}; if they are seconds, store angles_rad instead.",
    )


def check_positions(path: Path, capture: Capture) -> None:
    """Refuse antenna positions in millimetres, centimetres, kilometres or degrees.

    Raises FileFormatError: naming the unit and the conversion.
    """
    positions = capture.antenna_positions_m
    if positions is None or capture.views < 4:
        return
    span = float(np.linalg.norm(np.ptp(positions, axis=0)))
    step = float(median(np.linalg.norm(np.diff(positions, axis=0), axis=1)))
    reach = float(np.abs(capture.ranges_m).max())
    wavelength = capture.wavelength_m
    told = (
        f"{path}: antenna_positions_m spans {span:.3g} in steps of about {step:.3g}, and the scans reach "
        f"{reach:.3g} m"
    )
    if step > reach or (span > _UNSEEN * reach and step > _SPARSE * wavelength):
        name, unit = (
            ("centimetres", 100)
            if span / 100 < 2 * reach and step / 100 < wavelength
            else ("millimetres", 1000)
        )
        raise FileFormatError(
            f"{told}: these are {name}",
            f"Divide antenna_positions_m by {unit}; the path is then {span / unit:.3g} m long.",
        )
    if not 0 < span < _TINY * wavelength:
        return
    north_east = positions[:, :2]
    length = _DEGREE_M * float(np.linalg.norm(np.ptp(north_east, axis=0)))
    if np.abs(north_east).max() <= 180 and length < _UNSEEN * reach and abs(positions[0, :2]).max() > 1:
        raise FileFormatError(
            f"{told}: these are latitude and longitude in degrees",
            "Store metres: with the angles in rad, x = 6.371e6 * cos(latitude0) * (longitude - longitude0), "
            "y = 6.371e6 * (latitude - latitude0), z = the height.",
        )
    raise FileFormatError(
        f"{told}: from so short a path nothing is imaged; are these kilometres?",
        "Multiply antenna_positions_m by 1000 if they are; a path is at least a few wavelengths long.",
    )


def check_units(path: Path, capture: Capture) -> None:
    """Refuse angles that are degrees, ranges that are millimetres, and positions that are not metres.

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
    check_positions(path, capture)


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
