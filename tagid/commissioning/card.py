"""Step 5, the test card: one turn that is read as an object is, under a name that no object can have."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from tagid.capture import Capture
from tagid.commissioning.bench import Bench, radar_facts, reported
from tagid.commissioning.pictures import Picture
from tagid.commissioning.pulse import received_from
from tagid.commissioning.rows import Level, Row, StepReport
from tagid.commissioning.turning import CARD_REFLECTOR, MIRRORED, MISSING_ADVICE
from tagid.motion.urls import open_motion
from tagid.operate.workplace import TURN_S, Workplace
from tagid.pipeline.identify import identify
from tagid.pipeline.prepared import PreparedCapture, load_capture
from tagid.pipeline.settings import ImagingSettings
from tagid.planning.plan import Setup, gap
from tagid.reading.spectra import MODEL_ERROR
from tagid.recording.inspection import inspect
from tagid.rig import Measured
from tagid.simulate.budget import LinkBudget
from tagid.simulate.specification import BodySpec, ReflectorSpec
from tagid.tags.layouts.layout import Layout, rotation_matrix
from tagid.tags.layouts.test_card import NAME, test_card
from tagid.types import Floats

if TYPE_CHECKING:
    from tagid.reading.reading import Reading

_SHARES: Final = (("all", 1), ("half", 2), ("a quarter", 4))
_MOST_RMS_M: Final = 1e-3
_LEVEL_DB: Final = 3.0
_EXTENT_M: Final = 0.3
_MIRRORED: Final = f"{NAME}-mirrored"


def read_card(bench: Bench) -> StepReport:
    """Record one turn of the test card and read it. Raises DeviceError and its subclasses, DataError."""
    axis = bench.value("turning", "axis_distance_m")
    period = bench.value("turning", "period_s")
    place = bench.workplace(**({} if axis is None else {"motion__axis_distance_m": axis.value}))
    seconds = TURN_S if period is None else max(10.0, 3 * period.value)
    recorded = bench.take_turn(place, place.plan(max_seconds=seconds), "one turn")
    capture = recorded.capture
    name = bench.keep_file("card", recorded.path)
    prepared = _prepared(bench, place, capture, period)
    rows, readings = [], []
    for share, every in _SHARES:
        given = prepared.given.select(slice(None, None, every))
        reading = _read(PreparedCapture(given, ImagingSettings(extent_m=prepared.settings.extent_m)))
        readings.append(reading)
        rows.append(_named_row(share, given.views, reading))
    marks, positions = _places(readings[0])
    rows.append(_places_row(marks, positions))
    rows.append(_residual_row(readings[0], bench.value("turning", "speed_variation"), capture))
    rows.append(_level_row(bench, place.config["motion.axis_distance_m"], capture, period))
    plan = Picture.of("mm: marks (rings) and reflectors (dots)", *_drawn(marks, positions), dots=True)
    return reported("card", rows, facts=radar_facts(capture), recording=name, pictures=(plan,))


def _prepared(bench: Bench, place: Workplace, capture: Capture, period: Measured | None) -> PreparedCapture:
    """A recording of the test card for imaging: the measured period and pulse, one turn of views."""
    pulse = bench.pulse()
    if pulse is not None:
        capture = replace(capture, pulse=received_from(pulse, CARD_REFLECTOR)[0])
    motion = open_motion(place.config["motion.url"])
    if period is not None and not motion.measures:
        way = "cw" if motion.direction < 0 else "ccw"
        place = bench.workplace(motion__url=f"free?rpm={60 / period.value:.6f}&direction={way}")
    loading = replace(place.loading(), extent_m=_EXTENT_M)
    settings = ImagingSettings(extent_m=_EXTENT_M)
    return PreparedCapture(load_capture(capture, loading), settings)


def _read(prepared: PreparedCapture) -> Reading:
    """The card's reading, where its mirror image is the other candidate."""
    mirrored = replace(test_card().mirrored(), name=_MIRRORED)
    answer = identify(prepared, [test_card(), mirrored])
    assert answer.reading is not None
    return answer.reading


def _named_row(share: str, views: int, reading: Reading) -> Row:
    name, basis = f"read at {share} of the views", f"{views} views; a name needs {reading.needed:.0f} nats"
    if reading.status == "identified" and reading.layout == NAME:
        return Row(name, Level.PASS, reading.lead, unit="nats", text=basis)
    if reading.status == "identified":
        text, advice, code = *MIRRORED, "mirrored"
    elif reading.missing:
        text = f"{reading.missing} of the card's {test_card().size} reflectors missing"
        advice, code = MISSING_ADVICE, "missing-reflector"
    else:
        advice = reading.advice or "Check the card, then repeat the step turning."
        text, code = reading.reason, "not-named"
    return Row(name, Level.FAIL, reading.lead, None, "nats", f"{basis}: {text}", advice, code)


def _places(reading: Reading) -> tuple[Floats, Floats]:
    """(marks, 2) as the card lies, and (reflectors, 2) as they were found, m."""
    positions = np.array([[r.x_m, r.y_m] for r in reading.reflectors if r.matched]).reshape(-1, 2)
    layout: Layout = test_card() if reading.layout != _MIRRORED else test_card().mirrored()
    return layout.placed(math.radians(reading.rotation_deg), np.array(reading.centre_m)), positions


def _drawn(*point_sets: Floats) -> list[tuple[Floats, Floats]]:
    return [(1e3 * points[:, 0], 1e3 * points[:, 1]) for points in point_sets]


def _places_row(marks: Floats, positions: Floats) -> Row:
    """RMS distance of the reflectors from their marks, after the best turn and shift."""
    if len(positions) < len(marks):
        return Row("positions", Level.NOTE, text="not compared: not every reflector was found")
    order = np.argmin(np.linalg.norm(positions[None] - marks[:, None], axis=2), axis=1)
    rest = _aligned(positions[order], marks)
    rms = float(np.sqrt((rest**2).sum(axis=1).mean()))
    # Four points, less turn and shift: five of eight coordinates are free.
    sigma = rms / math.sqrt(2 * (2 * len(marks) - 3))
    advice = "Put every reflector exactly on its mark, check the printed 100 mm, and repeat."
    good = rms <= _MOST_RMS_M
    return Row.judged(
        "positions", good, 1e3 * rms, 1e3 * sigma, "mm rms", "from the marks", advice, "positions"
    )


def _aligned(positions: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """Residuals (K, 2) of marks that are turned and shifted onto positions, m."""
    a, b = positions - positions.mean(axis=0), marks - marks.mean(axis=0)
    turn = np.vdot(b[:, 0] + 1j * b[:, 1], a[:, 0] + 1j * a[:, 1])
    return np.asarray(a - b @ rotation_matrix(float(np.angle(turn))).T)


def _residual_row(reading: Reading, variation: Measured | None, capture: Capture) -> Row:
    """What the card's reflectors leave of the echo, against the reader's model error and the measured wobble.

    An error e cos(angle) of the angle moves a reflector on radius r by r e / 2 at twice the turn's frequency,
    and by a constant, which its free phase takes.
    """
    if not reading.hypotheses:
        return Row("residual", Level.NOTE, text="not compared: nothing was read")
    unexplained = reading.hypotheses[0].unexplained
    radius_m = float(np.sqrt((test_card().positions ** 2).sum(axis=1).mean()))
    kappa = 4 * math.pi / capture.wavelength_m
    error = Measured(0.0, 0.0) if variation is None else variation
    by_wobble = (kappa * radius_m * error.value / 2) ** 2
    expected = MODEL_ERROR**2 + by_wobble
    off = 10 * math.log10(max(unexplained, 1e-6) / expected)
    sigma = 20 / math.log(10) * by_wobble / expected * error.sigma / max(error.value, 1e-9)
    text = (
        f"{100 * unexplained:.2f} % of the changing echo measured, at most {100 * expected:.2f} % predicted"
    )
    advice = "Take away what turns with the card, put the table level, then repeat."
    good = off <= _LEVEL_DB
    return Row.judged("residual against prediction", good, off, sigma, "dB", text, advice, "residual")


def _level_row(bench: Bench, distance: float, capture: Capture, period: Measured | None) -> Row:
    """The SNR of the recording against that predicted with the measured gain."""
    gain = bench.value("target", "system_gain_db") or Measured(0.0, 6.0)
    summary = inspect(capture)
    if summary.snr_db is None or summary.noise is None:
        return Row(
            "SNR against prediction", Level.FAIL, text="nothing changes beyond the noise", code="no-echo"
        )
    budget = LinkBudget(
        transmit_gain=bench.config["radar.gain"],
        integration=bench.config["radar.integration"],
        loss_db=LinkBudget.loss_db - gain.value,
    )
    rpm = 2.0 if period is None else 60 / period.value
    setup = Setup(
        test_card(),
        ReflectorSpec("octahedron", CARD_REFLECTOR.size_m),
        BodySpec(),
        distance,
        rpm,
        budget,
        pulse=bench.pulse(),
    )
    level_gap = gap(capture, summary.noise, summary.snr_db, setup)
    off = level_gap.measured_db - level_gap.planned_db
    text = f"{level_gap.measured_db:.1f} dB measured, {level_gap.planned_db:.1f} dB predicted"
    advice = f"{level_gap.cause or 'Point both antennas at the card'}; then repeat."
    good = abs(off) <= _LEVEL_DB
    return Row.judged("SNR against prediction", good, off, gain.sigma, "dB", text, advice, "level")
