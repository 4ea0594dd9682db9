"""The delay is found with the right sign and an honest uncertainty, and the empty scene fits any window."""

from __future__ import annotations

import os
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from tagid.capture import Capture, Pulse, ViewFlag
from tagid.constants import RANGE_STEP_M, SAMPLE_STEP_S, SPEED_OF_LIGHT
from tagid.errors import DataError, UsageError
from tagid.metadata import RadarInfo, RadarSettings
from tagid.radar.settings import RadarConfig
from tagid.recording.calibration import (
    calibration_window,
    estimate_delay,
    make_reference,
    reference_on,
    without_background,
)
from tagid.waveform import nominal_pulse, pulse_at

DISTANCE = 2.0
DELAY_PS = 11_300.0
CONFIG = calibration_window([DISTANCE], 25_000, RadarConfig()).quantised()
PULSES = Path(os.environ.get("TAGID_SHARED", Path(__file__).resolve().parents[3] / "shared"))


def echo(time_ps: float, config: RadarConfig = CONFIG, pulse: Pulse | None = None) -> np.ndarray:
    t = config.scan_start_ps * 1e-12 + SAMPLE_STEP_S * np.arange(config.samples)
    return pulse_at(pulse or nominal_pulse(), t - time_ps * 1e-12).real


def capture(
    mean: np.ndarray, noise: float = 120.0, scans: int = 100, seed: int = 1, **config: int
) -> Capture:
    rng = np.random.default_rng(seed)
    settings = {**asdict(CONFIG), **config}
    return Capture(
        np.rint(mean + noise * rng.standard_normal((scans, len(mean)))).astype(np.int32),
        settings["scan_start_ps"] * 1e-12 * SPEED_OF_LIGHT / 2,
        RANGE_STEP_M,
        flags=np.array([ViewFlag.FIRST] + [0] * (scans - 1), np.uint8),
        radar=RadarInfo(config=RadarSettings(**settings), cable_delay_ps=0.0),
    )


def target(distance: float = DISTANCE, amplitude: float = 5000.0, **more) -> Capture:
    air = 2e12 * distance / SPEED_OF_LIGHT
    return capture(amplitude * echo(air + DELAY_PS), **more)


@pytest.mark.parametrize("distance", [0.8, 2.0, 2.37])
def test_the_delay_is_what_the_air_does_not_explain(distance: float) -> None:
    result = estimate_delay(target(distance), distance, tape_error_m=0.0)
    assert result.delay_ps == pytest.approx(DELAY_PS, abs=4 * result.sigma_ps)
    assert result.sigma_ps < 8
    # Taping a centimetre too far takes 67 ps off the delay: the sum is what the radar saw.
    wrong = estimate_delay(target(distance), distance + 0.01, tape_error_m=0.01)
    assert wrong.delay_ps - result.delay_ps == pytest.approx(-66.7, abs=1)
    assert wrong.sigma_ps == pytest.approx(66.7, rel=0.02)


def test_the_uncertainty_from_noise_is_the_scatter() -> None:
    results = [estimate_delay(target(amplitude=160, seed=s), DISTANCE, 0.0) for s in range(24)]
    scatter = np.std([f.delay_ps for f in results])
    reported = np.sqrt(np.mean([f.noise_ps**2 for f in results]))
    assert 0.5 < scatter / reported < 2
    assert abs(np.mean([f.delay_ps for f in results]) - DELAY_PS) < 4 * scatter / np.sqrt(24)


def test_the_empty_scene_is_taken_off() -> None:
    """Leakage ten times the target, right where its echo would be with less delay."""
    leakage = 50_000 * echo(15_000.0)
    empty = make_reference(capture(leakage, seed=2))
    assert empty.radar.reference.noise_std == pytest.approx(120, rel=0.05)
    both = capture(leakage + 5000 * echo(2e12 * DISTANCE / SPEED_OF_LIGHT + DELAY_PS))
    alone = estimate_delay(both, DISTANCE)
    assert abs(alone.delay_ps - DELAY_PS) > 5000  # the leakage was mistaken for the target
    result = estimate_delay(both, DISTANCE, empty=reference_on(empty, both))
    assert result.delay_ps == pytest.approx(DELAY_PS, abs=5)


def test_what_cannot_be_told_is_an_error() -> None:
    with pytest.raises(DataError, match="stands out"):
        estimate_delay(capture(np.zeros(CONFIG.samples)), DISTANCE)
    two = 4000 * echo(20_000) + 5000 * echo(26_000)
    with pytest.raises(DataError, match=r"20\.0\d ns and 2[56]\.\d\d ns"):
        estimate_delay(capture(two), DISTANCE)
    clipped = np.clip(400_000 * echo(25_000), -127 << 11, 127 << 11)
    with pytest.raises(DataError, match="clipped"):
        estimate_delay(capture(clipped, noise=0.0), DISTANCE)
    with pytest.raises(DataError, match="do not reach"):
        estimate_delay(target(), 40.0)
    with pytest.raises(DataError, match="too few"):
        estimate_delay(target(scans=8), DISTANCE)
    with pytest.raises(UsageError):
        estimate_delay(target(), float("nan"))


def test_the_reference_fits_a_window_that_starts_elsewhere() -> None:
    """Another start, integration and cable delay: the empty scene is subtracted to the noise of its mean."""
    room = [(12_000.0, 30_000.0), (15_500.0, -9000.0), (23_000.0, 4000.0)]
    wide = sum(a * echo(t) for t, a in room)
    reference = make_reference(capture(wide, noise=0.0))
    other = RadarConfig(11_017, 17_000, base_integration_index=12).quantised()
    scene = 2 * sum(a * echo(t, other) for t, a in room)
    there = capture(scene, noise=0.0, **asdict(other))
    delayed = replace(there.radar, cable_delay_ps=DELAY_PS)
    there = replace(there, range_start_m=other.range_start_m(DELAY_PS), radar=delayed)
    remaining = without_background(there, reference)
    assert np.abs(remaining.samples).max() < 0.005 * np.abs(scene).max()
    assert remaining.radar.background_reference.uuid == reference.uuid
    with pytest.raises(DataError, match="transmit_gain"):
        without_background(capture(wide, transmit_gain=9), reference)
    late = capture(wide, **asdict(replace(other, scan_start_ps=60_000, scan_stop_ps=90_000)))
    with pytest.raises(DataError, match="cover"):
        without_background(late, reference)


@pytest.mark.skipif(not (PULSES / "data/p440/pulse.npz").is_file(), reason="no measured pulses")
def test_real_pulses_give_one_delay_at_all_distances_and_own_up_to_their_shape() -> None:
    with np.load(PULSES / "data/p440/pulse.npz") as file:
        step = float(file["dt_ns"]) * 1e-9
        pulses = [Pulse(file[name], step) for name in file.files if file[name].size > 1]
    assert len(pulses) == 7
    for pulse in pulses:
        results = []
        for distance in (DISTANCE, 1.4):
            seen = echo(2e12 * distance / SPEED_OF_LIGHT + DELAY_PS, pulse=pulse)
            seen *= 3000 / np.abs(pulse.samples).max()
            results.append(estimate_delay(capture(seen), distance, tape_error_m=0.0))
        # Calibrated at one distance, a target at another is where it is.
        assert results[0].delay_ps == pytest.approx(results[1].delay_ps, abs=8)
        # The pulse's envelope peaks elsewhere than the filter matched to the nominal one says.
        fine = np.arange(-4000, 4000)
        middle_ps = fine[np.abs(pulse_at(pulse, fine * 1e-12)).argmax()]
        assert abs(results[0].delay_ps - middle_ps - DELAY_PS) < 3 * results[0].sigma_ps
