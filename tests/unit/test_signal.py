"""Peaks between samples: exact on parabolas, defined at the ends and where there is no peak."""

from __future__ import annotations

import numpy as np
import pytest

from tagid.signal import fitted_peak, median, vertex


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
