"""Coupled pixels: a Gaussian prior whose variance neighbours share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tagid.geometry import ImageGrid
from tagid.imaging.coupled import coupled_recovery, damped
from tagid.imaging.heldout import residual
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.sparse import sparse_recovery
from tagid.imaging.types import BasebandScans
from tests.unit.imaging_scenes import record, scans_from, turn

GRID = ImageGrid(0.3, 40)
COARSE = ImageGrid(0.3, 6)


def arc(views: int, noise: float = 0.0) -> BasebandScans:
    """Scans of a third of a circle of 8 cm, of points a sixth of a wavelength apart."""
    t = np.linspace(0, 2 * np.pi / 3, 14)
    points = 0.08 * np.column_stack([np.cos(t), np.sin(t)])
    phases = np.exp(2j * np.pi * np.random.default_rng(1).random(14))
    return scans_from(record(points, phases, turn(views), noise=noise, analytic=True), GRID.extent)


def test_conjugate_gradients_solve_the_damped_normal_equations() -> None:
    scans = arc(20)
    operator = ForwardOperator(scans, COARSE)
    units = (operator.among(np.arange(operator.points) == point) for point in range(operator.points))
    dense = np.stack([unit.forward(np.ones(1)).ravel() for unit in units], axis=1).astype(np.complex128)
    root = np.linspace(0.2, 1.0, operator.points).astype(np.float32)
    damping = 0.05 * float(np.linalg.norm(dense, 2) ** 2)
    scaled = dense * root
    right = scaled.conj().T @ scans.samples.ravel()
    direct = np.linalg.solve(scaled.conj().T @ scaled + damping * np.eye(len(right)), right)
    mine = damped(operator, scans.samples, root, damping)
    assert np.linalg.norm(mine - direct) < 0.02 * np.linalg.norm(direct)


def test_zero_scans_give_a_zero_image() -> None:
    scans = arc(12)
    blank = coupled_recovery(replace(scans, samples=0 * scans.samples), GRID)
    assert not blank.values.any()


@pytest.mark.parametrize("views", [24, 36])
def test_views_between_are_predicted_where_sparse_pixels_predict_half(views: int) -> None:
    scans, between = arc(views, noise=0.1), arc(180)
    remaining = residual(between, coupled_recovery(scans, GRID))
    assert remaining < 0.5 * residual(between, sparse_recovery(scans, GRID))


def test_noise_that_is_known_is_not_imaged() -> None:
    scans, between = arc(36, noise=2.0), arc(180)
    unaware = replace(scans, noise_std=0.0)
    remaining = residual(between, coupled_recovery(scans, GRID))
    assert remaining < 0.5 * residual(between, coupled_recovery(unaware, GRID))


def test_a_point_keeps_its_amplitude_and_its_place() -> None:
    """Its echo is spread over a resolution cell, whose sum it is."""
    amplitude = 2.0 * np.exp(0.4j)
    scans = scans_from(record([[0.05, -0.03]], [amplitude], turn(36), analytic=True), GRID.extent)
    values = coupled_recovery(scans, GRID).values.ravel()
    away = np.hypot(*(GRID.points - [0.05, -0.03]).T)
    assert away[np.abs(values).argmax()] < GRID.step
    assert values[away < 0.02].sum() == pytest.approx(amplitude, rel=0.15)
