"""Capacity of an object: the number of layouts that localisation can still tell apart.

The measured error of a reflector's position determines the distance that layouts must keep. The capacity is
the size of the largest family that keeps this distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import erfc, sqrt

import numpy as np

from tagid.errors import UsageError
from tagid.tags.layouts.cliques import RESTARTS, TIE_M, largest_clique, least_of
from tagid.tags.layouts.design import MAX_COUNT, DesignRules, candidates, distance_matrix, weighted
from tagid.tags.layouts.objects import TaggedObject

LEVELS = 24
"""Number of distances tried between the smallest and the largest that occur."""


@dataclass(frozen=True)
class Localisation:
    """Measured error of a reflector's position.

    Attributes:
        views, snr_db: of the recordings (SNR of one sample at the strongest reflector's echo).
        sigma_m: RMS error of one coordinate after fitting the tag's rotation and position, m.
        radius_m: radius of the object used for the measurement, m.
        own_echoes: whether the object itself has echoes that change with rotation: a shell off the axis, a
            handle, a rim.
    """

    views: int
    snr_db: int
    sigma_m: float
    radius_m: float = 0.0
    own_echoes: bool = False


def _measured() -> tuple[Localisation, ...]:
    recordings = ((36, 20), (36, 10), (36, 0), (12, 10))
    millimetres = {
        (0.110, False): (0.16, 0.34, 1.11, 0.73),
        (0.110, True): (0.68, 0.76, 1.34, 1.45),
        (0.045, False): (0.18, 0.41, 1.28, 0.81),
        (0.045, True): (2.09, 2.10, 2.42, 2.62),
    }
    return tuple(
        Localisation(views, snr_db, error / 1e3, radius, echoes)
        for (radius, echoes), row in millimetres.items()
        for (views, snr_db), error in zip(recordings, row, strict=True)
    )


MEASURED = _measured()
"""Printed by `tests/benchmarks/localisation.py`; see docs/results.md. On a mug, reflectors are closer to each
other and to the handle, which biases their positions."""


def measured_on(radius_m: float) -> tuple[Localisation, ...]:
    """The errors measured on the object closest in size."""
    nearest = min({place.radius_m for place in MEASURED}, key=lambda known: abs(known - radius_m))
    return tuple(place for place in MEASURED if place.radius_m == nearest)


def reference(radius_m: float) -> Localisation:
    """The recording for which confusion rates are quoted: object with own echoes, 36 views, 0 dB. These are
    the worst conditions that the reader is designed for."""
    return next(p for p in measured_on(radius_m) if p.own_echoes and (p.views, p.snr_db) == (36, 0))


@dataclass(frozen=True)
class Capacity:
    """Identities an object can carry with a given number of reflectors.

    Attributes:
        reflectors: reflectors per layout.
        identities: size of the largest family found for the error rate; 1 if no two can be told apart.
        distance_m: least rotational distance (RMS over reflectors) in that family, m.
        error_rate: its expected rate of wrong identifications, the union bound over all others.
    """

    reflectors: int
    identities: int
    distance_m: float
    error_rate: float


def confusion_rate(distance_m: float, reflectors: int, sigma_m: float) -> float:
    """Probability that noise of sigma per coordinate makes one layout look closer to another.

    The two differ by sqrt(K) d in the 2K coordinates together; noise along that direction must exceed half of
    it: Q(sqrt(K) d / (2 sigma)).

    >>> round(confusion_rate(0.02, 3, 0.01), 4)
    0.0416
    """
    if not sigma_m > 0:
        raise UsageError(f"the localisation error is {sigma_m} m", "Give a positive number of metres.")
    return 0.5 * erfc(sqrt(reflectors) * distance_m / (2 * sigma_m) / sqrt(2))


def capacity(target: TaggedObject, rules: DesignRules, sigma_m: float, error_rate: float) -> Capacity:
    """The largest family found on an object whose rate of wrong identifications stays below `error_rate`.

    Args:
        target: object with the rows to use.
        rules: reflectors, slots and physical limits.
        sigma_m: measured error of one coordinate, m.
        error_rate: allowed rate of wrong identifications.

    Raises UsageError for an impossible error, rate, or number of candidates.
    """
    if not 0 < error_rate < 0.5:
        raise UsageError(f"the error rate is {error_rate}", "Give a rate between 0 and 0.5, e.g. 0.001.")
    families = _families(target, rules)
    best = Capacity(rules.reflectors, min(families.candidates, 1), float("inf"), 0.0)
    for level in families.levels:
        rate = confusion_rate(level, rules.reflectors, sigma_m)
        if rate > error_rate:
            continue
        found = families.largest(level)
        if len(found) <= best.identities:
            break  # larger distances allow fewer
        allowed = min(len(found), 1 + int(error_rate / max(rate, 1e-300)))
        if allowed > best.identities:
            least = least_of(families.distance, found[:allowed])
            worst = confusion_rate(least, rules.reflectors, sigma_m) * (allowed - 1)
            best = Capacity(rules.reflectors, allowed, least, worst)
    return best


class _Families:
    """The largest families of one object by minimum distance, each searched once."""

    def __init__(self, target: TaggedObject, rules: DesignRules) -> None:
        points, heights, _ = candidates(target, rules)
        points = weighted(points, heights, rules)
        self.candidates = len(points)
        self.seed = rules.seed
        self.distance = distance_matrix(points, rules) if len(points) else np.zeros((0, 0))
        values = np.unique(self.distance[np.triu_indices(len(points), 1)])
        some = np.linspace(0, max(len(values) - 1, 0), LEVELS).astype(int)
        self.levels = [float(level) for level in np.unique(values[some])] if len(values) else []
        self._known: dict[float, list[int]] = {}

    def largest(self, level: float) -> list[int]:
        """The largest family found whose members keep this distance, m."""
        if level not in self._known:
            rng = np.random.default_rng([self.seed, self.levels.index(level)])
            far = self.distance >= level - TIE_M
            # Small distances exclude few candidates, so that many starts find the same set.
            starts = RESTARTS if level > np.median(self.levels) / 2 else RESTARTS // 10
            self._known[level] = largest_clique(far, rng, starts)[:MAX_COUNT]
        return self._known[level]


@lru_cache(maxsize=8)
def _families(target: TaggedObject, rules: DesignRules) -> _Families:
    return _Families(target, rules)
