"""The interval of a counted proportion, at its ends and against the equation that defines it."""

from __future__ import annotations

import pytest

from tagid.proportion import Interval, wilson


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
