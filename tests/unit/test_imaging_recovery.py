"""Sparse and linear solutions and the restoring beam on known points; scans that tell no axis distance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import j0

from tagid.errors import UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.autofocus import focus_axis_distance
from tagid.imaging.backprojection import backproject
from tagid.imaging.heldout import Prediction, residual
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.restore import beam_sigma_m, restore
from tagid.imaging.sparse import SparseSettings, column_norm, omp, sparse_recovery
from tagid.imaging.types import BasebandScans, Image
from tests.unit.imaging_scenes import FC, C, helix, record, scans_from, turn
from train.metrics import localise, pick_peaks

GRID = ImageGrid(0.4, 48)
PIXELS = [10 * 48 + 33, 30 * 48 + 12, 36 * 48 + 37]
POINTS = GRID.points[PIXELS]
COARSE = ImageGrid(0.4, 6)
K = 2 * np.pi * FC / C


def scans_of(noise: float = 0.0, amplitudes: object = (1.0, 1.0, 1.0)) -> BasebandScans:
    return scans_from(record(POINTS, amplitudes, turn(24), noise=noise), 0.4)


@pytest.mark.parametrize("noise", [0.0, 0.22])
def test_points_come_back_where_they_are(noise):
    scans = scans_of(noise=noise)
    image = sparse_recovery(scans, GRID)
    result = localise(pick_peaks(image, 6), POINTS)
    assert (result.detected, result.missed, result.false) == (3, 0, 0)
    assert result.rmse_m < 0.003
    away = np.linalg.norm(GRID.points[:, None] - POINTS, axis=2).min(axis=1) > 0.02
    levels = [np.abs(i.values).ravel() / np.abs(i.values).max() for i in (image, backproject(scans, GRID))]
    assert levels[0][away].max() < 0.5 * levels[1][away].max()


def test_the_solution_is_that_of_all_pixels_although_few_are_worked_on():
    scans = scans_of(noise=0.1)
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
    scans = scans_from(record([], [], turn(24), noise=1.0), 0.4)
    values = sparse_recovery(scans, GRID).values
    assert np.count_nonzero(values) < 0.03 * values.size


def test_omp_takes_the_true_pixels_one_by_one():
    values = omp(scans_of(amplitudes=[1.0, 0.8, 0.6]), GRID, 3).values.ravel()
    assert set(np.flatnonzero(values)) == set(PIXELS)
    assert np.abs(values[PIXELS]) == pytest.approx([1.0, 0.8, 0.6], rel=0.02)
    assert np.count_nonzero(omp(scans_of(noise=0.1), GRID, 50, stop=5.0).values) == 3
    with pytest.raises(UsageError):
        omp(scans_of(), GRID, 0)


def test_column_norm_is_that_of_the_operator():
    scans = scans_of()
    column = ForwardOperator(scans, np.array([[0.05, 0.02]])).forward(np.ones(1))
    assert column_norm(scans) == pytest.approx(float(np.linalg.norm(column)), rel=0.02)


def test_focus_leaves_noise_and_free_positions_alone():
    noise = scans_from(record([], [], turn(36), noise=1.0), 0.5, matched=True)
    free = scans_from(record([(0.1, 0.0)], [1.0], helix(24)), 0.5, matched=True)
    for scans, given in ((noise, 1.0), (free, None)):
        same, focus = focus_axis_distance(scans, ImageGrid(0.4, 64))
        assert same is scans
        assert (focus.reliable, focus.offset_m, focus.axis_distance_m) == (False, 0, given)
    with pytest.raises(UsageError):
        focus_axis_distance(noise, GRID, 0.5)


def test_the_energy_left_of_every_view_adds_up_to_the_residual() -> None:
    """Pixels over half a wavelength apart: the columns of the operator are nearly orthogonal."""
    capture = record([[0.05, 0.02], [-0.06, 0.01]], [1, 0.5j], turn(20), analytic=True, noise=0.1)
    data = scans_from(capture, COARSE.extent)
    operator = ForwardOperator(data, COARSE)
    values = operator.adjoint(data.samples)
    remaining = Prediction.of(data.samples, operator.forward(values)).misfits
    energy = float(np.vdot(data.samples, data.samples).real)
    assert remaining.shape == (20,)
    expected = residual(data, Image(values.reshape(6, 6), COARSE))
    np.testing.assert_allclose(remaining.sum() / energy, expected, rtol=1e-5)
    nothing = Prediction.of(data.samples, np.zeros_like(data.samples)).misfits
    np.testing.assert_allclose(nothing.sum(), energy, rtol=1e-6)


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
