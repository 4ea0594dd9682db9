"""How many identities an object carries: as many layouts as localisation still keeps apart.

The error of one reflector's position, measured and not assumed, sets how far apart two layouts must lie; the
largest family that far apart is the capacity.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erfc, sqrt

import numpy as np

from tagid.errors import UsageError
from tagid.tags.cliques import largest_clique
from tagid.tags.design import MAX_COUNT, DesignRules, candidates, distance_matrix
from tagid.tags.objects import TaggedObject

LEVELS = 24
"""Distances tried between the smallest and the largest that occur."""


@dataclass(frozen=True)
class Localisation:
    """Measured error of one reflector's place.

    Attributes:
        views, snr_db: of the recordings (SNR of one sample at the strongest reflector's echo).
        sigma_m: standard deviation of one coordinate after the tag's turn and place are fitted, m.
    """

    views: int
    snr_db: int
    sigma_m: float


MEASURED = (
    Localisation(36, 20, 0.00016),
    Localisation(36, 10, 0.00033),
    Localisation(36, 0, 0.00105),
    Localisation(12, 10, 0.00073),
)
"""Printed by `tests/benchmarks/identification.py --only localisation`; docs/results.md shows the run."""

REFERENCE = MEASURED[2]
"""The worst recording that the reader is meant for: what the confusion rates of a registry are told for."""


@dataclass(frozen=True)
class Capacity:
    """Identities of one number of reflectors on an object.

    Attributes:
        reflectors: on each layout.
        identities: size of the largest family found that keeps the error rate; 1 where no two can be told.
        distance_m: least rotational distance (RMS over reflectors) in that family, m.
        error_rate: its expected rate of wrong names, the union bound over all others.
    """

    reflectors: int
    identities: int
    distance_m: float
    error_rate: float


def confusion_rate(distance_m: float, reflectors: int, sigma_m: float) -> float:
    """Probability that noise of sigma a coordinate makes one layout look nearer to another.

    The two differ by sqrt(K) d in the 2K coordinates together; noise along that direction must exceed half of
    it: Q(sqrt(K) d / (2 sigma)).

    >>> round(confusion_rate(0.02, 3, 0.01), 4)
    0.0416
    """
    if not sigma_m > 0:
        raise UsageError(f"the localisation error is {sigma_m} m", "Give a positive number of metres.")
    return 0.5 * erfc(sqrt(reflectors) * distance_m / (2 * sigma_m) / sqrt(2))


def capacity(target: TaggedObject, rules: DesignRules, sigma_m: float, error_rate: float) -> Capacity:
    """The largest family found on an object whose rate of wrong names stays below the one stated.

    Args:
        target: object with the rows to use.
        rules: reflectors, slots and physical limits.
        sigma_m: measured error of one coordinate, m.
        error_rate: rate of wrong names allowed.

    Raises UsageError for an impossible error, rate, or number of candidates.
    """
    if not 0 < error_rate < 0.5:
        raise UsageError(f"the error rate is {error_rate}", "Give a rate between 0 and 0.5, e.g. 0.001.")
    points, _, _ = candidates(target, rules)
    none = Capacity(rules.reflectors, min(len(points), 1), float("inf"), 0.0)
    if len(points) < 2:
        return none
    distance = distance_matrix(points, rules)
    rng = np.random.default_rng(rules.seed)
    values = np.unique(distance[np.triu_indices(len(points), 1)])
    levels = np.unique(values[np.linspace(0, len(values) - 1, LEVELS).astype(int)])
    best = none
    for level in levels:
        rate = confusion_rate(float(level), rules.reflectors, sigma_m)
        if rate > error_rate:
            continue
        found = largest_clique(distance >= level - 1e-9, rng)[:MAX_COUNT]
        allowed = min(len(found), 1 + int(error_rate / max(rate, 1e-300)))
        if allowed > best.identities:
            chosen = found[:allowed]
            least = float(distance[np.ix_(chosen, chosen)][~np.eye(allowed, dtype=bool)].min())
            worst = confusion_rate(least, rules.reflectors, sigma_m) * (allowed - 1)
            best = Capacity(rules.reflectors, allowed, least, worst)
    return best
