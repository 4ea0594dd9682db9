"""The winner, its lead over what is not the same, and the reason in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tagid.reading.arrangement import MOUNTING_SD_M
from tagid.reading.hypothesis import Hypothesis, Joint, differ_in_height
from tagid.reading.spectra import Complex
from tagid.reading.transfers.plain import BARE, FACING, POINTS

SURE = float(np.log(1000))
"""Lead from which a name is given, nats: one false in a thousand where the hypotheses are complete."""
SAME_M = 8e-3
"""Reflectors nearer than this are the same ones."""
ASIDE_M = 3 * MOUNTING_SD_M
"""On a body, reflectors that stand farther aside along their ring are another tag."""
BUILT_M = MOUNTING_SD_M
"""Where nothing stands beside them, reflectors that are off by more are another tag."""


@dataclass(frozen=True, eq=False)
class Decision:
    """What a recording shows.

    Attributes:
        status: "identified", "ambiguous", "no_tag" or "unknown".
        name: of the layout or enrolled object, where one is identified.
        lead: Lambda, log evidence of the best that has a name over the best other, nats.
        reason: the winning hypothesis in words.
        best, rival: the best hypothesis that has a name and the best that is not it.
    """

    status: str
    name: str | None
    lead: float
    reason: str
    best: Hypothesis | None
    rival: Hypothesis | None


def decide(hypotheses: Sequence[Hypothesis], sure: float = SURE) -> Decision:
    """The decision over the hypotheses of one recording."""
    named = [one for one in hypotheses if one.name is not None]
    best = max(named, key=lambda one: one.log_z, default=None)
    others = [one for one in hypotheses if best is None or not is_same(one, best)]
    rival = max(others, key=lambda one: one.log_z)
    untagged = max((one for one in hypotheses if not one.tagged), key=lambda one: one.log_z)
    named_best = None if best is None else Joint(best.log_z, best)
    return settled(named_best, Joint(rival.log_z, rival), Joint(untagged.log_z, untagged), sure)


def settled(named: Joint | None, other: Joint, untagged: Joint, sure: float = SURE) -> Decision:
    """The decision by the log evidences of the best with a name, the best other and the best untagged."""
    rival = other.shown
    best, lead = (None, -np.inf) if named is None else (named.shown, named.log_z - other.log_z)
    if best is not None and lead >= sure:
        return Decision("identified", best.name, lead, "", best, rival)
    winner = named if named is not None and lead > 0 else other
    if winner.log_z - untagged.log_z < sure:
        return Decision("no_tag", None, lead, words(untagged.shown), best, rival)
    if best is None:
        return Decision("unknown", None, lead, words(rival), None, rival)
    if rival.name is not None:
        return Decision("ambiguous", None, lead, f"{words(best)}, or {words(rival)}", best, rival)
    reason = words(rival) if winner is other else f"{words(best)}, or nearly as likely: {words(rival)}"
    return Decision("unknown", None, lead, reason, best, rival)


def is_same(one: Hypothesis, best: Hypothesis) -> bool:
    """The hypothesis describes the reflectors of the layout `best`, or is the same enrolled object."""
    if one is best or one.name is not None:
        return one.name == best.name
    if one.found.model.tag is None or best.layout is None:
        return False
    own, other = one.found, best.found
    empty = not own.model.transfer.body or own.model.transfer.clear
    target = other.places
    if differ_in_height(own, other):
        return False
    if best.middle and empty:
        target = np.append(target, other.centre)
    alike = own.places
    every = np.concatenate([alike, own.odd] + ([] if empty or not has_middle(best) else [[own.centre]]))
    apart = np.abs(target[:, None] - every)
    stray = np.abs(alike[:, None] - target).min(axis=1) >= SAME_M
    if (apart.min(axis=1) >= SAME_M).any() or stray.any():
        return False
    tag = other.model.tag
    if tag is None or len(tag.radius_m) != len(target):
        return True
    nominal = tag.radius_m * np.exp(1j * tag.angle)
    there = every[apart.argmin(axis=1)]
    if own.model.transfer in (BARE, FACING, POINTS):
        # Their echo is the same from all sides: the body's centre says nothing of the ring's.
        return _off(nominal, there) < BUILT_M
    return _about(own.centre, nominal, there, max(SAME_M, 3 * own.model.transfer.radius_sd_m))


def has_middle(one: Hypothesis) -> bool:
    """The layout has a reflector in the middle, which looks like a body."""
    tag = one.found.model.tag
    return one.middle or (tag is not None and bool((tag.radius_m < SAME_M).any()))


def _about(centre: complex, nominal: Complex, places: Complex, slack_m: float) -> bool:
    """Whether places (K,) are those of a layout that stands about a body's centre, out by some slack."""
    seen = places - centre
    out = np.abs(nominal) > 0
    turn = np.vdot(nominal, seen)
    aside = np.angle(seen[out] * np.conj(nominal[out] * turn)) * np.abs(nominal[out])
    return bool((np.abs(aside) < ASIDE_M).all() and (np.abs(np.abs(seen) - np.abs(nominal)) < slack_m).all())


def _off(a: Complex, b: Complex) -> float:
    """Largest distance between points a (K,) and b (K,) under the best rigid motion, m."""
    u, v = a - a.mean(), b - b.mean()
    turn = np.vdot(u, v)
    return float(np.abs(u * (turn / max(abs(turn), 1e-30)) - v).max())


def words(one: Hypothesis) -> str:
    """A hypothesis for people."""
    model = one.found.model
    odd = {0: "", 1: " and one odd scatterer"}.get(model.odd, f" and {model.odd} odd scatterers")
    where = f" on {model.words}" if model.transfer.body else ""
    if model.whole:
        where = f", less or more than on {model.words}"
    if one.layout is not None:
        return f"{one.layout.name}{where}{odd}"
    if model.tag is None and model.tagged:
        return model.words + odd
    if model.tag is None:
        body = "an object" if model.transfer is POINTS and not model.body_parameters else model.words
        return (f"{body} without a tag" if model.transfer.body else "nothing but clutter") + odd
    places = one.found.places - one.found.centre
    count = len(places)
    if count == 1:
        return f"one reflector{where}{odd}"
    angle = np.sort(np.rad2deg(np.angle(places)) % 360)
    gaps = np.diff(np.append(angle, angle[0] + 360))
    gaps = np.sort(gaps)[:-1] if count == 2 else gaps
    apart = " and ".join(f"{g:.0f}" for g in gaps)
    out = np.abs(places).mean() * 1e3
    return f"{count} reflectors {apart} degrees apart, {out:.0f} mm from the centre{where}{odd}"
