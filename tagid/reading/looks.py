"""Readings at fixed shares of a turn, and the statistic by which a scan may end before the turn does.

Neighbouring views are correlated and the model is never exact, so the bounds of a sequential likelihood ratio
test (Wald 1945) do not hold here. Instead the scans are read at a few fixed shares of the turn, and the
largest result of all of them, over a whole turn, is what the calibration orders (`calibration`): the bound
then holds for the whole procedure, however correlated its looks are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from tagid.angles.views import average_into_views
from tagid.capture import Capture
from tagid.errors import DataError
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.reading.decision import SURE, decide
from tagid.reading.preview import layout_evidence
from tagid.reading.reader import contest
from tagid.tags.bodies.signature import Signature
from tagid.tags.layouts.layout import Layout

LOOKS = (0.45, 0.6, 0.75)
"""Shares of a turn at which the scans are read. A scan may end at all but the first of them.

A reflector on an opaque object is seen up to 75 degrees aside: before 0.58 of a turn, some side has not been
seen from anywhere, and what is there may be more than the layout has. Of 2,000 turns without an enrolled tag,
six were named alike at 0.3 and 0.45 of the turn, with scores as high as those of tags, and none at 0.7."""
LEAST_REFLECTORS = 3
"""Fewest reflectors of a layout that may end a scan. In 4,000 turns without an enrolled tag, ten parts of a
turn showed a layout of two, with scores up to fifty times those of tags, and one a layout of three: two
bright points on a body may lie anywhere."""
VIEWS_PER_TURN = 72
"""More scans than this are averaged: a sector of 5 degrees costs a reflector at 0.11 m 0.9 dB, and the time
of a look does not grow with the scan rate."""
SPENT = 0.3
"""Share of the false-accept probability that the early looks may use. A name that the whole turn gives
has the rest."""
_EXTENT_M = 0.5


@dataclass(frozen=True, eq=False)
class Look:
    """The reading of the first part of a turn.

    Attributes:
        share: of a turn, 0..1.
        views: number of views.
        layout: the layout that the tag is likeliest of; None if none is named.
        score: its lead over every other hypothesis, nats; -inf if none is named.
    """

    share: float
    views: int
    layout: str | None = None
    score: float = -inf


def part_of_turn(capture: Capture, share: float) -> Capture:
    """The first part of a turn, averaged into views where there are more scans than `VIEWS_PER_TURN`.

    Args:
        capture: with angles, in the order of recording.
        share: of a turn, 0..1.

    Raises:
        DataError: the capture has no angles.
    """
    angles = capture.angles_rad
    if angles is None:
        raise DataError("a part of a turn needs the angles of the scans")
    inside = np.flatnonzero(np.abs(angles - angles[0]) <= 2 * np.pi * share + 1e-9)
    part = capture if len(inside) == capture.views else capture.select(inside)
    return average_into_views(part, VIEWS_PER_TURN) if part.views > share * VIEWS_PER_TURN + 1 else part


def look(
    part: Capture, layouts: Sequence[Layout], share: float, signatures: Sequence[Signature] = ()
) -> Look:
    """Read the first part of a turn.

    The settings are fixed, because the calibration holds only for them.

    Args:
        part: from `part_of_turn`.
        layouts: the enrolled ones, at least one.
        share: of the turn.
        signatures: enrolled bodies and objects.
    """
    nothing = Look(share, part.views)
    try:
        scans = preprocess(part, settings=PreprocessSettings(matched_filter=False, extent_m=_EXTENT_M))
        contest_of_look = contest(scans, layouts, signatures)
        if layout_evidence(contest_of_look)[0].log_evidence < SURE:
            # A closer look would hardly name what its first step does not show.
            return nothing
        contest_of_look.run()
    except DataError:
        return nothing
    decision = decide(contest_of_look.hypotheses)
    best = decision.best
    if best is None or best.layout is None or best.layout.size < LEAST_REFLECTORS or decision.lead < SURE:
        return nothing
    return replace(nothing, layout=best.name, score=decision.lead)


def agreed(looks: Sequence[Look]) -> tuple[str | None, float]:
    """The layout that the last two looks name, and the lower score of the two; (None, -inf) if they do not.

    Two looks have to agree, because a chance likeness rarely survives a change of the aperture.
    """
    if len(looks) < 2:
        return None, -inf
    before, newest = looks[-2], looks[-1]
    if newest.layout is None or newest.layout != before.layout:
        return None, -inf
    return newest.layout, min(before.score, newest.score)


def largest(looks: Sequence[Look]) -> float:
    """The statistic of a whole turn: the largest score at which a scan could have ended early.

    Args:
        looks: of all `LOOKS`, in their order.
    """
    return max(agreed(looks[: count + 1])[1] for count in range(1, len(looks)))
