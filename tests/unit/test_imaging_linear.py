"""The linear solution against a direct solver, and its first iteration against backprojection."""

from __future__ import annotations

import numpy as np

from tagid.geometry import ImageGrid
from tagid.imaging.ats.adapt import least_squares
from tagid.imaging.heldout import Prediction, residual
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import Image
from tests.unit.imaging_scenes import record, turn

GRID = ImageGrid(0.4, 6)
"""Pixels over half a wavelength apart, so that the columns of the operator are nearly orthogonal."""


def scans():
    capture = record([[0.05, 0.02], [-0.06, 0.01]], [1, 0.5j], turn(20), analytic=True, noise=0.1)
    return preprocess(capture, settings=PreprocessSettings("none", False, extent_m=GRID.extent))


def test_many_iterations_are_least_squares_and_the_first_is_scaled_backprojection() -> None:
    data = scans()
    operator = ForwardOperator(data, GRID)
    first, late = least_squares(operator, data.samples, (1, 60))
    back = operator.adjoint(data.samples)
    seen = operator.forward(back)
    factor = np.vdot(seen, data.samples) / np.vdot(seen, seen)
    np.testing.assert_allclose(first, factor.real * back, atol=1e-3 * np.abs(first).max())
    units = (operator.among(np.arange(operator.points) == point) for point in range(operator.points))
    dense = np.stack([unit.forward(np.ones(1)).ravel() for unit in units], axis=1).astype(np.complex128)
    y = data.samples.ravel()
    direct = y - dense @ np.linalg.lstsq(dense, y, rcond=None)[0]
    mine = y - operator.forward(late).ravel()
    assert np.linalg.norm(mine) < 1.02 * np.linalg.norm(direct)


def test_zero_scans_give_a_zero_solution() -> None:
    data = scans()
    operator = ForwardOperator(data, GRID)
    for solution in least_squares(operator, np.zeros_like(data.samples), (1, 3)):
        assert not solution.any()


def test_the_energy_left_of_every_view_adds_up_to_the_residual() -> None:
    data = scans()
    operator = ForwardOperator(data, GRID)
    values = operator.adjoint(data.samples)
    remaining = Prediction.of(data.samples, operator.forward(values)).misfits
    energy = float(np.vdot(data.samples, data.samples).real)
    image = Image(values.reshape(6, 6), GRID)
    assert remaining.shape == (20,)
    np.testing.assert_allclose(remaining.sum() / energy, residual(data, image), rtol=1e-5)
    np.testing.assert_allclose(
        Prediction.of(data.samples, np.zeros_like(data.samples)).misfits.sum(), energy, rtol=1e-6
    )
