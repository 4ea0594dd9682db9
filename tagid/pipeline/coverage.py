"""How much of a turn the views of a capture cover, and what an answer from a part of it is worth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tagid.capture import Capture
from tagid.pipeline.standstill import stopped_words
from tagid.signal import median
from tagid.tags.matching.reading import Reading
from tagid.tags.verdicts.verdict import Code

WHOLE_TURN = 0.97
"""Smallest share of a revolution that counts as complete: a gap of 10 degrees does not impair reading."""
LEAST_NAMED_TURNS = 0.58
"""Smallest part of a turn that names an object: a reflector on an opaque object is seen up to 75 degrees
aside, so before that some side has not been seen, and what is there may be more than the layout has."""


@dataclass(frozen=True)
class Gap:
    """The widest gap between the views of a turn.

    Attributes:
        share: share of a turn that is covered. The uncovered part is the gap minus the usual step.
        sides: indexes of the two views beside the gap.
    """

    share: float
    sides: tuple[int, int]


def widest_gap(capture: Capture) -> Gap | None:
    """The widest gap; None for free antenna positions or a single view."""
    if capture.angles_rad is None or capture.views < 2:
        return None
    wrapped = np.mod(capture.angles_rad, 2 * np.pi)
    order = np.argsort(wrapped)
    gaps = np.diff(np.append(wrapped[order], wrapped[order[0]] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    share = float(np.clip(1 - (gaps[widest] - median(gaps)) / (2 * np.pi), 0, 1))
    return Gap(share, (int(order[widest]), int(order[(widest + 1) % len(order)])))


def turn_share(capture: Capture) -> float | None:
    """Share of a turn that the views of a capture cover, up to 1; None for free antenna positions."""
    gap = widest_gap(capture)
    return None if gap is None else gap.share


def ended_early(capture: Capture) -> bool:
    """Whether the recording ended on purpose before the turn did, because the answer was certain."""
    ended = capture.radar.ended
    return ended is not None and ended.reason == "sure"


def of_the_part(reading: Reading, capture: Capture) -> Reading:
    """The reading as far as the part of a turn that was seen carries it.

    A name is withheld where the turn stopped before every side of the object was seen, and the bound on false
    accept from any part: its calibration is of whole turns. In a small part the far side, and a tag there,
    were not seen: that no tag shows says nothing.
    """
    info = capture.motion.resolved
    unseen = info is not None and info.turns is not None and info.turns < LEAST_NAMED_TURNS
    if info is not None and info.standstill is not None and unseen and reading.status == "identified":
        until = f"{stopped_words(info.standstill)}, and until then the scans show {reading.layout}"
        return replace(reading.refused(Code.STOPPED, f"{until}, but not every side"), bound=None)
    gap = None if ended_early(capture) else widest_gap(capture)
    if gap is None or gap.share >= WHOLE_TURN:
        return reading
    if reading.status == "no_tag" and gap.share < LEAST_NAMED_TURNS:
        covered = f"the views cover {gap.share * 360:.0f} of 360 degrees, and in these no tag shows"
        return reading.refused(Code.PARTIAL, covered)
    return replace(reading, bound=None)
