"""Several recordings of one object: the log evidence of what they share adds.

Every recording has its own pose, body, clutter and odd scatterers; the tag is the same. By the chain rule the
evidence of an arrangement is that in the clearest recording, where its angles are free or a layout's mounting
is, times that in the others, where its reflectors stand just so, up to a rigid motion: what the others add to
the precision of the angles is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from operator import attrgetter

import numpy as np

from tagid.reading.arrangement import Arrangement
from tagid.reading.decision import Decision, Needed, decide, has_middle, is_same, settled
from tagid.reading.descent import Estimate, best_powers, refined
from tagid.reading.hypotheses import Contest
from tagid.reading.hypothesis import (
    MOST_ODD,
    Arranged,
    Candidate,
    Hypothesis,
    Joint,
    best_bare,
    disc_of,
    pose_of,
)
from tagid.reading.smooth import smoothed
from tagid.tags.layouts.layout import Layout

STRANGERS = 3
"""Arrangements of every recording that are not enrolled, which are looked for in the others."""
NAMES = 2
"""Names whose mounting is the same in all recordings; others are supposed to lose with any."""
REACH = 60.0
"""Those that are worse than the best explanation of their recording by more are not, nats."""

ANOTHER = float(np.log(1e-4))
"""Log probability that a recording is of another object than the rest."""

LOOKED_FOR = 4
"""Bodies beside which an arrangement is looked for that another recording has shown, and starts of it."""
ON_RING_M = 2e-3
"""Reflectors whose distances from the centre differ by less stand on a ring, m."""
TURNS_RAD = tuple(np.deg2rad(np.arange(0, 360, 4)))
"""At which it is looked for."""

_log_z = attrgetter("log_z")


def decide_together(contests: Sequence[Contest], needed: Needed = Needed()) -> Decision:
    """The decision over contests of one object that were run."""
    if len(contests) == 1:
        return decide(contests[0].hypotheses, needed)
    untagged = _sum([best_of(contest, None) for contest in contests])
    named: dict[str, Joint] = {}
    every = [hypothesis for contest in contests for hypothesis in contest.hypotheses]
    layouts = {hypothesis.layout.name: hypothesis.layout for hypothesis in every if hypothesis.layout}
    for name in dict.fromkeys(hypothesis.name for hypothesis in every if hypothesis.name):
        known = [best_of(contest, name) for contest in contests]
        if layout := layouts.get(name):
            known = [best or look_for(contest, layout) for contest, best in zip(contests, known, strict=True)]
        if all(known):
            named[name] = _sum(known)
    if not named:
        return settled(None, untagged, untagged, needed)
    first = clearest(contests)
    for name in sorted(named, key=lambda name: -named[name].log_z)[:NAMES]:
        hypothesis = best_of(first, name)
        if hypothesis is not None and hypothesis.estimate.model.tag is not None:
            named[name] = max(named[name], _chain(contests, first, hypothesis), key=_log_z)
    best = max(named, key=lambda name: named[name].log_z)
    others = [untagged, *(named[name] for name in named if name != best)]
    same = best_of(first, best)
    for contest in contests:
        for hypothesis in _shown(contest, best):
            there = hypothesis
            if contest is not first:
                there = freed(first, look_for(first, None, _rigid(hypothesis)))
            if same is None or not is_same(there, same):
                others.append(_chain(contests, first, there, best))
    others += _mixed(contests, best)
    bare = [best_bare(contest.hypotheses, best) for contest in contests]
    joint = replace(
        named[best], bare=sum(-np.inf if hypothesis is None else hypothesis.log_z for hypothesis in bare)
    )
    return settled(joint, max(others, key=_log_z), untagged, needed)


def _mixed(contests: Sequence[Contest], name: str) -> list[Joint]:
    """The recordings as of a name or, where they show something else clearly, of another object."""
    total, another = 0.0, None
    for contest in contests:
        winner, named = max(contest.hypotheses, key=_log_z), best_of(contest, name)
        if named is None or winner.log_z + ANOTHER > named.log_z:
            total, another = total + winner.log_z + ANOTHER, winner
        else:
            total += named.log_z
    return [] if another is None else [Joint(total, another, mixed=True)]


def clearest(contests: Sequence[Contest]) -> Contest:
    """The recording that shows reflectors most clearly."""
    return max(contests, key=_shows)


def _shows(contest: Contest) -> float:
    """Log evidence of there being reflectors."""
    tagged = max(
        (hypothesis.log_z for hypothesis in contest.hypotheses if hypothesis.tagged), default=-np.inf
    )
    return float(tagged - max(hypothesis.log_z for hypothesis in contest.hypotheses if not hypothesis.tagged))


def _chain(contests: Sequence[Contest], first: Contest, shown: Hypothesis, other: str | None = None) -> Joint:
    """What a recording has shown, and its reflectors just where they stand in the others.

    Args:
        other: name of a layout that it is not. Where that has a reflector in the middle and nothing stands
            there in this recording, nothing does in the others.
    """
    tag, log = _rigid(shown), shown.log_z
    for contest in contests:
        named = None if other is None else best_of(contest, other)
        empty = named is not None and has_middle(named) and not shown.estimate.model.covers_middle
        if contest is not first:
            log += look_for(
                contest, None, tag, partial(is_same, best=named) if empty and named else None
            ).log_z
    return Joint(log, shown)


def _rigid(hypothesis: Hypothesis) -> Arrangement:
    tag = hypothesis.estimate.model.tag
    return Arrangement.rigid(
        hypothesis.estimate.positions - hypothesis.estimate.centre, None if tag is None else tag.height_m
    )


def best_of(contest: Contest, name: str | None) -> Hypothesis | None:
    """The best hypothesis of a name; None: of what has no tag."""
    some = [
        hypothesis
        for hypothesis in contest.hypotheses
        if hypothesis.name == name and (name or not hypothesis.tagged)
    ]
    return max(some, key=_log_z, default=None)


def _sum(some: Sequence[Hypothesis | None]) -> Joint:
    known = [hypothesis for hypothesis in some if hypothesis is not None]
    return Joint(sum(hypothesis.log_z for hypothesis in known), max(known, key=_log_z))


def _shown(contest: Contest, name: str) -> list[Hypothesis]:
    """The best arrangements that a recording shows and that are not those of a name, each once."""
    named = best_of(contest, name)
    limit = max(hypothesis.log_z for hypothesis in contest.hypotheses) - REACH
    out: list[Hypothesis] = []
    for hypothesis in sorted(contest.hypotheses, key=lambda hypothesis: -hypothesis.log_z):
        strange = (
            hypothesis.estimate.model.tag is not None and hypothesis.name is None and hypothesis.log_z > limit
        )
        if not strange or (named and is_same(hypothesis, named)):
            continue
        if all(pose_of(_rigid(other), hypothesis.estimate.positions) is None for other in out):
            out.append(hypothesis)
    return out[:STRANGERS]


def look_for(
    contest: Contest,
    layout: Layout | None,
    tag: Arrangement | None = None,
    same: Callable[[Hypothesis], bool] | None = None,
) -> Hypothesis:
    """A layout, or a rigid arrangement that is not enrolled, beside the bodies that explain most.

    Args:
        same: it is not, which it were with a body in its middle.
    """
    bodies: dict[object, Estimate] = {}
    for hypothesis in sorted(contest.hypotheses, key=lambda hypothesis: -hypothesis.log_z):
        if not hypothesis.estimate.model.whole and (
            same is None or not hypothesis.estimate.model.covers_middle
        ):
            bodies.setdefault(
                (type(hypothesis.estimate.model), hypothesis.estimate.model.transfer), hypothesis.estimate
            )
    starts: list[Candidate] = []
    for estimate in list(bodies.values())[:LOOKED_FOR]:
        arranged = None if layout is None else Arranged.of(layout, estimate.model.covers_middle)
        arrangement = tag if arranged is None else arranged.tag
        assert arrangement is not None
        disc = disc_of(float(arrangement.radius_m.max()))
        model = replace(estimate.model, tag=arrangement, odd=0, disc=disc)
        for turn in TURNS_RAD:
            x = np.concatenate([estimate.x[: model.head], [turn, 0.0], np.zeros(model.lifts)])
            log = best_powers(contest.spectra, model, x, 1e-2)[1]
            starts.append(Candidate(log, layout, model, x, arranged is not None and arranged.middle))
    starts.sort(key=lambda start: -start.log)
    before = len(contest.hypotheses)
    for start in starts[:LOOKED_FOR]:
        estimate = refined(contest.spectra, start.model, start.x, (1e-2, None))
        contest.grow(contest.add(layout, estimate, start.middle), MOST_ODD)
    some = [hypothesis for hypothesis in contest.hypotheses[before:] if same is None or not same(hypothesis)]
    # What another recording has shown is no hypothesis of this one.
    del contest.hypotheses[before:]
    return smoothed(contest.spectra, some)[0]


def freed(contest: Contest, hypothesis: Hypothesis) -> Hypothesis:
    """The same reflectors with free angles, on a free ring or anywhere."""
    estimate, model = hypothesis.estimate, hypothesis.estimate.model
    assert model.tag is not None
    positions, rise = estimate.positions - estimate.centre, float(np.mean(model.heights_of(estimate.x)[0]))
    tag = Arrangement.about(positions, ON_RING_M)
    free = replace(model, tag=tag)
    odd = estimate.x[len(estimate.x) - model.spot * model.odd :]
    x = np.r_[estimate.x[: model.head], np.zeros(tag.turns + tag.stretches), free.lifts * [rise], odd]
    freed = refined(contest.spectra, free, x, (None,))
    return smoothed(contest.spectra, [Hypothesis(None, freed, freed.log_z)])[0]
