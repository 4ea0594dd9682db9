"""Capacity of an object: the number of layouts that readings can still tell apart.

The capacity is the size of the largest family in which few readings get no name.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tagid.errors import UsageError
from tagid.reading.alike import Conditions, told_apart
from tagid.tags.layouts.cliques import RESTARTS, TIE_M, largest_clique
from tagid.tags.layouts.design import MAX_COUNT, DesignRules, candidates, distance_matrix, weighted
from tagid.tags.layouts.layout import Layout
from tagid.tags.layouts.objects import TaggedObject

LEVELS = 24
"""Number of distances tried between the smallest and the largest that occur."""


@dataclass(frozen=True)
class Capacity:
    """Identities an object can carry with a given number of reflectors.

    Attributes:
        reflectors: reflectors per layout.
        identities: size of the largest family found for the error rate; 1 if no two can be distinguished.
        distance_m: least rotational distance (RMS over reflectors) in that family, m.
        error_rate: share of the readings without a name, at most: the union bound.
    """

    reflectors: int
    identities: int
    distance_m: float
    error_rate: float


def capacity(target: TaggedObject, rules: DesignRules, error_rate: float, conditions: Conditions) -> Capacity:
    """The largest family found on an object with no more readings without a name than a share of them.

    Raises UsageError for an impossible rate, or number of candidates.
    """
    if not 0 < error_rate < 0.5:
        raise UsageError(f"the error rate is {error_rate}", "Give a rate between 0 and 0.5, e.g. 0.001.")
    families = _families(target, rules)
    best = Capacity(rules.reflectors, min(families.candidates, 1), float("inf"), 0.0)
    levels = families.levels
    first = bisect_left(levels, True, key=lambda level: families.closest(level, conditions)[1] <= error_rate)
    for level in levels[first:]:
        count = len(families.largest(level))
        if count <= best.identities:
            break  # larger distances allow fewer
        least, rate = families.closest(level, conditions)
        allowed = min(count, 1 + int(error_rate / max(rate, 1e-300)))
        if allowed > best.identities:
            best = Capacity(rules.reflectors, allowed, least, rate * (allowed - 1))
    return best


class _Families:
    """The largest families of one object by minimum distance, each searched once."""

    def __init__(self, target: TaggedObject, rules: DesignRules) -> None:
        self.points, self.heights, _ = candidates(target, rules)
        points = weighted(self.points, self.heights, rules)
        self.candidates, self.kind = len(points), target.kind
        self.seed = rules.seed
        self.distance = distance_matrix(points, rules) if len(points) else np.zeros((0, 0))
        values = np.unique(self.distance[np.triu_indices(len(points), 1)])
        some = np.linspace(0, max(len(values) - 1, 0), LEVELS).astype(int)
        self.levels = [float(level) for level in np.unique(values[some])] if len(values) else []
        self._known: dict[float, list[int]] = {}
        self._closest: dict[tuple[float, Conditions], tuple[float, float]] = {}

    def largest(self, level: float) -> list[int]:
        """The largest family found whose members keep this distance, m."""
        if level not in self._known:
            rng = np.random.default_rng([self.seed, self.levels.index(level)])
            far = self.distance >= level - TIE_M
            # Small distances exclude few candidates, so that many starts find the same set.
            starts = RESTARTS if level > np.median(self.levels) / 2 else RESTARTS // 10
            self._known[level] = largest_clique(far, rng, starts)[:MAX_COUNT]
        return self._known[level]

    def closest(self, level: float, conditions: Conditions) -> tuple[float, float]:
        """Distance, m, of the two nearest members of a family, and the share of readings that they leave."""
        if (level, conditions) not in self._closest:
            members = self.largest(level)
            apart = self.distance[np.ix_(members, members)] + np.diag(np.full(len(members), np.inf))
            a, b = (members[i] for i in np.unravel_index(int(apart.argmin()), apart.shape))
            first, second = (
                Layout(f"c{i}", self.points[i], self.kind, heights=self.heights[i]) for i in (a, b)
            )
            rate = told_apart(first, second, conditions).unresolved() if a != b else 0.0
            self._closest[level, conditions] = float(apart.min()), rate
        return self._closest[level, conditions]


_families = lru_cache(maxsize=8)(_Families)
