"""What to ask of `tagid layouts design` instead, where a set cannot be made or would not be enrolled.

Every suggestion was designed and checked as enrolling would check it, so following it works.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from tagid.enrolling.enrollment import Basis, outlook, refusal
from tagid.errors import UsageError
from tagid.tags.layouts.design import (
    GHOST_M,
    MAX_SLOTS,
    REFLECTOR_M,
    DesignRules,
    Family,
    capacity,
    design,
)
from tagid.tags.layouts.layout import MAX_REFLECTORS, Layout
from tagid.tags.layouts.objects import TaggedObject

_MORE_SLOTS = (16, 18, 20, 24)
SPACINGS_M = (GHOST_M, 0.06, 0.05, REFLECTOR_M)
"""Reflector spacings that a design tries, the widest first, m."""
_MOST = 2
"""Suggestions that are enough; the search ends there."""


def alternatives(
    target: TaggedObject,
    rows: int,
    rules: DesignRules,
    count: int,
    enrolled: Sequence[Layout] = (),
) -> list[str]:
    """Settings that lead to a set which can be enrolled, e.g. "`rows=2`" or "`count=4`"; at most two.

    `rows` of all rows of the object were requested, `enrolled` layouts are already in use.
    """
    suggestions: list[str] = []
    for words, used, tried, number in _variations(target, rows, rules, count):
        if len(suggestions) == _MOST:
            break
        if number is None:
            number = most(target.with_rows(used), tried, count, enrolled)
            suggestions += [f"{words} `count={number}`".strip()] * (number > 0)
        elif works(target.with_rows(used), tried, number, enrolled):
            suggestions.append(words)
    return suggestions


def _variations(
    target: TaggedObject, rows: int, rules: DesignRules, count: int
) -> Iterator[tuple[str, int, DesignRules, int | None]]:
    """(settings, rows, rules, count) to try, the nearest first; a count of None is the largest that works."""
    for more in range(rows + 1, len(target.rows) + 1):
        yield f"`rows={more}`", more, rules, count
    for slots in _MORE_SLOTS:
        if rules.slots < slots <= MAX_SLOTS:
            yield f"`slots={slots}`", rows, replace(rules, slots=slots), count
    for reflectors in (rules.reflectors + 1, rules.reflectors - 1):
        if 2 <= reflectors <= min(MAX_REFLECTORS, rules.slots):
            yield f"`reflectors={reflectors}`", rows, replace(rules, reflectors=reflectors), count
    for spacing in SPACINGS_M:
        if spacing < rules.spacing_m:
            yield f"`spacing={spacing:g}`", rows, replace(rules, spacing_m=spacing), count
    yield "", rows, rules, None
    # Several settings together, for objects on which little fits.
    least = replace(rules, spacing_m=min(rules.spacing_m, REFLECTOR_M))
    for reflectors in range(rules.reflectors - 1, 1, -1):
        words = f"`reflectors={reflectors}`" + f" `spacing={REFLECTOR_M:g}`" * (least != rules)
        yield words, rows, replace(least, reflectors=reflectors), None


def most(target: TaggedObject, rules: DesignRules, below: int, enrolled: Sequence[Layout] = ()) -> int:
    """The largest number of layouts, less than `below`, of a set that can be enrolled; 0 if none can be."""
    low, high = 0, min(below - 1, capacity(target, rules, enrolled))
    tried = high
    while low < high:
        if works(target, rules, tried, enrolled):
            low = tried
        else:
            high = tried - 1
        tried = (low + high + 1) // 2
    return low


def roomiest(
    target: TaggedObject,
    rules: DesignRules,
    count: int,
    prefix: str | None = None,
    enrolled: Sequence[Layout] = (),
) -> Family:
    """The set of `count` layouts at the widest of `SPACINGS_M` at which it can be enrolled.

    The spacing of the rules is not used. If none can be enrolled, it is the set at the widest spacing at
    which one exists. Raises UsageError where there is none.
    """
    widest: Family | None = None
    for spacing in SPACINGS_M:
        spaced = replace(rules, spacing_m=spacing)
        try:
            family = design(target, spaced, count, prefix, enrolled)
        except UsageError:
            if spacing == SPACINGS_M[-1] and widest is None:
                raise
            continue
        if can_be_enrolled(family, enrolled):
            return family
        widest = widest or family
    assert widest is not None
    return widest


def can_be_enrolled(family: Family, enrolled: Sequence[Layout]) -> bool:
    """Whether enrolling would take the set beside the layouts that are enrolled."""
    basis, layouts = Basis(family.rules.mirror_counts, family.rules.height_weight), family.layouts
    # The last ones of a design are the most alike: they are compared first.
    outlooks = (outlook(layouts[i], [*enrolled, *layouts[:i]], basis) for i in reversed(range(len(layouts))))
    return all(refusal([prospect], enrolled) is None for prospect in outlooks)


def works(target: TaggedObject, rules: DesignRules, count: int, enrolled: Sequence[Layout]) -> bool:
    """Whether a set can be designed, and enrolled in addition to the layouts already in use."""
    try:
        family = design(target, rules, count, None, enrolled)
    except UsageError:
        return False
    return can_be_enrolled(family, enrolled)
