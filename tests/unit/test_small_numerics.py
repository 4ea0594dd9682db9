"""Small numerical parts: peaks, proportions, and what needs numpy only against scipy's functions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.optimize import linear_sum_assignment
from scipy.special import h2vp, hankel2, jv, jvp, yv, yvp

from tagid.fields.bessel import bessel, first_kind
from tagid.imaging.bilinear import bilinear
from tagid.imaging.restore import blurred
from tagid.proportion import Interval, wilson
from tagid.signal import fitted_peak, median, vertex
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


def test_values_between_samples() -> None:
    rng = np.random.default_rng(1)
    values = rng.standard_normal((9, 14))
    row, column = rng.uniform(-2, 10, 300), rng.uniform(-2, 15, 300)
    # scipy fades over one step outside; here the outside begins at the edge
    inside = (row >= 0) & (row <= 8) & (column >= 0) & (column <= 13)
    assert not bilinear(values, row[~inside], column[~inside]).any()
    row, column = row[inside], column[inside]
    expected = map_coordinates(values, [row, column], order=1, mode="constant")
    np.testing.assert_allclose(bilinear(values, row, column), expected, atol=1e-12)


def test_the_restoring_beam_is_a_gaussian_to_the_edges() -> None:
    values = np.random.default_rng(2).standard_normal((33, 40))
    np.testing.assert_allclose(blurred(values, 1.7), gaussian_filter(values, 1.7), atol=1e-12)


@pytest.mark.parametrize("top", [-0.4, 0.0, 0.23])
def test_the_vertex_of_a_parabola_is_exact(top: float) -> None:
    before, at, after = (5.0 - 2.0 * (x - top) ** 2 for x in (-1, 0, 1))
    assert vertex(before, at, after) == pytest.approx(top)
    assert vertex(-before, -at, -after) == pytest.approx(top)
    assert vertex(1.0, 2.0, 3.0) == 0.0


@pytest.mark.parametrize("half", [2, 3])
@pytest.mark.parametrize("top", [-0.31, 0.02, 0.9])
def test_a_fitted_peak_is_the_vertex_in_the_units_of_its_positions(half: int, top: float) -> None:
    at = np.array([-1.0, -0.8, -0.5, -0.3, -0.1, 0.1, 0.2, 0.5, 0.8, 1.0])  # uneven steps
    values = 3.0 - 7.0 * (at - top) ** 2
    assert fitted_peak(at, values, int(np.argmax(values)), half) == pytest.approx(top)


def test_a_fitted_peak_averages_the_noise_of_its_neighbours() -> None:
    rng = np.random.default_rng(5)
    at = np.linspace(-1.0, 1.0, 21)
    values = -((at - 0.04) ** 2) + 0.01 * rng.standard_normal((200, 21))
    fitted = np.array([fitted_peak(at, v, 10, 10) for v in values])
    through_three = np.array([at[10] + 0.1 * vertex(*v[9:12]) for v in values])
    assert abs(fitted.mean() - 0.04) < 1e-3
    assert fitted.std() < 0.1 * through_three.std()


def test_without_a_maximum_the_best_sample_is_the_answer() -> None:
    at = np.linspace(0.0, 1.0, 9)
    assert fitted_peak(at, at**2, 8, 3) == 1.0
    assert fitted_peak(at, -((at - 2.0) ** 2), 8, 3) == 1.0  # never beyond the samples used


@pytest.mark.parametrize(("axis", "keepdims"), [(None, False), (0, False), (-1, True)])
@pytest.mark.parametrize("shape", [(5, 4), (6, 7)])
def test_the_median_is_numpys(shape: tuple[int, int], axis: int | None, keepdims: bool) -> None:
    values = np.random.default_rng(3).standard_normal(shape).astype(np.float32)
    wanted = np.median(values, axis=axis, keepdims=keepdims and axis is not None)
    assert np.array_equal(median(values, axis=axis, keepdims=keepdims), wanted)


@pytest.mark.parametrize(("hits", "trials"), [(1, 2), (9, 10), (50, 100), (3, 7), (999, 1000)])
def test_each_limit_is_a_proportion_that_the_count_just_contradicts(hits: int, trials: int) -> None:
    """Wilson's definition: the limits p solve |share - p| = z sqrt(p (1 - p) / trials)."""
    share = hits / trials
    interval = wilson(share, trials)
    assert 0 <= interval.low < share < interval.high <= 1
    for limit in (interval.low, interval.high):
        assert abs(share - limit) == pytest.approx(1.959964 * (limit * (1 - limit) / trials) ** 0.5)


def test_a_count_without_exceptions_still_leaves_room_and_no_count_leaves_all() -> None:
    none, every = wilson(0.0, 100), wilson(1.0, 100)
    assert none.low == pytest.approx(0.0, abs=1e-12) and none.high == pytest.approx(0.0370, abs=1e-4)
    assert every.low == pytest.approx(1 - none.high) and every.high == pytest.approx(1.0)
    assert wilson(0.0, 0) == Interval(0.0, 1.0)
