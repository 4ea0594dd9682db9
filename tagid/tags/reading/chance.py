"""How much energy noise alone explains by chance: what a bar of the live view is compared with."""

from __future__ import annotations

from math import exp, lgamma, log

PLACES_PER_METRE = 6500.0
"""Number of independent places searched per metre of the outermost reflector's path (2 pi r divided by the
layout's symmetry), over all centres and range offsets. Fitted to the maxima of 720 searches in pure noise at
12, 36 and 100 views, which correspond to 500 to 6000 places per layout. Each pattern tried adds this number
again."""
EXPLAINED_SHARE = 0.45
"""Share of the energy above noise that tags without a body explain at least."""


def chance(nats: float, size: int, positions: float) -> float:
    """Probability that `size` points explain at least `nats` of pure noise.

    `places` is the number of independent places searched. At one place the energy has a Gamma(K)
    distribution: Q(K, x) = exp(-x) sum_{j<K} x^j / j!.
    """
    if nats <= 0:
        return 1.0
    terms = [j * log(nats) - lgamma(j + 1) - nats for j in range(size)]
    largest = max(terms)
    tail = largest + log(sum(exp(t - largest) for t in terms)) + log(positions)
    return exp(min(tail, 0.0))


def nats_needed(size: int, positions: float, false_accept: float) -> float:
    """The nats that noise alone, searched at so many places, reaches with probability `false_accept`.

    >>> round(chance(nats_needed(3, 36600.0, 1e-3), 3, 36600.0), 6)
    0.001
    """
    low, high = 0.0, 1e3
    while high - low > 1e-9:
        middle = (low + high) / 2
        low, high = (middle, high) if chance(middle, size, positions) > false_accept else (low, middle)
    return high
