"""The winner, its lead over what is not the same, and the reason in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tagid.reading.arrangement import MOUNTING_SD_M, Arrangement, gaps_deg
from tagid.reading.hypothesis import Hypothesis, Joint, best_bare, differ_in_height, pose_of
from tagid.reading.transfers.plain import BARE, FACING, POINTS
from tagid.reading.verdict import Code
from tagid.types import Complex

SURE = float(np.log(1000))
"""Lead from which a name is given, nats: one false in a thousand where the hypotheses are complete."""
SAME_M = 8e-3
"""Reflectors nearer than this are the same ones."""
ASIDE_M = 3 * MOUNTING_SD_M
"""On a body, reflectors that stand farther aside along their ring are another tag."""
ALIKE_DEG = 8.0
"""Reflectors of another radius stand in the same directions where they differ by less."""
BUILT_M = MOUNTING_SD_M
"""Where nothing stands beside them, reflectors that are off by more are another tag."""


@dataclass(frozen=True)
class Needed:
    """Leads from which a name is given, nats; inf where none is.

    Attributes:
        lead: of any hypothesis of that name.
        bare: of one without a body: fewer strangers look like it.
    """

    lead: float = SURE
    bare: float = SURE


@dataclass(frozen=True, eq=False)
class Decision:
    """What a recording shows.

    Attributes:
        status: "identified", "ambiguous", "no_tag" or "unknown".
        name: of the layout or enrolled object, where one is identified.
        lead: Lambda, log evidence of the best that has a name over the best other, nats.
        bare: the same of that name's best hypothesis without a body, nats; -inf where there is none.
        reason: the winning hypothesis in words.
        best, rival: the best hypothesis that has a name and the best that is not it.
        winner: the one of the two that explains more, or the best untagged one where that is what shows.
        code: why nothing is named, for programs.
    """

    status: str
    name: str | None
    lead: float
    reason: str
    best: Hypothesis | None
    rival: Hypothesis
    winner: Hypothesis
    code: Code = Code.NONE
    bare: float = -np.inf


def decide(hypotheses: Sequence[Hypothesis], needed: Needed = Needed()) -> Decision:
    """The decision over the hypotheses of one recording."""
    named = [hypothesis for hypothesis in hypotheses if hypothesis.name is not None]
    best = max(named, key=lambda hypothesis: hypothesis.log_z, default=None)
    others = [hypothesis for hypothesis in hypotheses if best is None or not is_same(hypothesis, best)]
    rival = max(others, key=lambda hypothesis: hypothesis.log_z)
    untagged = _untagged(hypotheses)
    if best is None:
        return settled(None, Joint(rival.log_z, rival), untagged, needed)
    bare = best_bare(hypotheses, best.name or "")
    named_best = Joint(best.log_z, best, bare=-np.inf if bare is None else bare.log_z)
    return settled(named_best, Joint(rival.log_z, rival), untagged, needed)


def settled(named: Joint | None, other: Joint, untagged: Joint, needed: Needed = Needed()) -> Decision:
    """The decision by the log evidences of the best with a name, the best other and the best untagged."""
    rival = other.shown
    best, lead, bare = None, -np.inf, -np.inf
    if named is not None:
        best, lead, bare = named.shown, named.log_z - other.log_z, named.bare - other.log_z
    if best is not None and (lead >= needed.lead or bare >= needed.bare):
        return Decision("identified", best.name, lead, "", best, rival, best, bare=bare)

    def refused(status: str, reason: str, winner: Hypothesis, code: Code) -> Decision:
        return Decision(status, None, lead, reason, best, rival, winner, code, bare)

    winner = named if named is not None and lead > 0 else other
    if other.mixed and winner is other:
        return refused("unknown", f"one of the recordings shows {words(rival)}", rival, Code.DISAGREE)
    if winner.log_z - untagged.log_z < SURE:
        code = Code.NO_ECHO if _silent(untagged.shown) else Code.NO_TAG
        return refused("no_tag", words(untagged.shown), untagged.shown, code)
    if best is None:
        return refused("unknown", _stranger(rival), rival, Code.OTHER)
    if rival.name is not None:
        return refused("ambiguous", f"{words(best)}, or {words(rival)}", winner.shown, Code.AMBIGUOUS)
    if winner is other:
        return refused("unknown", _stranger(rival), rival, _difference(rival, best))
    code = Code.WEAK if np.isfinite(needed.lead) else Code.UNCALIBRATED
    but = f", or nearly as likely: {words(rival)}"
    if lead >= SURE:
        but = ", but other objects look as much like it"
        if code is Code.UNCALIBRATED:
            but = ", and no calibration bears that out"
    return refused("unknown", words(best) + but, best, code)


def _stranger(winner: Hypothesis) -> str:
    """A hypothesis without a name; of reflectors, that nobody enrolled their arrangement."""
    arranged = winner.estimate.model.tag is not None and len(winner.estimate.positions) > 1
    return words(winner) + ("; this arrangement is not enrolled" if arranged else "")


def _untagged(hypotheses: Sequence[Hypothesis]) -> Joint:
    """The best hypothesis without a tag; it is shown as nothing where it is no more certain than that."""
    some = [hypothesis for hypothesis in hypotheses if not hypothesis.tagged]
    best = max(some, key=lambda hypothesis: hypothesis.log_z)
    nothing = [hypothesis for hypothesis in some if _silent(hypothesis)]
    near = [hypothesis for hypothesis in nothing if best.log_z - hypothesis.log_z < SURE]
    return Joint(best.log_z, max(near, key=lambda hypothesis: hypothesis.log_z, default=best))


def _silent(hypothesis: Hypothesis) -> bool:
    """Whether nothing turns but noise."""
    model = hypothesis.estimate.model
    return not (model.transfer.body or model.tag or model.odd or hypothesis.estimate.powers.clutter)


def _difference(winner: Hypothesis, best: Hypothesis) -> Code:
    """How an arrangement that is not enrolled differs from the likeliest layout."""
    if best.layout is None or winner.estimate.model.tag is None:
        return Code.OTHER
    target, positions = best.estimate.positions, winner.estimate.positions
    if best.middle and not winner.estimate.model.covers_middle:
        target = np.append(target, best.estimate.centre)
    apart = np.abs(target[:, None] - positions)
    kept = int((apart.min(axis=1) < SAME_M).sum())
    if kept == len(target) == len(positions) - 1:
        return Code.EXTRA
    if len(positions) < len(target) and (apart.min(axis=0) < SAME_M).all():
        return Code.MISSING
    if len(positions) == len(target):
        pose = pose_of(Arrangement.rigid(target - best.estimate.centre), positions)
        if pose is not None or 2 * kept >= len(target):
            return Code.DISPLACED
        if _turned_alike(target - best.estimate.centre, positions - winner.estimate.centre):
            return Code.RADIUS
    return Code.OTHER


def _turned_alike(target: Complex, positions: Complex) -> bool:
    """Whether reflectors about their centres stand in the same directions, at other distances."""
    apart = np.sort(gaps_deg(np.angle(target))) - np.sort(gaps_deg(np.angle(positions)))
    return bool(np.abs(apart).max() < ALIKE_DEG)


def is_same(hypothesis: Hypothesis, best: Hypothesis) -> bool:
    """The hypothesis describes the reflectors of the layout `best`, or is the same enrolled object."""
    if hypothesis is best or hypothesis.name is not None:
        return hypothesis.name == best.name
    if hypothesis.estimate.model.tag is None or best.layout is None:
        return False
    estimate, other = hypothesis.estimate, best.estimate
    empty = not estimate.model.transfer.body or estimate.model.transfer.clear
    target = other.positions
    if differ_in_height(estimate, other):
        return False
    if best.middle and empty:
        target = np.append(target, other.centre)
    alike = estimate.positions
    every = np.concatenate(
        [alike, estimate.odd] + ([] if empty or not has_middle(best) else [[estimate.centre]])
    )
    apart = np.abs(target[:, None] - every)
    stray = np.abs(alike[:, None] - target).min(axis=1) >= SAME_M
    if (apart.min(axis=1) >= SAME_M).any() or stray.any():
        return False
    tag = other.model.tag
    if tag is None or len(tag.radius_m) != len(target):
        return True
    nominal = tag.radius_m * np.exp(1j * tag.angle)
    there = every[apart.argmin(axis=1)]
    if estimate.model.transfer in (BARE, FACING, POINTS):
        # Their echo is the same from all sides: the body's centre says nothing of the ring's.
        return _off(nominal, there) < BUILT_M
    return _about(estimate.centre, nominal, there, max(SAME_M, 3 * estimate.model.transfer.radius_sd_m))


def has_middle(hypothesis: Hypothesis) -> bool:
    """The layout has a reflector in the middle, which looks like a body."""
    tag = hypothesis.estimate.model.tag
    return hypothesis.middle or (tag is not None and bool((tag.radius_m < SAME_M).any()))


def _about(centre: complex, nominal: Complex, positions: Complex, slack_m: float) -> bool:
    """Whether places (K,) are those of a layout that stands about a body's centre, out by some slack."""
    seen = positions - centre
    out = np.abs(nominal) > 0
    turn = np.vdot(nominal, seen)
    aside = np.angle(seen[out] * np.conj(nominal[out] * turn)) * np.abs(nominal[out])
    return bool((np.abs(aside) < ASIDE_M).all() and (np.abs(np.abs(seen) - np.abs(nominal)) < slack_m).all())


def _off(a: Complex, b: Complex) -> float:
    """Largest distance between points a (K,) and b (K,) under the best rigid motion, m."""
    u, v = a - a.mean(), b - b.mean()
    turn = np.vdot(u, v)
    return float(np.abs(u * (turn / max(abs(turn), 1e-30)) - v).max())


def words(hypothesis: Hypothesis) -> str:
    """A hypothesis for people."""
    model = hypothesis.estimate.model
    odd = {0: "", 1: " and one odd scatterer"}.get(model.odd, f" and {model.odd} odd scatterers")
    where = f" on {model.words}" if model.transfer.body else ""
    if model.whole:
        where = f", less or more than on {model.words}"
    if hypothesis.layout is not None:
        return f"{hypothesis.layout.name}{where}{odd}"
    if model.tag is None and model.tagged:
        return model.words + odd
    if model.tag is None:
        body = "an object" if model.transfer is POINTS and not model.body_parameters else model.words
        if model.transfer.body and model.odd:
            return f"{body}{odd}, no tag told apart from {'it' if model.odd == 1 else 'them'}"
        return (f"{body} without a tag" if model.transfer.body else "nothing but clutter") + odd
    positions = hypothesis.estimate.positions - hypothesis.estimate.centre
    count = len(positions)
    if count == 1:
        return f"one reflector{where or ' or round body'}{odd}"
    gaps = gaps_deg(np.angle(positions))
    gaps = np.sort(gaps)[:-1] if count == 2 else gaps
    *others, last = (f"{gap:.0f}" for gap in gaps)
    apart = " and ".join(filter(None, (", ".join(others), last)))
    out = np.abs(positions).mean() * 1e3
    return f"{count} reflectors {apart} degrees apart, {out:.0f} mm from the centre{where}{odd}"
