"""What to ask of `tagid layouts design` instead, where a set cannot be made or would not be enrolled.

Every suggestion was designed and checked as enrolling would check it, so following it works.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from tagid.enrolling.enrollment import family_outlooks, refusal
from tagid.errors import UsageError
from tagid.tags.layouts.design import MAX_SLOTS, DesignRules, design
from tagid.tags.layouts.layout import MAX_REFLECTORS, Layout
from tagid.tags.layouts.objects import TaggedObject

_MORE_SLOTS = (16, 18, 20, 24)
_LEAST_SPACING_M = 0.04
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

    Args:
        target: the object with all its rows.
        rows: number of them requested.
        rules, count: as requested.
        enrolled: layouts already in use.
    """
    suggestions: list[str] = []
    for words, used, tried, number in _variations(target, rows, rules, count):
        if len(suggestions) == _MOST:
            break
        if works(target.with_rows(used), tried, number, enrolled):
            suggestions.append(words)
    return suggestions


def _variations(
    target: TaggedObject, rows: int, rules: DesignRules, count: int
) -> Iterator[tuple[str, int, DesignRules, int]]:
    """(settings, rows, rules, count) to try: what keeps the number of layouts first."""
    for more in range(rows + 1, len(target.rows) + 1):
        yield f"`rows={more}`", more, rules, count
    for slots in _MORE_SLOTS:
        if rules.slots < slots <= MAX_SLOTS:
            yield f"`slots={slots}`", rows, replace(rules, slots=slots), count
    for reflectors in (rules.reflectors + 1, rules.reflectors - 1):
        if 2 <= reflectors <= min(MAX_REFLECTORS, rules.slots):
            yield f"`reflectors={reflectors}`", rows, replace(rules, reflectors=reflectors), count
    for spacing in (0.06, 0.05, _LEAST_SPACING_M):
        if spacing < rules.spacing_m:
            yield f"`spacing={spacing:g}`", rows, replace(rules, spacing_m=spacing), count
    for fewer in range(count - 1, max(0, count - 12), -1):
        yield f"`count={fewer}`", rows, rules, fewer
        if fewer == count // 2:
            break
    fewer = min(count // 2, max(count - 12, 0))
    while fewer:
        yield f"`count={fewer}`", rows, rules, fewer
        fewer //= 2
    # Several settings together, for objects on which little fits.
    least = replace(rules, spacing_m=min(rules.spacing_m, _LEAST_SPACING_M))
    for reflectors in range(rules.reflectors - 1, 1, -1):
        for number in dict.fromkeys((count, 1)):
            words = [f"`reflectors={reflectors}`"]
            words += [f"`spacing={_LEAST_SPACING_M:g}`"] * (least != rules)
            words += [f"`count={number}`"] * (number != count)
            yield " ".join(words), rows, replace(least, reflectors=reflectors), number


def works(target: TaggedObject, rules: DesignRules, count: int, enrolled: Sequence[Layout]) -> bool:
    """Whether a set can be designed, and enrolled in addition to the layouts already in use."""
    try:
        family = design(target, rules, count, None, enrolled)
    except UsageError:
        return False
    known, weight = rules.mirror_counts, rules.height_weight
    outlooks = family_outlooks(family.layouts, enrolled, direction_known=known, height_weight=weight)
    return refusal(outlooks, enrolled) is None
