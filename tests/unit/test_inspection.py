"""The summary of a recording against scans whose noise, clipping, losses and timing are known."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.constants import RANGE_STEP_M, SAMPLE_STEP_S
from tagid.metadata import MotionInfo, RadarInfo, RadarSettings, ResolvedMotion
from tagid.recording.inspection import inspect
from tagid.signal import analytic, noise_power_of
from tagid.storage.importers import read_any

BINS = 576


def burst(at: float, frequency_hz: float = 4e9, width_bins: float = 10.0) -> np.ndarray:
    """(BINS,) Gaussian burst of unit envelope at a bin."""
    n = np.arange(BINS) - at
    return np.exp(-((n / width_bins) ** 2)) * np.cos(2 * np.pi * frequency_hz * SAMPLE_STEP_S * n)


def capture_of(samples: np.ndarray, **more: object) -> Capture:
    return Capture(samples=samples, range_start_m=2.0, range_step_m=RANGE_STEP_M, **more)  # type: ignore[arg-type]


def resting(views: int = 60, amplitude: float = 1000.0, sigma: float = 20.0, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (amplitude * burst(300) + rng.normal(0, sigma, (views, BINS))).astype(np.float32)


@pytest.mark.parametrize(("amplitude", "sigma"), [(1000.0, 20.0), (50.0, 25.0)])
def test_noise_and_snr_follow_their_definition(amplitude: float, sigma: float) -> None:
    summary = inspect(capture_of(resting(200, amplitude, sigma)))
    assert summary.noise == pytest.approx(sigma, rel=0.04)
    assert summary.strongest_over_noise_db == pytest.approx(20 * np.log10(amplitude / sigma), abs=1.0)


def test_analytic_samples_give_the_same_snr_as_their_real_part() -> None:
    samples = resting(100)
    real, analytic_ = inspect(capture_of(samples)), inspect(capture_of(analytic(samples)))
    assert analytic_.strongest_over_noise_db == pytest.approx(real.strongest_over_noise_db, abs=1e-3)
    assert analytic_.noise == pytest.approx(np.sqrt(2) * real.noise, rel=1e-3)


def test_a_turning_object_does_not_pass_for_noise() -> None:
    samples = resting(200)
    for view in range(200):
        samples[view] += 800 * burst(200 + 10 * np.sin(2 * np.pi * view / 100))
    assert inspect(capture_of(samples)).noise == pytest.approx(20.0, rel=0.06)


def test_noise_of_very_few_views_is_roughly_right() -> None:
    for views in (2, 3):
        power = noise_power_of(analytic(resting(views)))
        assert np.sqrt(power / 2) == pytest.approx(20.0, rel=0.3)


def test_clipping_by_the_integration_index() -> None:
    samples = np.zeros((10, 96), np.int32)
    samples[0, :5], samples[1, :3] = 127 * 2**11, -127 * 2**11
    samples[2, :] = 127 * 2**11 - 1
    known = capture_of(samples, radar=RadarInfo(config=RadarSettings(base_integration_index=11)))
    assert inspect(known).clipped_fraction == 8 / 960
    assert inspect(replace(known, samples=samples.astype(np.float32))).clipped_fraction == 8 / 960


@pytest.mark.parametrize("index", [None, 400, -3])
def test_clipping_without_a_usable_index(index: int | None) -> None:
    samples = np.arange(960, dtype=np.int32).reshape(10, 96)
    radar = RadarInfo(config=RadarSettings(base_integration_index=index))
    assert inspect(capture_of(samples, radar=radar)).clipped_fraction == 0
    flat = np.minimum(samples, 949)  # 949..959 became 949
    assert inspect(capture_of(flat, radar=radar)).clipped_fraction == 11 / 960
    assert inspect(capture_of(flat.astype(np.float32), radar=radar)).clipped_fraction is None
    assert inspect(capture_of(flat.astype(np.complex64))).clipped_fraction is None


def test_lost_scans_and_rate() -> None:
    keep = np.array([0, 1, 2, 5, 6, 9])
    capture = capture_of(resting(6), scan_id=keep + 70000, radar_time_ms=np.round(21.573 * keep))
    summary = inspect(capture)
    assert summary.lost_scans == 4
    assert summary.scan_rate_hz == pytest.approx(1 / 0.021573, rel=0.01)
    assert summary.duration_s == pytest.approx(9 * 0.021573, abs=1e-3)
    unnumbered = replace(capture, scan_id=None, radar=RadarInfo(scans_lost=3))
    assert inspect(unnumbered).lost_scans == 3
    assert inspect(replace(unnumbered, radar=RadarInfo())).lost_scans is None
    for reported, lost in ((1, 4), (9, 9)):
        assert inspect(replace(capture, radar=RadarInfo(scans_lost=reported))).lost_scans == lost
    no_clock = inspect(replace(capture, radar_time_ms=None))
    assert (no_clock.scan_rate_hz, no_clock.duration_s) == (None, None)


def test_the_strongest_return_is_tracked_to_a_fraction_of_a_bin() -> None:
    rng = np.random.default_rng(2)
    shift = rng.uniform(-1.0, 1.0, 50)
    samples = np.stack([1000 * burst(300 + s) for s in shift]) + rng.normal(0, 20, (50, BINS))
    result = inspect(capture_of(samples.astype(np.float32))).strongest
    assert abs(result.bin - 300) <= 1
    error = result.bins - result.bins.mean() - (shift - shift.mean())
    assert np.abs(error).max() < 0.35


def test_two_equal_returns_at_rest_do_not_make_the_bin_jump() -> None:
    rng = np.random.default_rng(5)
    samples = 500 * (burst(150) + burst(420)) + rng.normal(0, 40, (80, BINS))
    maxima = np.abs(analytic(samples)).argmax(axis=1)
    assert np.ptp(maxima) > 200  # what a plain maximum does
    result = inspect(capture_of(samples.astype(np.float32))).strongest
    assert result.spread_bins < 2
    assert result.coherence > 0.8


def turning(turns: float, period_s: float = 6.0, sigma: float = 20.0) -> Capture:
    """Two unlike points on a table beside a strong return at rest; 20 scans a second, whole-ms stamps."""
    times = np.arange(int(20 * turns * period_s)) / 20
    angle = 2 * np.pi * times / period_s
    rng = np.random.default_rng(4)
    samples = rng.normal(0, sigma, (len(times), BINS)) + 3000 * burst(80)
    for radius, start, height in ((12.0, 0.3, 300.0), (7.0, 2.0, 200.0)):
        samples += height * np.stack([burst(350 - radius * np.cos(a + start)) for a in angle])
    return capture_of(
        samples.astype(np.float32),
        radar_time_ms=np.floor(1e3 * times + 0.4),
        scan_id=np.arange(len(times)),
    )


@pytest.fixture(scope="module")
def turned() -> Capture:
    return turning(2.5)


def test_the_period_of_a_turning_object_is_found() -> None:
    capture = turning(1.5)
    summary = inspect(capture)
    assert summary.period_s == pytest.approx(6.0, rel=5e-3)
    assert abs(summary.period_s - 6.0) < 5 * max(summary.period_sigma_s, 0.005)
    assert "n-fold" in summary.period_note  # without a nominal speed the ambiguity is reported
    assert summary.changing_range_m == pytest.approx(2.0 + 350 * RANGE_STEP_M, abs=15 * RANGE_STEP_M)
    assert summary.strongest.bin == pytest.approx(80, abs=1)
    timeless = inspect(replace(capture, radar_time_ms=None))
    assert timeless.period_s is None and "times" in timeless.period_note


FOUND = ResolvedMotion(source="data", period_s=6.0)


@pytest.mark.parametrize(
    ("motion", "angles", "sure"),
    [
        (MotionInfo(nominal_rpm=10.0), False, True),
        (MotionInfo(resolved=ResolvedMotion(period_s=6.1)), False, True),
        (MotionInfo(), True, True),
        # What was found in the same scans is no second witness, with angles of it or without.
        (MotionInfo(resolved=FOUND), True, False),
        (MotionInfo(resolved=replace(FOUND, nominal_rpm=10.0)), False, True),
        # A senseless speed in the file is ignored.
        (MotionInfo(nominal_rpm=-3.0), False, False),
        (MotionInfo(nominal_rpm=0.0), False, False),
        (MotionInfo(nominal_rpm=1e9), False, False),
    ],
)
def test_a_known_speed_takes_the_doubt_away(
    turned: Capture, motion: MotionInfo, angles: bool, sure: bool
) -> None:
    angles_rad = 2 * np.pi * turned.radar_time_ms / 6e3 if angles else None
    capture = replace(turned, motion=motion, angles_rad=angles_rad, axis_distance_m=5.0)
    summary = inspect(capture)
    assert summary.period_s == pytest.approx(6.0, rel=5e-3)
    assert ("n-fold" not in summary.period_note) == sure


def test_less_than_a_turn_gives_a_reason_instead_of_a_period() -> None:
    summary = inspect(turning(0.8))
    assert summary.period_s is None and summary.period_note and summary.snr_db is not None


def test_a_scene_at_rest_changes_nothing() -> None:
    for seed in range(4):
        times = np.arange(300) * 50.0
        summary = inspect(capture_of(resting(300, seed=seed), radar_time_ms=times))
        assert (summary.snr_db, summary.period_s) == (None, None)
        assert "nothing changes" in summary.period_note


@pytest.mark.parametrize("dtype", [np.int32, np.float32, np.complex64])
def test_degenerate_recordings_have_a_summary(dtype: type) -> None:
    for shape in ((1, 1), (1, 50), (2, 1), (3, 2)):
        zero, ones = (inspect(capture_of(np.full(shape, fill, dtype))) for fill in (0, 1))
        assert zero.strongest is None and zero.strongest_over_noise_db is None
        assert ones.strongest is not None and ones.period_s is None and ones.period_note


def recording(name: str) -> Capture:
    """A real recording; skips where it is absent."""
    shared = os.environ.get("TAGID_SHARED") or Path(__file__).resolve().parents[2].parent / "shared"
    path = Path(shared) / "data" / "p440" / name
    if not path.exists():
        pytest.skip(f"the real recording {name} is not beside the checkout")
    return read_any(path)


def test_the_real_corner_reflector_stands_still() -> None:
    summary = inspect(recording("corner-reflector-scan08.out"))
    assert (summary.views, summary.bins, summary.lost_scans) == (200, 1152, 0)
    assert 665 <= summary.strongest.bin <= 770
    assert summary.strongest.spread_bins <= 2
    assert summary.clipped_fraction == 0
    assert 90 <= summary.noise <= 160  # what this radar's noise was measured to be at index 11
    assert 25 < summary.strongest_over_noise_db < 40
    assert summary.scan_rate_hz == pytest.approx(1 / 0.021573, rel=2e-3)
    assert summary.period_s is None
    assert summary.period_note


def test_the_real_light_pole_has_a_summary() -> None:
    summary = inspect(recording("light-pole-scan04.out"))
    assert (summary.views, summary.bins, summary.lost_scans) == (200, 1152, 0)
    assert summary.strongest.coherence < 0.5  # the radar moved
    assert summary.clipped_fraction == 0


@pytest.mark.parametrize("level", [1e-44, 1e-38, 1e-20, 1e18])
def test_faint_and_loud_samples_have_a_summary(level: float) -> None:
    """Squares of the faint ones are zero in single precision, those of the loud ones are not finite."""
    samples = np.asarray(resting(12) * (level / 1000), dtype=np.float32)
    summary = inspect(capture_of(samples))
    assert summary.strongest is None or 0 < summary.strongest.coherence <= 1
