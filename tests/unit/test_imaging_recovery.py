"""Sparse and linear solutions, the restoring beam, and the focus of the axis distance, on known points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from imaging_scenes import FC, C, helix, record, scans_from, turn
from scipy.special import j0

from tagid.errors import UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.autofocus import focus_axis_distance, sharpness
from tagid.imaging.backprojection import backproject
from tagid.imaging.heldout import Prediction, residual
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.restore import beam_sigma_m, restore
from tagid.imaging.sparse import SparseSettings, column_norm, omp, sparse_recovery
from tagid.imaging.types import Image
from train.metrics import localise, peak_to_sidelobe_db, pick_peaks

GRID = ImageGrid(0.4, 48)
POINTS = np.array([GRID.points[i] for i in (10 * 48 + 33, 30 * 48 + 12, 36 * 48 + 37)])
COARSE = ImageGrid(0.4, 6)
K = 2 * np.pi * FC / C


def scans_of(views=24, noise=0.0, seed=0, aperture=None):
    capture = record(POINTS, [1.0, 1.0, 1.0], aperture or turn(views), noise=noise, seed=seed)
    return preprocess(capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.4))


@pytest.mark.parametrize("noise", [0.0, 0.22])
def test_points_come_back_where_they_are(noise):
    scans = scans_of(noise=noise)
    image = sparse_recovery(scans, GRID)
    result = localise(pick_peaks(image, 6), POINTS)
    assert (result.detected, result.missed, result.false) == (3, 0, 0)
    assert result.rmse_m < 0.003
    assert peak_to_sidelobe_db(image, POINTS) > peak_to_sidelobe_db(backproject(scans, GRID), POINTS) + 6


def test_the_solution_is_that_of_all_pixels_although_few_are_worked_on():
    scans = scans_of(24, noise=0.1)
    operator = ForwardOperator(scans, GRID)
    image = sparse_recovery(scans, GRID, SparseSettings(iterations=600, tolerance=1e-5), operator=operator)
    x, weight = image.values.ravel(), image.settings["lambda"]
    slope = operator.adjoint(scans.samples - operator.forward(x).reshape(scans.samples.shape))
    on = x != 0
    # The conditions that only the minimum meets (subgradient of the l1 norm).
    assert np.abs(slope[~on]).max() < 1.03 * weight
    assert np.abs(slope[on] - weight * x[on] / np.abs(x[on])).max() < 0.05 * weight


def test_it_stops_early_and_reports_progress():
    seen = []
    image = sparse_recovery(scans_of(), GRID, SparseSettings(tolerance=0.05), lambda *at: seen.append(at))
    assert seen[0] == (1, 150)
    assert seen[-1][0] == image.settings["iterations_done"] < 150


def test_noise_alone_gives_an_almost_blank_image():
    capture = record([], [], turn(24), noise=1.0)
    scans = preprocess(capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.4))
    values = sparse_recovery(scans, GRID).values
    assert np.count_nonzero(values) < 0.03 * values.size


def test_omp_takes_the_true_pixels_one_by_one():
    capture = record(POINTS, [1.0, 0.8, 0.6], turn(24))
    scans = preprocess(capture, settings=PreprocessSettings(background="none", extent_m=0.4))
    image = omp(scans, GRID, 3)
    chosen = set(np.flatnonzero(image.values.ravel()))
    assert chosen == {10 * 48 + 33, 30 * 48 + 12, 36 * 48 + 37}
    amplitudes = np.abs(image.values.ravel()[[10 * 48 + 33, 30 * 48 + 12, 36 * 48 + 37]])
    assert amplitudes == pytest.approx([1.0, 0.8, 0.6], rel=0.02)
    capture = record(POINTS, [1.0] * 3, turn(24), noise=0.1)
    noisy = preprocess(capture, settings=PreprocessSettings(background="none", extent_m=0.4))
    assert np.count_nonzero(omp(noisy, GRID, 50, stop=5.0).values) == 3


def test_column_norm_is_that_of_the_operator():
    scans = scans_of()
    column = ForwardOperator(scans, np.array([[0.05, 0.02]])).forward(np.ones(1))
    assert column_norm(scans) == pytest.approx(float(np.linalg.norm(column)), rel=0.02)


def test_omp_refuses_no_points():
    with pytest.raises(UsageError):
        omp(scans_of(), GRID, 0)


@pytest.mark.parametrize("error_m", [-0.015, 0.010])
def test_focus_finds_the_axis_distance_within_2_mm(error_m):
    """36 views, 10 dB SNR a sample (unit echo, real noise of half its power over ten)."""
    point = [(0.05, 0.03), (-0.04, 0.06)]
    capture = record(point, [1.0, 1.0], turn(36), noise=np.sqrt(0.05))
    scans = preprocess(replace(capture, axis_distance_m=1.0 + error_m))
    focused, focus = focus_axis_distance(scans, ImageGrid(0.4, 64))
    assert focus.reliable
    assert focus.axis_distance_m == pytest.approx(1.0, abs=0.002)
    assert focus.offset_m == pytest.approx(-error_m, abs=0.002)
    assert focused.aperture.axis_distance == focus.axis_distance_m
    assert focus.contrast > 1


def test_focus_leaves_noise_alone():
    scans = preprocess(record([], [], turn(36), noise=1.0))
    same, focus = focus_axis_distance(scans, ImageGrid(0.4, 64))
    assert same is scans
    assert not focus.reliable
    assert focus.offset_m == 0


def test_free_positions_are_not_focused():
    scans = preprocess(record([(0.1, 0.0)], [1.0], helix(24)))
    same, focus = focus_axis_distance(scans, GRID)
    assert same is scans
    assert focus.axis_distance_m is None


def test_sharpness_counts_pixels():
    single = np.zeros((4, 4), complex)
    single[1, 2] = 3j
    assert sharpness(single) == pytest.approx(1)
    assert sharpness(np.ones((4, 4), complex)) == pytest.approx(1 / 16)
    assert sharpness(0 * single) == 0
    with pytest.raises(UsageError):
        focus_axis_distance(scans_of(), GRID, 0.5)


def coarse_scans():
    """For pixels over half a wavelength apart: the columns of the operator are nearly orthogonal."""
    capture = record([[0.05, 0.02], [-0.06, 0.01]], [1, 0.5j], turn(20), analytic=True, noise=0.1)
    return scans_from(capture, COARSE.extent)


def test_the_energy_left_of_every_view_adds_up_to_the_residual() -> None:
    data = coarse_scans()
    operator = ForwardOperator(data, COARSE)
    values = operator.adjoint(data.samples)
    remaining = Prediction.of(data.samples, operator.forward(values)).misfits
    energy = float(np.vdot(data.samples, data.samples).real)
    image = Image(values.reshape(6, 6), COARSE)
    assert remaining.shape == (20,)
    np.testing.assert_allclose(remaining.sum() / energy, residual(data, image), rtol=1e-5)
    np.testing.assert_allclose(
        Prediction.of(data.samples, np.zeros_like(data.samples)).misfits.sum(), energy, rtol=1e-6
    )


def test_the_beam_is_half_where_the_point_response_is() -> None:
    half = beam_sigma_m(K) * np.sqrt(2 * np.log(2))
    assert j0(2 * K * half) == pytest.approx(0.5, abs=1e-3)


def test_pixels_of_one_point_add_up_to_its_amplitude_and_opposite_ones_cancel() -> None:
    grid = ImageGrid(0.5, 100)
    values = np.zeros((100, 100), dtype=np.complex64)
    values[40, 60], values[40, 61] = 1j, 0.5j
    shown = restore(Image(values, grid, {"method": "omp"}), K)
    peak = np.unravel_index(int(np.abs(shown.values).argmax()), shown.values.shape)
    assert peak == (40, 60)
    assert abs(shown.values[40, 60]) == pytest.approx(1.5, rel=0.1)
    assert np.angle(shown.values[40, 60]) == pytest.approx(np.pi / 2)
    assert shown.settings["restoring_beam_m"] == pytest.approx(beam_sigma_m(K))
    values[40, 61] = -1j
    assert np.abs(restore(Image(values, grid), K).values).max() < 0.5
