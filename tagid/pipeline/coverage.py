"""How much of a turn the views of a capture cover, and what an answer from a part of it is worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tagid.capture import Capture
from tagid.metadata import Ending
from tagid.pipeline.answer import Identification
from tagid.pipeline.standstill import stopped_words
from tagid.reading.calibration import Bound
from tagid.reading.reading import Reading
from tagid.reading.verdict import Code
from tagid.signal import median

if TYPE_CHECKING:
    from tagid.reading.ending import EndingCalibration

SURE = "sure"
"""`Ending.reason` of a scan that ended because the answer was certain."""
WHOLE_TURN = 0.97
"""Smallest share of a revolution that counts as complete: a gap of 10 degrees does not impair reading."""
LEAST_NAMED = 0.58
"""Smallest share of a revolution that names an object: a reflector on an opaque object is seen up to 75
degrees aside, so with a gap of more than 150 degrees some side was not seen, and what is there may be more
than the layout has."""


_VIEW_RAD = np.deg2rad(10)
"""Width of the sector that one view shows at most, rad: a gap of this width does not impair reading."""


@dataclass(frozen=True)
class Gap:
    """The widest gap between the directions from which an object was seen.

    Attributes:
        share: share of a turn that is covered: without this gap and others of more than 10 degrees, each less
            the usual step. A single view far from the others covers no side.
        sides: indexes of the two views beside the gap.
        shows_every_side: whether the part that is covered may name an object.
    """

    share: float
    sides: tuple[int, int]
    shows_every_side: bool


def widest_gap(capture: Capture) -> Gap | None:
    """The widest gap; None for a single view, or where neither angles nor positions are known yet.

    Antenna positions on any path cover the directions in which they lie from the origin.
    """
    if capture.views < 2:
        return None
    directions = capture.angles_rad
    if directions is None:
        ends = [end for end in (capture.antenna_positions_m, capture.receive_positions_m) if end is not None]
        if not ends:
            return None
        x, y = np.mean([end[:, :2] for end in ends], axis=0).T
        directions = np.arctan2(y, x)
    wrapped = np.mod(directions, 2 * np.pi)
    order = np.argsort(wrapped)
    gaps = np.diff(np.append(wrapped[order], wrapped[order[0]] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    step = median(gaps)
    excess = gaps - step
    uncovered = excess[widest] + excess[(excess > _VIEW_RAD) & (np.arange(len(gaps)) != widest)].sum()
    share = float(np.clip(1 - uncovered / (2 * np.pi), 0, 1))
    # A coarse step makes no direction seen: in this gap a view counts for its own width.
    blind = (gaps[widest] - min(step, _VIEW_RAD)) / (2 * np.pi)
    every = share >= LEAST_NAMED and blind <= 1 - LEAST_NAMED
    return Gap(share, (int(order[widest]), int(order[(widest + 1) % len(order)])), bool(every))


def share_seen(captures: Sequence[Capture]) -> float | None:
    """The share of a turn that the best of several recordings covers; None if it is unknown of all."""
    return max((gap.share for gap in map(widest_gap, captures) if gap is not None), default=None)


def ended_early(capture: Capture) -> bool:
    """Whether the recording ended on purpose before the turn did, because the answer was certain."""
    ended = capture.radar.ended
    return ended is not None and ended.reason == SURE


def of_the_part(reading: Reading, captures: Sequence[Capture]) -> Reading:
    """The reading as far as the parts of a turn that were seen carry it.

    A name, and that no tag shows, is withheld unless one of the captures shows every side of the object: in
    several, the object may lie in other directions. The bound on false accept is withheld where a capture is
    not of a whole turn, for which it is calibrated, unless the recording ended early with its own bound.

    Args:
        reading: of one capture, or of several jointly.
        captures: those that were read.
    """
    gaps = [widest_gap(capture) for capture in captures]
    shares = [0.0 if gap is None else gap.share for gap in gaps]
    unseen = not any(gap is not None and gap.shows_every_side for gap in gaps)
    if unseen or any(
        share < WHOLE_TURN and not ended_early(capture)
        for share, capture in zip(shares, captures, strict=True)
    ):
        reading = replace(reading, bound=None)
    if not unseen or reading.status not in ("identified", "no_tag"):
        return reading
    covered = f"the views cover {max(shares) * 360:.0f} of 360 degrees"
    if reading.status == "no_tag":
        return reading.refused(Code.PARTIAL, f"{covered}, and in these no tag shows")
    shows = f"the scans show {reading.layout}, but not every side"
    resolved = captures[int(np.argmax(shares))].motion.resolved
    if resolved is None or resolved.standstill is None:
        return reading.refused(Code.PARTIAL, f"{covered}, and in these {shows}")
    return reading.refused(Code.STOPPED, f"{stopped_words(resolved.standstill)}, and until then {shows}")


def ended_answer(
    answer: Identification,
    ending: Ending | None,
    false_accept: float,
    calibration: EndingCalibration | None = None,
) -> Identification:
    """The answer of a capture that ended early, with the bound of the whole procedure.

    The recording goes on for some scans while a look is read; a name that these contradict is withdrawn.

    Args:
        answer: of the captured part of the turn.
        ending: of its recording; the answer is returned unchanged unless it is that of an early ending.
        false_accept: of the whole scan.
        calibration: None for the package's own.
    """
    reading = answer.reading
    if ending is None or ending.reason != SURE or reading is None:
        return answer
    from tagid.reading.ending import EndingCalibration
    from tagid.reading.looks import SPENT

    if answer.status == "identified" and reading.layout == ending.layout:
        known = calibration or EndingCalibration.shipped()
        bound = Bound(
            ending.p_value or 1.0, SPENT * false_accept, ending.turns or 0, known.stratum, known.population
        )
        return replace(answer, reading=replace(reading, bound=bound))
    if answer.status != "identified":
        return answer
    reason = f"the first {ending.share or 0:.0%} of the turn show {ending.layout}, all scans {reading.layout}"
    withdrawn = replace(reading.refused(Code.DISAGREE, reason), bound=None)
    return replace(answer, status="unknown", reading=withdrawn, label="")
