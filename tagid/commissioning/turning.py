"""Step 4, turning: period, evenness, direction and axis distance, with the test card on the table."""

from __future__ import annotations

import math
from functools import partial
from typing import Final

import numpy as np

from tagid.angles.clock import fit_clock
from tagid.angles.sinogram import uniform_grid
from tagid.capture import Capture
from tagid.commissioning.bench import Bench, radar_facts, reported
from tagid.commissioning.card_fit import HARMONICS, CardFit, Known, fit_card
from tagid.commissioning.pictures import Picture
from tagid.commissioning.pulse import received_from
from tagid.commissioning.rows import Level, Row, StepReport
from tagid.commissioning.targets import Target
from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import ConfigError, DataError
from tagid.motion.device import Motion
from tagid.motion.urls import open_motion
from tagid.operate.workplace import MOST_SCANS
from tagid.recording.curves import slow_time
from tagid.recording.inspection import turning_period
from tagid.rig import Measured
from tagid.signal import vertex
from tagid.tags.layouts.test_card import test_card
from tagid.types import Floats

CARD_REFLECTOR: Final = Target("octahedron", 0.040)
"""What stands on the test card."""
MIRRORED: Final = (
    "the card appears as its mirror image",
    "The table turns the other way than given (see `motion.url`), or the card is mirrored: print it again "
    "and put it on the table with its print upwards.",
)
MISSING_ADVICE: Final = "Put a reflector on each mark of the card, then repeat."
_TURNS: Final = 2.3
_CLOCK: Final = 1e-5
"""Relative error of the radar's clock, a crystal (assumed)."""
_MOST_VARIATION: Final = 0.05
_PERIOD_TOLERANCE: Final = 0.02
_ANGLE_TOLERANCE: Final = 0.01
"""Of the angle that a device reports (docs/first-robot.md, step 26)."""
_AXIS_TOLERANCE_M: Final = 0.02
"""A tape measure does not reach the phase centre of the antennas, but within 2 cm."""
_MOST_AXIS_SIGMA_M: Final = 0.01
_MOST_UNEXPLAINED: Final = 0.5
_FAINT: Final = 0.4
"""Reflectors made by hand differ by 1 dB; -8 dB is none."""
_SLIP: Final = 0.01
"""Change of the time after which scans repeat, over the period, at which the table slipped or stopped."""
_SLIP_REACH: Final = 0.25
_SLIP_BLOCK: Final = 0.06
"""Largest slip and length of the parts that are compared, in turns."""
_ALIKE: Final = 0.5
_PART_TURNS: Final = 1 / 90
"""Turns over which the scans of a turning card differ for certain."""
_STANDS: Final = 0.1
"""Change over that part, over the usual one, below which the card stands."""
_AT_SPEED: Final = 0.9


def measure_turning(bench: Bench) -> StepReport:
    """Record two turns of the test card. Raises DeviceError and its subclasses, DataError, ConfigError."""
    place = bench.workplace()
    motion = open_motion(place.config["motion.url"])
    nominal_s = motion.nominal_s
    if nominal_s is None:
        first = bench.take_turn(place, place.plan(), "looking for the speed")
        bench.keep_file("turning", first.path)
        nominal_s = turning_period(first.capture).period_s
        if nominal_s is None:
            raise DataError("no period was found", "Start the table with the test card on it, and repeat.")
    window = place.plan().config
    scans = 400 if window is None else math.ceil(_TURNS * nominal_s / window.scan_period_s)
    seconds = 3 * _TURNS * nominal_s
    plan = place.plan(scans=min(scans, MOST_SCANS), max_seconds=seconds)
    recorded = bench.take_turn(place, plan, "two turns")
    name = bench.keep_file("turning", recorded.path)
    return evaluated(bench, motion, recorded.capture, nominal_s, name)


def evaluated(bench: Bench, motion: Motion, capture: Capture, nominal_s: float, recording: str) -> StepReport:
    """The report of a recording of two turns of the test card, expected to take so many seconds each.

    Raises DataError, ConfigError.
    """
    turning = turning_period(capture)
    evenness = _evenness(capture, nominal_s)
    ends = _ends_row(capture, nominal_s, motion.measures)
    if evenness.level is Level.FAIL:
        return reported("turning", [evenness, ends], recording=recording)
    if turning.period_s is None:
        advice = "Check that the table turns evenly, and its speed in `motion.url`."
        row = Row("period", Level.FAIL, text=turning.note, advice=advice, code="period")
        return reported("turning", [row], recording=recording)
    angles, reported_turns = _angles(motion, capture, turning.period_s)
    fit = _fitted(bench, capture, angles)
    if fit.unexplained > _MOST_UNEXPLAINED or fit.axis_distance_m.sigma > _MOST_AXIS_SIGMA_M:
        row = Row(
            "test card",
            Level.FAIL,
            100 * fit.unexplained,
            unit="%",
            text="of the changing echo is not that of the test card",
            advice=f"Measure the distance to the axis again ({bench.axis_distance_m():g} m was given), put "
            "the test card alone on the middle of the table, point both antennas at it, and repeat.",
            code="axis-unknown",
        )
        return reported("turning", [evenness, row], recording=recording)
    period = Measured(
        turning.period_s / fit.speed.value, turning.period_s * math.hypot(fit.speed.sigma, _CLOCK)
    )
    height = Measured(bench.tape.antenna_height_m, bench.tape.error_m)
    values = {
        "period_s": period,
        "axis_distance_m": fit.axis_distance_m,
        "speed_variation": fit.speed_variation,
        "antenna_height_m": height,
        "antenna_separation_m": Measured(bench.tape.antenna_separation_m, bench.tape.error_m),
    }
    rows = [
        _period_row(period, nominal_s),
        evenness,
        ends,
        *([_angle_row(reported_turns, fit.speed)] if motion.measures else []),
        _direction_row(motion.direction, fit.mirrored),
        _reflectors_row(fit.strengths),
        Row("residual", Level.PASS, 100 * fit.unexplained, unit="%", text="of the echo is not the card's"),
        _axis_row(fit.axis_distance_m, bench),
        Row(
            "antenna height", Level.NOTE, height.value, height.sigma, "m", "by tape: the scans do not tell it"
        ),
        _variation_row(fit),
    ]
    facts = radar_facts(capture) | {"direction": motion.direction}
    degrees = np.arange(0.0, 361.0, 3.0)
    speed = Picture.of(
        "degrees: deviation of the speed over a turn, %",
        (degrees, 100 * fit.speed_deviation(np.deg2rad(degrees))),
    )
    return reported("turning", rows, values=values, facts=facts, recording=recording, pictures=(speed,))


def _angles(motion: Motion, capture: Capture, period_s: float) -> tuple[Floats, float]:
    """(angle of every view, rad, of a turn a period; turns that the device reports in a period).

    A device that slips reports another angle than it turns: its angles are brought to the scans' period,
    from where the fit begins.
    """
    times_s, reported = _times_s(capture), capture.angles_rad
    if not motion.measures or reported is None:
        return motion.direction * 2 * np.pi * times_s / period_s, 1.0
    turns = abs(float(np.polyfit(times_s, reported, 1)[0])) * period_s / (2 * math.pi)
    return reported / turns, turns


def _fitted(bench: Bench, capture: Capture, angles: Floats) -> CardFit:
    """The card in a recording. Raises ConfigError if the reference target was not measured."""
    pulse, delay = bench.pulse(), bench.value("target", "path_delay_ps")
    if pulse is None or delay is None:
        raise ConfigError("the reference target was not measured", "Do the step target first.")
    received, late_ps = received_from(pulse, CARD_REFLECTOR)
    tape, metres = bench.tape, 1e-12 * SPEED_OF_LIGHT / 2
    noise = bench.value("room", "noise_counts")
    known = Known(
        bench.axis_distance_m(),
        Measured(tape.antenna_height_m, tape.error_m),
        tape.antenna_separation_m,
        Measured(late_ps * metres, delay.sigma * metres),
        received,
        0.0 if noise is None else noise.value,
    )
    return fit_card(capture, angles, test_card().positions, known)


def _times_s(capture: Capture) -> Floats:
    """(views,) of the scans."""
    if capture.radar_time_ms is None:
        return np.asarray(slow_time(capture)[0], dtype=np.float64)
    return fit_clock(capture.radar_time_ms, capture.scan_id).times_s


def _period_row(period: Measured, nominal_s: float) -> Row:
    off = period.value / nominal_s - 1
    row = partial(Row, "period", value=period.value, sigma=period.sigma, unit="s")
    rpm = 60 / period.value
    if abs(off) <= _PERIOD_TOLERANCE:
        return row(Level.PASS, text=f"{rpm:.3f} rpm")
    text = f"{100 * off:+.1f} % against the speed given"
    return row(Level.NOTE, text=text, advice=f"Set `motion.url=free?rpm={rpm:.3g}`.")


def _evenness(capture: Capture, period_s: float) -> Row:
    """Whether every part of the later turns repeats after the same time.

    The wobble of a table repeats with it; a table that slips or stops does not.
    """
    name = "repetition of the turns"
    resolved = capture.motion.resolved
    stopped = resolved is not None and resolved.standstill is not None
    lags = repetition(capture, period_s)
    if len(lags) < 2:
        if not stopped:
            return Row(name, Level.NOTE, text="less than two turns: not compared")
        change, sigma = None, None
    else:
        middle = float(np.median(lags))
        apart = np.abs(lags / middle - 1) > _SLIP
        stopped = stopped or bool((apart[1:] & apart[:-1]).any())
        change = 100 * float(np.ptp(lags)) / middle
        sigma = 100 * float(np.median(np.abs(np.diff(lags)))) / middle
    text = "the table slips or stops" if stopped else "largest difference between parts of the turns"
    advice = "Check the drive and the weight on the table; fix the card on the table; then repeat."
    return Row.judged(name, not stopped, change, sigma, "%", text, advice, "slip")


def _ends_row(capture: Capture, period_s: float, measures: bool) -> Row:
    """How long the card stands before it turns and after it, and when a device has its speed."""
    times_s, scans = _times_s(capture), capture.samples.astype(np.float32)
    lag_s = _PART_TURNS * period_s
    lag = max(1, round(lag_s / float(np.median(np.diff(times_s)))))
    if len(scans) <= 2 * lag:
        return Row("start and stop", Level.NOTE, text="too few scans")
    change = ((scans[lag:] - scans[:-lag]) ** 2).mean(axis=1)
    # What stands differs by noise alone; of a card that turns throughout the least change is no noise.
    usual, least = float(np.median(change)), float(change.min())
    turning = np.flatnonzero(change > least + _STANDS * (usual - least))
    first_s = float(times_s[turning[0]] - times_s[0])
    last_s = float(times_s[-1] - times_s[turning[-1] + lag])
    stands = max(first_s, last_s) > lag_s
    words = f"it stands for {first_s:.1f} s before and {last_s:.1f} s after the turns"
    text = [words if stands else "it turns from the first scan to the last"]
    if measures and capture.angles_rad is not None:
        speed = np.abs(capture.angles_rad[lag:] - capture.angles_rad[:-lag])
        reached = int(np.argmax(speed >= _AT_SPEED * np.median(speed)))
        text.append(f"{100 * _AT_SPEED:.0f} % of its speed after {times_s[reached] - times_s[0]:.1f} s")
    row = partial(Row, "start and stop", value=first_s + last_s, sigma=lag_s, unit="s", text="; ".join(text))
    if not stands:
        return row(Level.PASS)
    return row(Level.NOTE, advice="Start the table before the step: standing scans tell nothing.")


def repetition(capture: Capture, period_s: float) -> Floats:
    """(parts,) time after which each part of the later turns repeats an earlier one, s, in their order.

    The capture is of more than a turn, which takes about so many seconds.
    """
    grid, received, step_s = uniform_grid(capture.samples, _times_s(capture))
    grid[received] -= grid[received].mean(axis=0)
    low, high = (round((1 + side * _SLIP_REACH) * period_s / step_s) for side in (-1, 1))
    width = max(3, round(_SLIP_BLOCK * period_s / step_s))
    window, energy = np.ones(width), np.einsum("ib,ib->i", grid, grid).astype(np.float64)
    at = np.arange(high + width // 2, len(grid) - width // 2, width)
    if not len(at):
        return np.zeros(0)
    alike = []
    for lag in range(low, high + 1):
        product = np.einsum("ib,ib->i", grid[lag:], grid[:-lag]).astype(np.float64)
        sums = [np.convolve(x, window, "same")[at - lag] for x in (product, energy[lag:], energy[:-lag])]
        alike.append(sums[0] / np.sqrt(np.maximum(sums[1] * sums[2], 1e-30)))
    score = np.array(alike)
    best = score.argmax(axis=0)
    seen = score[best, np.arange(len(at))] > _ALIKE
    inner = np.clip(best, 1, len(score) - 2)
    part = np.arange(len(at))
    parts_of_step = [vertex(*score[i - 1 : i + 2, k].tolist()) for i, k in zip(inner, part, strict=True)]
    return np.asarray((low + inner + np.array(parts_of_step))[seen] * step_s)


def _angle_row(turns: float, speed: Measured) -> Row:
    """The angle that the device reports, in turns per period as of `_angles`, against that of the scans."""
    off = turns / speed.value - 1
    good = abs(off) <= max(_ANGLE_TOLERANCE, 3 * speed.sigma)
    text = "" if good else "the device turns further or less far than it reports"
    advice = "Calibrate it: `tagid motion calibrate`; a robot first passes docs/first-robot.md."
    name = "reported angle against scans"
    return Row.judged(name, good, 100 * off, 100 * speed.sigma, "%", text, advice, "angle")


def _direction_row(direction: int, mirrored: bool) -> Row:
    way = "counter-clockwise" if direction > 0 else "clockwise"
    text = MIRRORED[0] if mirrored else f"{way} from above, by the order of the card's reflectors"
    return Row.judged("direction", not mirrored, None, None, "", text, MIRRORED[1], "mirrored")


def _reflectors_row(strengths: Floats) -> Row:
    faint = int(np.count_nonzero(strengths < _FAINT))
    weakest = 20 * math.log10(max(float(strengths.min()), 1e-2))
    text = "against the median of the card's reflectors"
    if faint:
        text = f"{faint} of the card's {len(strengths)} reflectors missing"
    return Row.judged(
        "weakest reflector", not faint, weakest, None, "dB", text, MISSING_ADVICE, "missing-reflector"
    )


def _axis_row(axis: Measured, bench: Bench) -> Row:
    off = axis.value - bench.axis_distance_m()
    good = abs(off) <= max(_AXIS_TOLERANCE_M, 3 * math.hypot(axis.sigma, bench.tape.error_m))
    text = (f"{off * 1e3:+.0f} mm" if good else f"{off * 1e2:+.1f} cm") + " against the tape"
    advice = "Measure again, horizontally, from the antennas to the middle of the table; then repeat."
    return Row.judged("axis distance", good, axis.value, axis.sigma, "m", text, advice, "axis")


def _variation_row(fit: CardFit) -> Row:
    """RMS deviation of the speed over a turn, and its harmonics."""
    total = fit.speed_variation
    spectrum = ", ".join(f"{100 * level:.2f}" for level in fit.speed_levels)
    even = total.value <= _MOST_VARIATION + 3 * total.sigma
    text = f"1 to {HARMONICS} times a turn: {spectrum} %"
    advice = "Check the drive; put the table on a level surface; then repeat."
    value, sigma = 100 * total.value, 100 * total.sigma
    return Row.judged("speed variation", even, value, sigma, "%", text, advice, "uneven")
