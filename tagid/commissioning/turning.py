"""Step 4, turning: period, uniformity and axis distance, with the test card on the table."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from tagid.capture import Capture
from tagid.commissioning.bench import Bench, reported
from tagid.commissioning.pulse import received_from
from tagid.commissioning.rows import Level, Row, StepReport
from tagid.commissioning.targets import Target
from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import DataError
from tagid.geometry import ImageGrid
from tagid.imaging.ats.calibration import begin
from tagid.imaging.autofocus import BEYOND_SEARCH
from tagid.motion.urls import open_motion
from tagid.operate.turn import record_turn
from tagid.operate.workplace import MOST_SCANS, Workplace
from tagid.pipeline.prepared import PreparedCapture, load_capture
from tagid.pipeline.settings import ImagingSettings
from tagid.recording.inspection import scan_rate, turning_period
from tagid.rig import Measured

CARD_REFLECTOR: Final = Target("octahedron", 0.040)
"""What stands on the test card."""
SEARCH_M: Final = 0.12
"""Half width of the search for the axis: a tape read wrongly by a decimetre."""
_TURNS: Final = 2.3
_EXTENT_M: Final = 0.3
_HARMONICS: Final = 4
_VARIATION_SHARE: Final = 0.15
"""Relative error of the speed variation on emulated rigs: estimates were up to a quarter too large."""
_PERIOD_SHARE: Final = 1e-4
"""Relative error of the period on emulated rigs with a wobble, where the repetition alone claims less."""
_MOST_VARIATION: Final = 0.05
_PERIOD_TOLERANCE: Final = 0.02
_AXIS_TOLERANCE_M: Final = 0.02
"""A tape measure does not reach the phase centre of the antennas, but within 2 cm."""
_MOST_AXIS_SIGMA_M: Final = 0.01
_HALVES: Final = 0.01
"""Two halves of a recording that differ more in their period: the table slipped or stopped."""


def measure_turning(bench: Bench) -> StepReport:
    """Record two turns of the test card. Raises DeviceError and its subclasses, DataError, ConfigError."""
    place = bench.workplace()
    motion = open_motion(place.config["motion.url"])
    nominal_s = motion.nominal_s
    if nominal_s is None:
        first = record_turn(place, place.plan())
        bench.keep_file("turning", first.path)
        nominal_s = turning_period(first.capture).period_s
        if nominal_s is None:
            raise DataError("no period was found", "Start the table with the test card on it, and repeat.")
    window = place.plan().config
    scans = 400 if window is None else math.ceil(_TURNS * nominal_s / window.scan_period_s)
    seconds = 3 * _TURNS * nominal_s
    recorded = record_turn(place, place.plan(scans=min(scans, MOST_SCANS), max_seconds=seconds))
    capture = recorded.capture
    name = bench.keep_file("turning", recorded.path)
    turning = turning_period(capture)
    if turning.period_s is None or turning.sigma_s is None:
        return reported(
            "turning",
            [
                Row(
                    "period",
                    Level.FAIL,
                    text=turning.note,
                    code="period",
                    advice="Check that the table turns evenly, and its speed in `motion.url`.",
                )
            ],
            recording=name,
        )
    period = Measured(turning.period_s, math.hypot(turning.sigma_s, _PERIOD_SHARE * turning.period_s))
    rows = [_period_row(period, nominal_s), _evenness(capture, period)]
    values = {"period_s": period}
    facts: dict[str, str | int] = {"direction": motion.direction}
    rows.append(_direction_row(motion.direction))
    prepared = prepare_card(bench, place, capture, period)
    axis, axis_row = _axis(bench, prepared)
    rows.append(axis_row)
    if axis is not None:
        values["axis_distance_m"] = axis
        variation, row = _variation(prepared)
        values["speed_variation"] = variation
        rows.append(row)
    height = Measured(bench.tape.antenna_height_m, bench.tape.error_m)
    rows.append(
        Row(
            "antenna height", Level.NOTE, height.value, height.sigma, "m", "by tape: the scans do not tell it"
        )
    )
    values["antenna_height_m"] = height
    values["antenna_separation_m"] = Measured(bench.tape.antenna_separation_m, bench.tape.error_m)
    return reported("turning", rows, values=values, facts=facts, recording=name)


def prepare_card(
    bench: Bench, place: Workplace, capture: Capture, period: Measured | None
) -> PreparedCapture:
    """A recording of the test card for imaging: the measured period and pulse, one turn of views."""
    pulse = bench.pulse()
    if pulse is not None:
        capture = replace(capture, pulse=received_from(pulse, CARD_REFLECTOR)[0])
    motion = open_motion(place.config["motion.url"])
    if period is not None and not motion.measures:
        way = "cw" if motion.direction < 0 else "ccw"
        place = bench.workplace(motion__url=f"free?rpm={60 / period.value:.6f}&direction={way}")
    loading = replace(place.loading(), extent_m=_EXTENT_M)
    settings = ImagingSettings(extent_m=_EXTENT_M, focus_m=SEARCH_M)
    return PreparedCapture(load_capture(capture, loading), settings)


def _period_row(period: Measured, nominal_s: float) -> Row:
    off = period.value / nominal_s - 1
    if abs(off) <= _PERIOD_TOLERANCE:
        return Row("period", Level.PASS, period.value, period.sigma, "s", f"{60 / period.value:.3f} rpm")
    return Row(
        "period",
        Level.NOTE,
        period.value,
        period.sigma,
        "s",
        f"{100 * off:+.1f} % against the speed given",
        f"Set `motion.url=free?rpm={60 / period.value:.3g}`.",
    )


def _evenness(capture: Capture, period: Measured) -> Row:
    """Whether the first and the second part repeat after the same time, and the table never stood."""
    resolved = capture.motion.resolved
    stopped = resolved is not None and resolved.standstill is not None
    rate, duration = scan_rate(capture)
    change, sigma = 0.0, period.sigma / period.value
    if rate is not None and duration is not None:
        part = min(capture.views, math.ceil(1.35 * period.value * rate))
        ends = [
            turning_period(capture.select(s)) for s in (slice(0, part), slice(capture.views - part, None))
        ]
        periods = [end for end in ends if end.period_s is not None and end.sigma_s is not None]
        if len(periods) == 2:
            a, b = periods
            assert a.period_s and b.period_s and a.sigma_s is not None and b.sigma_s is not None
            change, sigma = (
                (b.period_s - a.period_s) / period.value,
                math.hypot(a.sigma_s, b.sigma_s) / period.value,
            )
        else:
            stopped = stopped or len(periods) < len(ends)
    if not stopped and abs(change) <= max(_HALVES, 3 * sigma):
        return Row("second turn against first", Level.PASS, 100 * change, 100 * sigma, "%")
    return Row(
        "second turn against first",
        Level.FAIL,
        100 * change,
        100 * sigma,
        "%",
        "the table slips or stops",
        "Check the drive and the weight on the table; fix the card on the table; then repeat.",
        "slip",
    )


def _direction_row(direction: int) -> Row:
    way = "counter-clockwise" if direction > 0 else "clockwise"
    return Row("direction", Level.NOTE, text=f"{way} from above, as given; the test card confirms it")


def _axis(bench: Bench, prepared: PreparedCapture) -> tuple[Measured | None, Row]:
    """The axis distance by focusing the card, whose reflectors look farther away by their own delay.

    The search is made for any object; here its estimate is taken with its standard error.
    """
    given = bench.axis_distance_m()
    focus = prepared.focus()
    usable = focus is not None and focus.evidence >= focus.needed and focus.sigma_m <= _MOST_AXIS_SIGMA_M
    if focus is None or focus.best_m is None or not usable or focus.reason == BEYOND_SEARCH:
        reason = "" if focus is None else focus.reason
        return None, Row(
            "axis distance",
            Level.FAIL,
            text=f"the scans do not tell it: {reason}",
            advice="Put the test card on the middle of the table and point both antennas at it; then repeat.",
            code="axis-unknown",
        )
    delay = bench.value("target", "path_delay_ps")
    pulse = bench.pulse()
    late_ps = CARD_REFLECTOR.delay_ps() if pulse is None else received_from(pulse, CARD_REFLECTOR)[1]
    of_reflector = late_ps * 1e-12 * SPEED_OF_LIGHT / 2
    parts = [focus.sigma_m]
    if delay is not None:
        parts.append(delay.sigma * 1e-12 * SPEED_OF_LIGHT / 2)
    parts.append(bench.tape.antenna_height_m * bench.tape.error_m / given)
    axis = Measured(focus.best_m - of_reflector, math.hypot(*parts))
    off = axis.value - given
    if abs(off) <= max(_AXIS_TOLERANCE_M, 3 * math.hypot(axis.sigma, bench.tape.error_m)):
        return axis, Row(
            "axis distance", Level.PASS, axis.value, axis.sigma, "m", f"{off * 1e3:+.0f} mm against the tape"
        )
    return axis, Row(
        "axis distance",
        Level.FAIL,
        axis.value,
        axis.sigma,
        "m",
        f"{off * 1e2:+.1f} cm against the tape",
        "Measure again, horizontally, from the antennas to the middle of the table; then repeat.",
        "axis",
    )


def _variation(prepared: PreparedCapture) -> tuple[Measured, Row]:
    """RMS deviation of the speed over a turn, and its harmonics."""
    settings = prepared.settings
    scans = prepared.focused(
        prepared.scans(settings.preprocessing_for_focus(prepared.given, matched_filter=False))
    )
    unknown = begin(scans, ImageGrid(_EXTENT_M, 60), ("axis", "wobble"), _HARMONICS)
    orders = np.arange(1, _HARMONICS + 1)
    levels = orders * np.abs(unknown.wobble) / math.sqrt(2)
    sigmas = orders * np.nan_to_num(unknown.wobble_sigma) / math.sqrt(2)
    total = float(np.sqrt((levels**2).sum()))
    sigma = (
        float(np.sqrt((levels**2 * sigmas**2).sum()) / total) if total > 0 else float(np.hypot.reduce(sigmas))
    )
    sigma = math.hypot(sigma, _VARIATION_SHARE * total)
    spectrum = ", ".join(f"{100 * level:.2f}" for level in levels)
    even = total <= _MOST_VARIATION + 3 * sigma
    row = Row(
        "speed variation",
        Level.PASS if even else Level.FAIL,
        100 * total,
        100 * sigma,
        "%",
        f"1 to {_HARMONICS} times a turn: {spectrum} %",
        "" if even else "Check the drive; put the table on a level surface; then repeat.",
        "" if even else "uneven",
    )
    return Measured(total, sigma), row
