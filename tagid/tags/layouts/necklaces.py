"""Necklaces, words on a ring up to rotation: the combinatorial basis of a layout family.

An object's orientation on the table is arbitrary, so words that are rotations of each other are one identity.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, pairwise, product
from math import comb

from tagid.errors import UsageError

MAX_WORDS = 400_000
"""Maximum number of words examined; 24 slots, 5 reflectors and 2 rings are 283 360."""

Bead = tuple[int, int]
"""(slots to the next occupied slot, colour): a necklace is a cycle of them."""


def _gaps(slots: int, weight: int) -> Iterator[tuple[int, ...]]:
    """Compositions of `slots` into `weight` positive parts."""
    for cuts in combinations(range(1, slots), weight - 1):
        yield tuple(end - start for start, end in pairwise((0, *cuts, slots)))


def _turned(word: tuple[Bead, ...]) -> list[tuple[Bead, ...]]:
    return [word[i:] + word[:i] for i in range(len(word))]


def mirrored(word: tuple[Bead, ...]) -> tuple[Bead, ...]:
    """The word reversed, as its smallest rotation."""
    weight = len(word)
    back = tuple((word[(-i - 1) % weight][0], word[-i % weight][1]) for i in range(weight))
    return min(_turned(back))


def necklaces(
    slots: int, weight: int, colours: int = 1, *, mirror_counts: bool = True
) -> list[tuple[Bead, ...]]:
    """All necklaces with `weight` of `slots` occupied, each in one of `colours` (rings or rows): the smallest
    rotation of each, sorted.

    If not `mirror_counts`, a necklace and its mirror image are one, as where the direction of rotation is
    unknown.

    Raises UsageError: no necklace exists, or more than MAX_WORDS words to examine.

    >>> [len(necklaces(12, k)) for k in (2, 3, 4)]
    [6, 19, 43]
    """
    if not (1 <= weight <= slots and colours >= 1):
        raise UsageError(
            f"{weight} reflectors in {slots} slots", "Give at least as many slots as reflectors."
        )
    words = comb(slots - 1, weight - 1) * colours**weight
    if words > MAX_WORDS:
        raise UsageError(
            f"{weight} reflectors in {slots} slots and {colours} rows give {words:,} words, too many",
            "Use fewer slots, reflectors or rows.",
        )
    representatives = []
    for gaps in _gaps(slots, weight):
        if min(gaps) < gaps[0]:
            continue
        for colouring in product(range(colours), repeat=weight):
            word = tuple(zip(gaps, colouring, strict=True))
            if word != min(_turned(word)):
                continue
            if not mirror_counts and mirrored(word) < word:
                continue
            representatives.append(word)
    return sorted(representatives)


def occupied(word: tuple[Bead, ...]) -> list[Bead]:
    """(slot, colour) of every occupied slot, the first in slot 0."""
    slot, out = 0, []
    for gap, colour in word:
        out.append((slot, colour))
        slot += gap
    return out
