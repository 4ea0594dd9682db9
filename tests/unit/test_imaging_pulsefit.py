"""The pulse estimated from the scans alone: found where it is not the nominal one, left alone where it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tagid.capture import Capture, Pulse
from tagid.geometry import ImageGrid
from tagid.imaging.pulsefit import estimate_pulse
from tagid.simulate import Acquisition, Scene, simulate_capture
from tagid.storage.importers import read_any
from tagid.waveform import nominal_pulse, pulse_at
from tests.benchmarks.provenance import SHARED

GRID = ImageGrid(0.5, 72)
RECORDED = SHARED / "data" / "p440"
POINTS = np.array([[0.12, -0.05], [-0.08, 0.13], [0.02, 0.18]])


def ringing() -> Pulse:
    """A pulse off the nominal carrier, with a ring and a late echo, its time zero before its peak."""
    t = np.arange(-500, 501) * 4e-12
    atoms = ((1.0, 0.1e-9, 4.1e9, 0.3e-9), (0.35, 0.8e-9, 3.7e9, 0.4e-9), (0.3, 1.9e-9, 3.8e9, 0.4e-9))
    parts = (
        a * np.exp(-((t - d) ** 2) / (2 * s**2)) * np.cos(2 * np.pi * f * (t - d)) for a, d, f, s in atoms
    )
    return Pulse(np.asarray(sum(parts)), 4e-12)


def recorded(pulse: Pulse | None, views: int = 36, snr_db: float = 20.0) -> Capture:
    acquisition = Acquisition(views=views, snr_db=snr_db, pulse=pulse)
    return simulate_capture(Scene.of_points(POINTS), acquisition, seed=4)[0]


def match(a: Pulse, b: Pulse) -> tuple[float, float, float]:
    """Largest normalised |correlation|, its lag (s), and its phase there (rad)."""
    time = np.arange(-1000, 1001) * 4e-12
    x, y = pulse_at(a, time), pulse_at(b, time)
    both = np.fft.fftshift(np.fft.ifft(np.fft.fft(x, 4096) * np.fft.fft(y, 4096).conj()))
    at = int(np.argmax(np.abs(both)))
    norm = np.linalg.norm(x) * np.linalg.norm(y)
    return float(np.abs(both[at]) / norm), (at - 2048) * 4e-12, float(np.angle(both[at]))


def test_a_ringing_pulse_is_found_under_the_stated_convention() -> None:
    pulse = ringing()
    result = estimate_pulse(recorded(pulse), GRID, "none")
    assert result.taken
    assert result.residual < 0.6 * result.assumed_residual
    assert match(pulse, nominal_pulse())[0] < 0.9
    assert match(pulse, result.pulse)[0] > 0.98
    # Of all delays and phases: the best and positive match with the assumed pulse; peak of the envelope 1.
    _, lag, phase = match(result.pulse, nominal_pulse())
    assert abs(lag) < 6e-12
    assert abs(phase) < 0.25
    envelope = np.abs(pulse_at(result.pulse, np.arange(-800, 801) * 2e-12))
    assert envelope.max() == pytest.approx(1, abs=0.01)


def test_the_mean_over_the_views_may_be_taken_off() -> None:
    result = estimate_pulse(recorded(ringing()), GRID, "mean")
    assert result.taken
    assert match(ringing(), result.pulse)[0] > 0.97


def test_progress_counts_the_scenes_up_to_the_end() -> None:
    reported: list[tuple[int, int]] = []
    estimate_pulse(recorded(None), GRID, "none", progress=lambda *step: reported.append(step))
    assert len(reported) > 5
    assert [done for done, _ in reported] == sorted(done for done, _ in reported)
    assert reported[-1][0] == reported[-1][1]
    assert len({total for _, total in reported}) == 1


@pytest.mark.parametrize("stated", [False, True])
def test_a_pulse_that_is_right_is_kept(stated: bool) -> None:
    pulse = ringing() if stated else None
    capture = replace(recorded(pulse), pulse=pulse)
    result = estimate_pulse(capture, GRID, "none")
    if result.taken:  # then it must be the same pulse again
        assert match(result.pulse, pulse or nominal_pulse())[0] > 0.985
    else:
        assert result.pulse is pulse or np.array_equal(result.pulse.samples, nominal_pulse().samples)


@pytest.mark.skipif(not RECORDED.is_dir(), reason="the recordings are not in the shared data folder")
def test_the_pulse_of_a_real_recording_is_the_one_measured_there() -> None:
    """A corner reflector that stands still: the estimate is like the pulse derived from that station."""
    capture = read_any(RECORDED / "corner-reflector-scan08.out").select(np.arange(0, 200, 8))
    antenna = np.tile([11.616, 0.0, 0.0], (capture.views, 1))
    still = replace(capture, antenna_positions_m=antenna, angles_rad=None, axis_distance_m=None)
    result = estimate_pulse(still, ImageGrid(0.3, 41), "none", 0.0)
    with np.load(RECORDED / "pulse.npz", allow_pickle=False) as file:
        measured = Pulse(file["cr08"], float(file["dt_ns"]) * 1e-9)
    assert result.taken
    assert match(measured, nominal_pulse())[0] < 0.9
    assert match(measured, result.pulse)[0] > 0.97


def test_noise_and_too_few_views_change_nothing() -> None:
    capture = recorded(ringing())
    rng = np.random.default_rng(0)
    noise = replace(capture, samples=rng.standard_normal(capture.samples.shape).astype(np.float32))
    assert not estimate_pulse(noise, GRID, "none").taken
    few = estimate_pulse(capture.select(np.arange(0, 36, 6)), GRID, "none")
    assert not few.taken
    assert np.isnan(few.residual)
