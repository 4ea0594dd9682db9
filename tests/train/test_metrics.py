"""The scores: identities that must hold, and images whose score is known."""

from __future__ import annotations

import numpy as np
import pytest

from tagid.errors import DataError, StorageError
from tagid.geometry import ImageGrid
from tagid.imaging.heldout import residual
from tagid.imaging.preprocess import PreprocessSettings, preprocess, select_views
from tagid.imaging.types import Image
from tests.benchmarks.provenance import SHARED
from tests.unit.imaging_scenes import record, turn
from train import metrics

GRID = ImageGrid(0.4, 80)
LPIPS = SHARED / "data" / "lpips" / "lpips_sq.onnx"


def test_the_scale_of_an_image_does_not_count():
    rng = np.random.default_rng(0)
    image, truth = rng.standard_normal((8, 8)) + 1j, rng.random((8, 8))
    for scale in (0.01, 7.0, 100.0):
        assert metrics.mse(scale * image, truth) == pytest.approx(metrics.mse(image, truth), abs=1e-9)


def test_truth_of_a_point_is_a_gaussian_of_a_centimetre():
    row, column = 30, 55
    truth = metrics.truth_image(np.array([[GRID.axis[column], GRID.axis[row]]]), GRID)
    assert truth[row, column] == pytest.approx(1)
    assert truth[row + 2, column] == pytest.approx(np.exp(-0.5))  # two pixels of 5 mm
    # Energy of a 2-D Gaussian of sigma s, squared: pi s^2.
    assert (truth**2).sum() * GRID.step**2 == pytest.approx(np.pi * 0.01**2, rel=1e-3)


def test_blank_scores_the_mean_square_of_the_truth():
    truth = metrics.truth_image(np.array([[GRID.axis[50], GRID.axis[40]]]), GRID)
    blank = metrics.blank(GRID)
    assert metrics.mse(blank.values, truth) == pytest.approx((truth**2).mean())
    assert metrics.psnr(blank.values, truth) == pytest.approx(-10 * np.log10((truth**2).mean()))
    assert metrics.psnr(truth, truth) == float("inf")
    with pytest.raises(DataError):
        metrics.mse(truth[:4], truth)


def test_localisation_counts_and_measures():
    true = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]])
    outcome = np.array([[0.003, 0.0], [0.1, 0.004], [-0.1, -0.1]])
    result = metrics.localise(outcome, true)
    assert (result.detected, result.missed, result.false) == (2, 1, 1)
    assert result.rmse_m == pytest.approx(np.sqrt((0.003**2 + 0.004**2) / 2))
    none = metrics.localise(np.zeros((0, 2)), true)
    assert (none.detected, none.missed, none.false) == (0, 3, 0)
    assert np.isnan(none.rmse_m)


def test_matching_prefers_more_pairs_over_nearer_ones():
    true = np.array([[0.0, 0.0], [0.018, 0.0]])
    result = np.array([[0.017, 0.0], [0.035, 0.0]])
    assert metrics.localise(result, true).detected == 2


def test_peaks_are_picked_strongest_first_and_apart():
    points = np.array([[0.1025, 0.0525], [-0.0975, 0.0025]])
    values = metrics.truth_image(points, GRID, np.array([0.6, 1.0]))
    peaks = metrics.pick_peaks(Image(values.astype(np.complex64), GRID), 5)
    assert np.allclose(peaks, points[::-1], atol=1e-3)
    assert len(metrics.pick_peaks(metrics.blank(GRID), 5)) == 0


def test_held_out_residual_of_the_truth_is_small_and_of_nothing_is_one():
    row, column = 30, 55
    capture = record([(GRID.axis[column], GRID.axis[row])], [3.0], turn(24))
    scans = preprocess(capture, settings=PreprocessSettings(background="none"))
    values = np.zeros((80, 80), np.complex64)
    values[row, column] = 1j  # any scale and phase
    held = select_views(scans, slice(1, None, 2))
    assert residual(held, Image(values, GRID)) < 1e-3
    assert residual(held, metrics.blank(GRID)) == 1
    assert residual(held, Image(values.T.copy(), GRID)) > 0.5


@pytest.mark.skipif(not LPIPS.is_file(), reason="lpips_sq.onnx is not in the shared data folder")
def test_lpips_of_equal_images_is_zero_and_grows_with_the_error():
    pytest.importorskip("onnxruntime")
    truth = metrics.truth_image(np.array([[0.05, 0.0], [-0.1, 0.1]]), GRID)
    near = metrics.truth_image(np.array([[0.055, 0.0], [-0.1, 0.1]]), GRID)
    noise = np.random.default_rng(0).random(truth.shape)
    assert metrics.lpips(truth, truth, LPIPS) == pytest.approx(0, abs=1e-5)
    assert metrics.lpips(near, truth, LPIPS) < metrics.lpips(noise, truth, LPIPS)


def test_lpips_without_its_model_says_so(tmp_path):
    pytest.importorskip("onnxruntime")
    with pytest.raises(StorageError, match="does not exist"):
        metrics.lpips(np.ones((64, 64)), np.ones((64, 64)), tmp_path / "none.onnx")
