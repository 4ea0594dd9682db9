"""Units of files from other programs: degrees, millimetres or ticks instead of radians, metres and seconds.

Such a file is valid, number by number, and fails much later for another reason. Only what cannot be in the
declared unit is rejected.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import FileFormatError
from tagid.signal import median

_TURNS = {
    "degrees (numpy.deg2rad(angles))": 360.0,
    "gon (times pi/200)": 400.0,
    "mrad (divided by 1000)": 2000 * np.pi,
    "minutes of arc (times pi/10800)": 21600.0,
}
"""Units of angles with their conversion to radians -> a turn."""
_WHOLE = 0.014
"""A span with one more step is a turn within this part of it."""
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
_LENGTHS = (
    ("centimetres (divide by 100)", 100.0),
    ("inches (multiply by 0.0254)", 1 / 0.0254),
    ("feet (multiply by 0.3048)", 1 / 0.3048),
    ("millimetres (divide by 1000)", 1000.0),
)
_STEPS = (
    ("millimetres (divide by 1000)", 1e-3),
    ("centimetres (divide by 100)", 1e-2),
    ("picoseconds of delay there and back (multiply by 1.499e-4)", SPEED_OF_LIGHT / 2e12),
)
"""Units: name with the conversion, and parts of a metre, or metres."""
_OVERSAMPLED = 12.0
"""Samples this many times as dense as needed are not suspected behind a wrong unit."""
_FREQUENCIES = (("GHz", 1e9), ("MHz", 1e6), ("kHz", 1e3))
_LONGEST_WAVE_M = 1e3
"""A wave as long belongs to no radar of an object; nor does the range resolution of such a bandwidth."""
_TINY = 0.25
"""A path shorter than this many wavelengths, in metres, shows everything from one place."""
_LONGEST_STEP_S, _USUAL_STEP_S = 30.0, 5.0
"""Time between two scans that is taken for seconds, and in the unit that is suggested."""
_LONGEST_S, _UNHURRIED_S = 3 * 3600.0, 1.0
"""A turn does not take as long, with scans as far apart."""
_SHORTEST_S, _MANY = 0.05, 16
"""Nor is so little time of a turn recorded, in as many scans."""
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
    """Reject timestamps_s (views,) in another unit.

    These are times beyond the year 5138, scans 30 s and more apart, or 1 s and more over 3 hours, and 16
    scans and more within 0.05 s.

    Raises FileFormatError: naming the unit and the conversion.
    """
    if len(seconds) < 2:
        return
    step, largest = float(median(np.abs(np.diff(seconds)))), float(np.abs(seconds).max())
    whole = float(np.ptp(seconds))
    if 0 < whole < _SHORTEST_S and len(seconds) >= _MANY:
        raise FileFormatError(
            f"{path}: timestamps_s spans {whole:.3g} with {len(seconds)} scans: no turn is as short; are "
            "these hours, or days?",
            "Multiply timestamps_s by 3600 (hours) or 86400 (days); if they are seconds, store angles_rad.",
        )
    least = _UNHURRIED_S if whole > _LONGEST_S else _LONGEST_STEP_S
    if largest <= _LATEST_S and step <= least:
        return
    dated = [
        (name, unit) for name, unit, year_1970 in _TIMES if _DATES[0] < largest / unit - year_1970 < _DATES[1]
    ]
    likely = [(name, unit) for name, unit, _ in _TIMES if least < step <= _USUAL_STEP_S * unit]
    if not dated + likely:
        return
    name, unit = (*dated, *likely)[0]
    raise FileFormatError(
        f"{path}: timestamps_s reaches {largest:g} in steps of about {step:g}: these are {name}",
        f"Divide timestamps_s by {unit:g}; if they are seconds, store angles_rad instead.",
    )


def _check_positions(path: Path, capture: Capture) -> None:
    """Reject antenna positions in millimetres, centimetres, kilometres or degrees."""
    positions = capture.antenna_positions_m
    if positions is None or capture.views < 4:
        return
    span = float(np.linalg.norm(np.ptp(positions, axis=0)))
    step = float(median(np.linalg.norm(np.diff(positions, axis=0), axis=1)))
    reach = float(np.abs(capture.ranges_m).max())
    wavelength = capture.wavelength_m
    measured = (
        f"{path}: antenna_positions_m spans {span:.3g} in steps of about {step:.3g}, and the scans reach "
        f"{reach:.3g} m"
    )
    if step > reach or (span > _UNSEEN * reach and step > _SPARSE * wavelength):
        fitting = [
            f"{name}, a path of {span / unit:.3g} m"
            for name, unit in _LENGTHS
            if reach / 10 < span / unit < 2 * reach and step / unit < wavelength
        ]
        raise FileFormatError(
            f"{measured}: these are not metres",
            f"Store metres in antenna_positions_m; they may be {_either(fitting or [_LENGTHS[-1][0]])}.",
        )
    if not 0 < span < _TINY * wavelength:
        return
    north_east = positions[:, :2]
    length = _DEGREE_M * float(np.linalg.norm(np.ptp(north_east, axis=0)))
    if np.abs(north_east).max() <= 180 and length < _UNSEEN * reach and abs(positions[0, :2]).max() > 1:
        raise FileFormatError(
            f"{measured}: these are latitude and longitude in degrees",
            "Store metres: with the angles in rad, x = 6.371e6 * cos(latitude0) * (longitude - longitude0), "
            "y = 6.371e6 * (latitude - latitude0), z = the height.",
        )
    raise FileFormatError(
        f"{measured}: from so short a path nothing is imaged; are these kilometres?",
        "Multiply antenna_positions_m by 1000 if they are; a path is at least a few wavelengths long.",
    )


def check_units(path: Path, capture: Capture) -> None:
    """Reject angles that are degrees, ranges that are millimetres, axes and positions that are not metres.

    Angles are no radians if steps of 0.1 or more, most of them about even, make up one turn of 360 or 400; in
    radians, these would be 57.3 turns of at most 63 views. Steps of 0.9 or more need no whole turn, only more
    than 12.6 in all, two turns of 7 views in radians. Ranges are no metres if their step exceeds ten range
    resolutions c / (2 bandwidth), and a thousandth of it does not exceed one. Where several units fit, all
    are named.

    Raises:
        FileFormatError: naming the field and the conversion.
    """
    angles = capture.angles_rad
    if angles is not None and (units := _angle_units(angles)):
        raise FileFormatError(
            f"{path}: angles_rad from {angles.min():g} to {angles.max():g} in steps of about "
            f"{_step(angles):.3g}: these are not radians",
            f"Store radians; they may be {_either(units)}. If they are radians, wrap them to one turn.",
        )
    _check_frequencies(path, capture)
    resolution = capture.wave_speed_m_s / (2 * capture.bandwidth_hz)
    step = capture.range_step_m
    if step > _COARSE * resolution and step / 1000 <= resolution:
        highest = capture.center_frequency_hz + capture.bandwidth_hz / 2
        most = resolution if np.iscomplexobj(capture.samples) else capture.wave_speed_m_s / (4 * highest)
        fitting = [name for name, unit in _STEPS if most / _OVERSAMPLED < step * unit <= most]
        raise FileFormatError(
            f"{path}: range_step_m is {step:g}, but scans of this bandwidth need a sample every "
            f"{resolution / 2:.2g} m: these are not metres",
            f"They may be {_either(fitting or [name for name, _ in _STEPS])}: convert range_start_m, "
            "range_step_m and axis_distance_m; if they are metres, add bandwidth_hz.",
        )
    _check_axis(path, capture)
    _check_positions(path, capture)


def _check_axis(path: Path, capture: Capture) -> None:
    """Reject an axis far beyond the recorded ranges that another unit brings into them."""
    axis, ranges = capture.axis_distance_m, capture.ranges_m
    if axis is None or axis <= _UNSEEN * ranges[-1]:
        return
    fitting = [name for name, parts in _LENGTHS if ranges[0] < axis / parts < ranges[-1]]
    if fitting:
        raise FileFormatError(
            f"{path}: axis_distance_m is {axis:g}, but the scans reach from {ranges[0]:.3g} to "
            f"{ranges[-1]:.3g} m: these are not metres",
            f"Store metres in axis_distance_m; they may be {_either(fitting)}.",
        )


def _step(angles: NDArray[np.float64]) -> float:
    return float(median(np.abs(np.diff(angles))))


def _angle_units(angles: NDArray[np.float64]) -> list[str]:
    """Units that angles may have that are no radians; [] where they may be radians."""
    if len(angles) < 4:
        return []
    step, span = _step(angles), float(np.ptp(angles))
    whole = [name for name, turn in _TURNS.items() if abs(span + step - turn) <= _WHOLE * turn]
    if step >= _SURE_STEP and span > max(_SURE_SPAN, 2 * step):
        return whole or [*_TURNS, "steps or counts of a table (times 2 pi / those of a turn)"]
    for name in whole:
        # Angles wrapped to a turn have one step back over the whole of it.
        turn = _TURNS[name]
        steps = (np.diff(angles) + turn / 2) % turn - turn / 2
        way = float(np.sign(median(steps)))
        uneven = float((np.abs(way * steps - step) > _EVEN * step).mean())
        if step >= _LEAST_STEP and uneven <= _MOST_UNEVEN:
            return [name]
    return []


def _check_frequencies(path: Path, capture: Capture) -> None:
    """Reject a centre frequency or bandwidth in GHz, MHz or kHz."""
    for key in ("center_frequency_hz", "bandwidth_hz"):
        value = float(getattr(capture, key))
        length = capture.wave_speed_m_s / value
        if length <= max(_LONGEST_WAVE_M, 100 * float(np.abs(capture.ranges_m).max())):
            continue
        fitting = [f"{name} (times {unit:g})" for name, unit in _FREQUENCIES if 1e-4 < length / unit < 10]
        raise FileFormatError(
            f"{path}: {key} is {value:g}, a wave of {length:.3g} m: this is not in Hz",
            f"Store Hz; it may be {_either(fitting or [name for name, _ in _FREQUENCIES])}.",
        )


def _either(words: list[str]) -> str:
    return " or ".join(filter(None, (", ".join(words[:-1]), words[-1])))
