"""The curves of a recording against synthetic scans of known envelope, frequency and timing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tagid.capture import Capture
from tagid.constants import RANGE_STEP_M, SAMPLE_STEP_S
from tagid.errors import StorageError
from tagid.recording.curves import RecordingCurves, slow_time
from tagid.report.charts import draw_recording, resample_views
from tagid.signal import analytic


def burst(bins: int, at: float, frequency_hz: float, width_bins: float = 12.0) -> np.ndarray:
    """(bins,) Gaussian burst of unit envelope at a bin."""
    n = np.arange(bins) - at
    return np.exp(-((n / width_bins) ** 2)) * np.cos(2 * np.pi * frequency_hz * SAMPLE_STEP_S * n)


def capture_of(samples: np.ndarray, **more: object) -> Capture:
    return Capture(samples=samples, range_start_m=1.0, range_step_m=RANGE_STEP_M, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("bins", [480, 481])
def test_analytic_signal_of_a_burst_is_its_exponential(bins: int) -> None:
    n = np.arange(bins) - 200
    expected = np.exp(-((n / 12) ** 2) + 0.5j * np.pi * n) * np.array([[1.0], [-3j]]) + np.array([[0.0], [7]])
    samples = expected.real.astype(np.float32)
    np.testing.assert_allclose(analytic(samples), expected, atol=1e-5)
    np.testing.assert_array_equal(analytic(expected.astype(np.complex64)), expected.astype(np.complex64))


def test_a_strong_first_bin_does_not_appear_at_the_far_end() -> None:
    """Circularly, the last bin would stand at -8 dB of an echo that the window's start cuts."""
    envelope = np.abs(analytic(burst(480, 0, 4e9, 3.0)[None]))[0]
    assert 20 * np.log10(envelope[-60:].max() / envelope.max()) < -40
    assert envelope[0] == pytest.approx(1.0, abs=0.35)


@pytest.mark.parametrize("frequency_hz", [3.2e9, 4.0e9, 4.7e9])
@pytest.mark.parametrize("complex_samples", [False, True])
def test_spectrum_peaks_at_the_true_frequency(frequency_hz: float, complex_samples: bool) -> None:
    samples = np.tile(burst(960, 400, frequency_hz, 30), (3, 1))
    data = analytic(samples) if complex_samples else samples.astype(np.float32)
    curves = RecordingCurves.of(capture_of(data))
    result = curves.frequency_hz[curves.spectrum.argmax()]
    assert result == pytest.approx(frequency_hz, abs=1.1 / (960 * SAMPLE_STEP_S))


def test_envelopes_give_height_and_range() -> None:
    scans = np.stack([a * burst(480, 200, 4e9) for a in (100.0, 200.0, 600.0)]).astype(np.float32)
    curves = RecordingCurves.of(capture_of(scans))
    assert curves.range_m[curves.mean_envelope.argmax()] == pytest.approx(1.0 + 200 * RANGE_STEP_M)
    assert curves.mean_envelope.max() == pytest.approx(300, rel=0.01)
    assert curves.max_envelope.max() == pytest.approx(600, rel=0.01)


def test_slow_time_takes_the_best_clock() -> None:
    samples = np.ones((3, 8), np.float32)
    radar, host = np.array([5.0, 26.0, 48.0]), np.array([1, 2, 4], np.int64) * 10**9
    both = capture_of(samples, radar_time_ms=radar, host_time_ns=host)
    np.testing.assert_allclose(slow_time(both)[0], [0, 0.021, 0.043])
    np.testing.assert_allclose(slow_time(replace(both, radar_time_ms=radar[::-1].copy()))[0], [0, 1, 3])
    position, label = slow_time(capture_of(samples))
    assert (position.tolist(), label) == ([0, 1, 2], "view")


def test_reduction_keeps_a_flash_and_shows_a_gap() -> None:
    envelope = np.ones((1000, 400), np.float32)
    envelope[333, 123] = 50
    position = np.arange(1000.0)
    position[500:] += 200
    picture, gaps = resample_views(envelope, position, rows=120, columns=40)
    assert picture.shape == (120, 40)
    assert picture[333 // 10, 12] == 50
    assert np.count_nonzero(picture > 1) == 1
    assert gaps.nonzero()[0].tolist() == list(range(50, 70))


def test_few_views_are_stretched_in_order() -> None:
    envelope = np.array([[1.0, 2.0], [3.0, 4.0]], np.float32)
    picture, gaps = resample_views(envelope, np.array([0.0, 1.0]), rows=10, columns=30)
    assert picture.tolist() == [[1, 2]] * 5 + [[3, 4]] * 5
    assert not gaps.any()


def test_the_sinogram_shows_a_return_at_its_range(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    scans = 1000 * burst(576, 432, 4e9) + rng.normal(0, 5, (40, 576))
    draw_recording(capture_of(scans.astype(np.float32)), tmp_path / "show.png", "a scan")
    with Image.open(tmp_path / "show.png") as picture:
        assert picture.size == (1000, 1330)
        colours = np.asarray(picture.convert("RGB")).astype(int)
    row = colours[680, 120:880]  # through the middle of the sinogram
    brightest = np.abs(row - (253, 231, 37)).sum(axis=1) < 30
    assert brightest.nonzero()[0].mean() == pytest.approx((432 + 0.5) / 576 * 760, abs=3)


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (5, 1), (2, 2)])
@pytest.mark.parametrize("dtype", [np.int32, np.complex64])
def test_degenerate_recordings_are_drawn(tmp_path: Path, shape: tuple[int, int], dtype: type) -> None:
    for fill in (0, 7):
        draw_recording(capture_of(np.full(shape, fill, dtype)), tmp_path / "show.png")
    same_time = capture_of(np.ones((3, 4), np.int32), radar_time_ms=np.array([0.0, 0.0, 9.0]))
    draw_recording(same_time, tmp_path / "show.png")
    assert (tmp_path / "show.png").stat().st_size > 1000


def test_an_unwritable_folder_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(StorageError):
        draw_recording(capture_of(np.ones((2, 8), np.int32)), tmp_path / "no" / "show.png")


def test_what_rests_disappears_from_the_changing_part() -> None:
    turning = np.stack([100 * burst(480, 300 + 5 * np.sin(2 * np.pi * v / 40), 4e9) for v in range(40)])
    capture = capture_of((5000 * burst(480, 100, 4e9) + turning).astype(np.float32))
    curves = RecordingCurves.of(capture, changing_only=True)
    assert curves.mean_envelope.argmax() == 100
    assert curves.changing_envelope[:200].max() < 1
    assert abs(int(curves.changing_envelope.argmax()) - 300) < 12
    assert curves.envelope[:, :200].max() < 1
    assert curves.envelope[:, 200:].max() > 100


def test_the_spectrum_of_a_longer_recording_is_no_larger() -> None:
    samples = burst(480, 200, 4e9)[None].astype(np.float32)
    short, long = (RecordingCurves.of(capture_of(np.tile(samples, (n, 1)))).spectrum for n in (3, 300))
    np.testing.assert_allclose(long, short, rtol=1e-5, atol=1e-5 * short.max())
