"""The interval of a proportion that was counted, the same wherever a rate is printed."""

from __future__ import annotations

import math
from dataclasses import dataclass

_Z = 1.959964
"""Quantile of the normal distribution for 95 %, two-sided."""


@dataclass(frozen=True)
class Interval:
    """Lower and upper limit of a proportion, 0..1."""

    low: float
    high: float


def percent(share: float) -> str:
    """A share with two digits.

    >>> percent(0.9996), percent(0.0123)
    ('100 %', '1.2 %')
    """
    return f"{float(f'{100 * share:.2g}'):g} %"


def wilson(share: float, trials: float) -> Interval:
    """95 % interval of a proportion (E. B. Wilson, J. Am. Stat. Assoc. 22, 209, 1927).

    Args:
        share: successes per trial, 0..1.
        trials: number of trials; where there are none, nothing is known: 0 to 1.

    >>> interval = wilson(0.9, 10)
    >>> round(interval.low, 3), round(interval.high, 3)
    (0.596, 0.982)
    """
    if trials == 0:
        return Interval(0.0, 1.0)
    w = _Z * _Z / trials
    middle = (share + w / 2) / (1 + w)
    half = _Z * math.sqrt(share * (1 - share) / trials + w / (4 * trials)) / (1 + w)
    return Interval(max(0.0, middle - half), min(1.0, middle + half))


def trials_for(rate: float) -> int:
    """Number of trials, all of them successful, whose 95 % interval begins at a rate below 1.

    >>> trials_for(0.99), round(wilson(1.0, trials_for(0.99)).low, 4)
    (381, 0.99)
    """
    return math.ceil(_Z**2 * rate / (1 - rate))
