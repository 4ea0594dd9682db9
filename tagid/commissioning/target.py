"""Step 3, the reference target: path delay, measured pulse, and system gain."""

from __future__ import annotations

import math
from functools import partial
from typing import Final

import numpy as np

from tagid.capture import Capture
from tagid.commissioning.bench import Bench, radar_facts, reported
from tagid.commissioning.pictures import echo_over_range, wave_and_spectrum
from tagid.commissioning.pulse import EchoPulse, echo_pulse
from tagid.commissioning.room import NOISE_DB
from tagid.commissioning.rows import Level, Row, StepReport
from tagid.commissioning.targets import LEVEL_SIGMA_DB
from tagid.config import data_folder
from tagid.constants import BIN_PS, SPEED_OF_LIGHT
from tagid.errors import ConfigError, DataError, UsageError
from tagid.recording.calibration import (
    ClippedEchoError,
    DelayEstimate,
    TwoEchoesError,
    estimate_delay,
    reference_on,
    usable,
)
from tagid.rig import Measured, installed_profile
from tagid.signal import analytic
from tagid.simulate.budget import LinkBudget, effective_length_m
from tagid.simulate.source import noise_counts

USUAL_DELAY_PS: Final = (9_000.0, 14_500.0)
"""10 to 13 ns are typical with the cables of the kit; a metre more per antenna adds 10 ns."""
_OTHER_CABLE_PS: Final = 100.0
_NEAREST_M: Final = 0.5
_LOOSE_DB: Final = -6.0
"""The budget is uncertain by 6 dB for want of a target whose size is known; a loose connector costs 10."""
_OTHER_DB: Final = 6.0
"""By its uncertainty at most more is received than the budget says of the target."""
_CROSSED_DB: Final = -15.0
_DELAY_BUDGET_PS: Final = 100.0
"""Largest standard error of a useful delay: 15 mm, half of the reader's prior."""
_SHAPE_DB: Final = 1.0
"""The budget is of the nominal pulse; measured ones differ in their peak by so much at the same energy."""
_RESPONSE_SHARE: Final = 0.15
"""Uncertainty of the part of the delay that comes from the target itself."""


def measure_target(bench: Bench) -> StepReport:
    """Record the reference target and measure delay, pulse and gain.

    Raises ConfigError: the empty room was not recorded. UsageError: the target's distance is not known.
    DataError: no echo stands out. DeviceError and its subclasses.
    """
    distance = bench.tape.target_distance_m
    if distance is None:
        raise UsageError(
            "the target's distance is missing",
            f"Measure from the antennas to {bench.target.tape_to}, in a straight line: `distance=METRES`.",
        )
    if bench.report("room") is None:
        raise ConfigError("the empty room was not recorded", "Do the step room first.")
    room, before = bench.recording("room"), bench.value("target", "path_delay_ps")
    capture = bench.take_still("target")
    name = bench.keep_recording("target", capture)
    background = reference_on(room, capture)
    near = _near(distance)
    scan = usable(capture).mean(axis=0) - background
    noise = bench.value("room", "noise_counts") or Measured(1.0, 0.0)
    seen = echo_over_range(capture.ranges_m, scan, noise.value, "target less the empty room")
    try:
        estimate = estimate_delay(capture, distance, bench.tape.error_m, background)
    except DataError as error:
        return reported("target", [near, _no_echo(error)], recording=name, pictures=(seen,))
    at = estimate.echo_ps * 1e-12 * SPEED_OF_LIGHT / 2
    echo = echo_pulse(scan, (at - capture.range_start_m) / capture.range_step_m, bench.target)
    delay = _delay(estimate, echo)
    gain, planned_db = _gain(bench, scan, noise, distance, capture)
    rows = [
        near,
        # What returns more than the target is another echo, however often it is measured.
        _delay_row(delay, before if gain.value <= _OTHER_DB else None),
        *_pulse_rows(echo, noise, scan, capture.views),
        _gain_row(gain, planned_db),
    ]
    config = bench.config
    facts = radar_facts(capture) | {
        "antenna_mode": config["radar.antenna_mode"],
        "transmit_gain": config["radar.gain"],
        "integration": config["radar.integration"],
    }
    return reported(
        "target",
        rows,
        values={"path_delay_ps": delay, "system_gain_db": gain},
        facts=facts,
        pulse=tuple(round(float(sample), 5) for sample in echo.pulse.samples),
        recording=name,
        pictures=(seen, *wave_and_spectrum(echo.pulse.samples)),
    )


def _near(distance: float) -> Row:
    good = distance >= _NEAREST_M
    text = "" if good else "too near: the antennas see it from different sides"
    advice = f"Put it {_NEAREST_M:g} m or more away, better 1 to 2 m, and repeat."
    return Row.judged("target distance", good, distance, None, "m", text, advice, "near")


def _no_echo(error: DataError) -> Row:
    if isinstance(error, ClippedEchoError):
        code, advice = "gain", error.remedy
    elif isinstance(error, TwoEchoesError):
        code = "two-echoes"
        advice = (
            "Remove what else was put there since the room was recorded, or use a larger target; then repeat."
        )
    else:
        code = "no-echo"
        advice = "Check both antenna cables and that both antennas stand upright (same polarisation); then: "
        advice += error.remedy
    return Row("echo", Level.FAIL, text=error.message, advice=advice, code=code)


def _delay(estimate: DelayEstimate, echo: EchoPulse) -> Measured:
    """The delay of a point for the measured pulse.

    The shape of the pulse is no error where the pulse is stored with the delay.
    """
    grid = BIN_PS / math.sqrt(12)
    of_target = _RESPONSE_SHARE * abs(echo.delay_ps)
    sigma = math.sqrt(estimate.tape_ps**2 + estimate.noise_ps**2 + grid**2 + of_target**2)
    return Measured(estimate.delay_ps - echo.delay_ps, sigma)


def _delay_row(delay: Measured, before: Measured | None) -> Row:
    """The path delay; an unusual one is taken when it is measured as `before`."""
    row = partial(Row, "path delay", value=delay.value, sigma=delay.sigma, unit="ps")
    if delay.sigma > _DELAY_BUDGET_PS:
        return row(Level.FAIL, text="too uncertain", advice="Measure the distance to 5 mm.", code="delay")
    odd = _unusual(delay)
    if odd and (before is None or not _agree(delay, before)):
        return row(
            Level.FAIL,
            text=f"{odd}: another cable length or a wrong distance",
            advice="Check distance to the target and cables: a metre more at each antenna adds 10 ns. "
            "If both are right, repeat this step: the same delay is then taken.",
            code="cable",
        )
    return row(Level.PASS, text=f"{odd}, measured twice" if odd else "for the measured pulse")


def _unusual(delay: Measured) -> str:
    """How a delay differs from that of the profile so far, or from usual ones; empty if it does not."""
    previous = installed_profile(data_folder())
    if previous is not None:
        change = delay.value - previous.path_delay_ps.value
        same = _agree(delay, previous.path_delay_ps)
        return "" if same else f"{change:+.0f} ps against the profile of {previous.day}"
    low, high = USUAL_DELAY_PS
    usual = low <= delay.value <= high
    return "" if usual else f"outside the usual {low / 1e3:g} to {high / 1e3:g} ns"


def _agree(delay: Measured, other: Measured) -> bool:
    """Whether two delays are of the same cables."""
    apart = abs(delay.value - other.value)
    return apart <= max(_OTHER_CABLE_PS, 3 * math.hypot(delay.sigma, other.sigma))


def _pulse_rows(echo: EchoPulse, noise: Measured, scan: np.ndarray, scans: int) -> list[Row]:
    peak = float(np.abs(analytic(scan[None].astype(np.float32))).max())
    error = noise.value / math.sqrt(scans) / peak
    return [
        Row(
            "pulse",
            Level.PASS,
            echo.centre_hz / 1e9,
            max(error, 1e-3),
            "GHz",
            f"band {echo.low_hz / 1e9:.2f} to {echo.high_hz / 1e9:.2f} GHz at -10 dB, "
            f"envelope {echo.width_s * 1e9:.2f} ns, group delay spread {echo.group_delay_s * 1e12:.0f} ps",
        ),
        Row(
            "ringing", Level.PASS, echo.ringing_db, 20 * math.log10(1 + error * 10), "dB", "later than 1.2 ns"
        ),
    ]


def _gain(
    bench: Bench, scan: np.ndarray, noise: Measured, distance: float, capture: Capture
) -> tuple[Measured, float]:
    """Echo received over that of the link budget with its assumed losses, and the budget's SNR, dB."""
    config = bench.config
    budget = LinkBudget(transmit_gain=config["radar.gain"], integration=config["radar.integration"])
    planned = budget.snr_db(effective_length_m(bench.target), distance)
    air = capture.ranges_m > distance
    peak = float(np.abs(analytic(scan[None].astype(np.float32)))[0][air].max())
    usual = noise_counts(config["radar.integration"])
    # The noise is the scale of counts, unless an interference raised it, which the step room reports.
    scale = noise.value if abs(20 * math.log10(noise.value / usual)) <= NOISE_DB else usual
    measured = 20 * math.log10(peak / scale)
    tape = 40 / math.log(10) * bench.tape.error_m / distance
    random = 20 / math.log(10) * noise.value / math.sqrt(capture.views) / peak
    sigma = math.sqrt(LEVEL_SIGMA_DB**2 + _SHAPE_DB**2 + tape**2 + random**2)
    return Measured(measured - planned, sigma), planned


def _gain_row(gain: Measured, planned_db: float) -> Row:
    row = partial(Row, "system gain", value=gain.value, sigma=gain.sigma, unit="dB")
    text = (
        f"{planned_db + gain.value:.0f} dB over the noise received, {planned_db:.0f} dB planned over "
        f"kT0B + {LinkBudget.noise_figure_db:g} dB (`tagid plan`)"
    )
    if gain.value > _OTHER_DB:
        return row(
            Level.NOTE,
            text=f"{text}: more than this target returns",
            advice="Another echo was taken for it: remove what stands near it, check its kind, its distance "
            "and all four connectors, then repeat.",
            code="other-echo",
        )
    if gain.value >= _LOOSE_DB:
        return row(Level.PASS, text=text)
    if gain.value < _CROSSED_DB:
        what, code = "the polarisations are crossed", "polarisation"
        advice = "Turn both antennas upright, then repeat; if they are, an antenna is not connected."
    else:
        what, code = "an antenna or cable is loose", "loose-antenna"
        advice = "Tighten all four connectors, point both antennas at the target, then repeat."
    return row(Level.FAIL, text=f"{text}: {what}", advice=advice, code=code)
