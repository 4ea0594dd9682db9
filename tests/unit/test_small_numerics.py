"""Small numerical parts that need numpy only, against scipy's functions of the same purpose."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.optimize import linear_sum_assignment
from scipy.special import h2vp, hankel2, jv, jvp, yv, yvp

from tagid.fields.bessel import bessel, first_kind
from tagid.imaging.bilinear import bilinear
from tagid.imaging.restore import blurred
from tagid.tags.layouts.codebook import least_assignment


@pytest.mark.parametrize(
    "z",
    [
        np.array([1e-3, 0.02, 0.5, 1.0, 2.404825557695773, 7.0, 19.5, 60.0, 140.0]),
        np.array([0.3, 4.0, 25.0]) * np.sqrt(6 - 0.2j),  # ceramic, in the band and beyond
        np.array([0.1, 3.0, 12.0]) * np.sqrt(2.5 - 2.5j),  # losses as large as the permittivity
    ],
)
def test_bessel_functions_of_all_orders_are_those_of_scipy(z: np.ndarray) -> None:
    most = 24
    result = bessel(most, z)
    orders = np.arange(most + 1)
    for base, theirs in (
        (result.j, jv), (result.dj, jvp), (result.y, yv), (result.dy, yvp),
        (result.h2, hankel2), (result.dh2, h2vp),
    ):  # fmt: skip
        expected = theirs(orders, z[:, None])
        representable = np.isfinite(expected) & (np.abs(expected) > 1e-250)
        error = np.abs(base - expected)[representable] / np.abs(expected)[representable]
        assert error.max() < 1e-8, theirs.__name__


def test_bessel_functions_at_zero_and_far_beyond_the_argument() -> None:
    assert first_kind(3, np.zeros(1)).tolist() == [[1.0, 0.0, 0.0, 0.0]]
    assert first_kind(60, np.array([0.5]))[0, 40] == pytest.approx(jv(40, 0.5), rel=1e-9)


@pytest.mark.parametrize("shape", [(1, 1), (3, 3), (4, 9), (7, 7), (12, 20)])
def test_the_assignment_of_least_cost(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(shape[1])
    for _ in range(40):
        cost = rng.choice([rng.random(shape), rng.integers(0, 3, shape).astype(float)])
        result = least_assignment(cost)
        assert len(set(result.tolist())) == shape[0]
        rows, columns = linear_sum_assignment(cost)
        assert cost[np.arange(shape[0]), result].sum() == pytest.approx(cost[rows, columns].sum(), abs=1e-12)


@pytest.mark.parametrize(("held", "mode"), [(False, "constant"), (True, "nearest")])
def test_values_between_samples(held: bool, mode: str) -> None:
    rng = np.random.default_rng(1)
    values = rng.standard_normal((9, 14))
    row, column = rng.uniform(-2, 10, 300), rng.uniform(-2, 15, 300)
    if not held:  # scipy fades over one step outside; here the outside begins at the edge
        inside = (row >= 0) & (row <= 8) & (column >= 0) & (column <= 13)
        assert not bilinear(values, row[~inside], column[~inside]).any()
        row, column = row[inside], column[inside]
    expected = map_coordinates(values, [row, column], order=1, mode=mode)
    np.testing.assert_allclose(bilinear(values, row, column, held), expected, atol=1e-12)


def test_the_restoring_beam_is_a_gaussian_to_the_edges() -> None:
    values = np.random.default_rng(2).standard_normal((33, 40))
    np.testing.assert_allclose(blurred(values, 1.7), gaussian_filter(values, 1.7), atol=1e-12)
