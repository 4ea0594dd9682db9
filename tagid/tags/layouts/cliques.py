"""Sets of layouts with a minimum pairwise distance: cliques of the compatibility graph.

A greedy search quickly finds good sets; branch and bound then finds a better one or proves that none exists.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

RESTARTS = 200
CLIMBS = 6
"""Consecutive random starts without improvement before the exact search begins."""
NODES = 20_000
"""Branches that the exact search may open (about one second). A count instead of a time, so that the answer
does not depend on the machine."""


TIE_M = 1e-9
"""Distances that differ by less than this are equal within rounding."""


@dataclass(frozen=True)
class FarSet:
    """The set with the largest minimum distance found.

    Attributes:
        chosen: indexes, sorted.
        proven: whether no set of that size keeps a larger distance.
    """

    chosen: list[int]
    proven: bool


class SearchTooLongError(Exception):
    """The exact search has used up its branches."""


def farthest_set(
    distance: NDArray[np.float64], count: int, rng: np.random.Generator, nodes: int = NODES
) -> FarSet:
    """`count` rows of a symmetric distance matrix (n, n) with the largest minimum distance found.

    Bisection over the distances that occur: for each, search a set with at least this pairwise distance (a
    clique), greedily from random starts, preferring candidates compatible with the most others. The best set
    is improved by more starts, then by the exact search, of so many branches in total, until no larger
    distance is possible.
    """
    n = len(distance)
    if count == 1:
        return FarSet([0], True)
    levels = np.unique(np.round(distance[np.triu_indices(n, 1)], 9))
    low, high, best = 0, len(levels) - 1, list(range(count))
    while low <= high:
        middle = (low + high) // 2
        members = clique(distance >= levels[middle] - TIE_M, count, rng)
        if members is None:
            high = middle - 1
        else:
            best, low = members, middle + 1
    tries = CLIMBS
    while tries:
        members = clique(distance > least_of(distance, best) + TIE_M, count, rng)
        best, tries = (best, tries - 1) if members is None else (members, CLIMBS)
    search = _Search(nodes)
    while True:
        try:
            exact = exact_clique(distance > least_of(distance, best) + TIE_M, count, search)
        except SearchTooLongError:
            return FarSet(sorted(best), False)
        if exact is None:
            return FarSet(sorted(best), True)
        best = exact


def least_of(distance: NDArray[np.float64], chosen: list[int]) -> float:
    """Minimum distance of two chosen rows; infinite for a single row."""
    part = distance[np.ix_(chosen, chosen)] + np.diag(np.full(len(chosen), np.inf))
    return float(part.min())


def clique(compatible: NDArray[np.bool_], count: int, rng: np.random.Generator) -> list[int] | None:
    """`count` mutually compatible rows of a symmetric matrix (n, n), or None if none were found."""
    members = largest_clique(compatible, rng)
    return members[:count] if len(members) >= count else None


def largest_clique(
    compatible: NDArray[np.bool_], rng: np.random.Generator, restarts: int = RESTARTS
) -> list[int]:
    """The largest set of mutually compatible rows found from all starts at once (a lower bound)."""
    n = len(compatible)
    graph = (compatible & ~np.eye(n, dtype=bool)).astype(np.float32)
    runs = np.arange(restarts)
    picks = rng.permutation(n)[:restarts] if restarts <= n else rng.integers(0, n, restarts)
    members = [picks]
    candidates = graph[picks] > 0
    while candidates.any():
        freedom = candidates.astype(np.float32) @ graph
        freedom = np.where(candidates, freedom + rng.uniform(0, 1.5, candidates.shape), -1.0)
        picks = np.where(candidates.any(axis=1), freedom.argmax(axis=1), -1)
        members.append(picks)
        candidates &= (graph[picks] > 0) & (picks >= 0)[:, None]
    chosen = np.array(members)
    longest = int(np.argmax((chosen >= 0).sum(axis=0)))
    return [int(i) for i in chosen[:, runs[longest]] if i >= 0]


class _Search:
    """The branches of `exact_clique`; sets of rows are bits of integers.

    Attributes:
        budget: branches that may still be opened.
        near: rows compatible with each.
    """

    def __init__(self, nodes: int = NODES) -> None:
        self.budget = nodes
        self.near: list[int] = []

    def expand(self, rest: int, wanted: int) -> list[int] | None:
        """`wanted` compatible rows of the set `rest`, or None."""
        if wanted == 0:
            return []
        self.budget -= 1
        if self.budget < 0:
            raise SearchTooLongError
        for row in reversed(self._branches(rest, wanted)):
            branch = self.expand(rest & self.near[row], wanted - 1)
            if branch is not None:
                return [row, *branch]
            rest &= ~(1 << row)
        return None

    def _branches(self, rest: int, wanted: int) -> list[int]:
        """Rows beyond the first wanted - 1 colours: one of them is in every clique of that size."""
        later: list[int] = []
        colour = 0
        while rest:
            colour += 1
            free = rest
            while free:
                row = (free & -free).bit_length() - 1
                free &= ~((1 << row) | self.near[row])
                rest &= ~(1 << row)
                if colour >= wanted:
                    later.append(row)
        return later


def exact_clique(
    compatible: NDArray[np.bool_], count: int, search: _Search | None = None
) -> list[int] | None:
    """`count` mutually compatible rows of a symmetric matrix, or None if provably there are none.

    Branch and bound: a set that can be coloured with m colours, none of them on two compatible rows, holds no
    clique of more than m (Tomita and Seki 2003). Rows with too few compatible rows are removed first.

    Raises SearchTooLongError when the branches are used up; None means `NODES`.
    """
    n = len(compatible)
    graph = compatible & ~np.eye(n, dtype=bool)
    alive = np.ones(n, dtype=bool)
    while True:
        enough = alive & ((graph & alive).sum(axis=1) >= count - 1)
        if (enough == alive).all():
            break
        alive = enough
    # Rows with few compatible ones first, which makes the colouring tighter.
    order = np.flatnonzero(alive)
    order = order[np.argsort(graph[np.ix_(order, order)].sum(axis=1), kind="stable")[::-1]]
    part = graph[np.ix_(order, order)]
    search = search or _Search()
    search.near = [sum(1 << int(j) for j in np.flatnonzero(row)) for row in part]
    members = search.expand((1 << len(order)) - 1, count)
    return None if members is None else [int(order[i]) for i in members]
