"""Where an object stands: about the axis, or anywhere on the table.

Whatever an object is, its echoes come from a disc about its centre, and its body returns about the same from
all sides: the evidence of clutter and of a round body about a place tells where the object stands, to some
millimetres, before anything is known of its reflectors. What is then tried about that place competes with
all that was tried about the axis.
"""

from __future__ import annotations

from operator import itemgetter

import numpy as np

from tagid.reading.columns import Model
from tagid.reading.decision import Needed, decide
from tagid.reading.descent import BODY, CLUTTER, best_powers
from tagid.reading.hypotheses import Contest
from tagid.reading.hypothesis import as_layouts, moved
from tagid.reading.spectra import Spectra
from tagid.types import Complex, Floats

ELSEWHERE = 0.1
"""Share of the objects that nobody has placed about the axis."""
REACH_M = 0.1
"""They stand within this of the axis, m."""
NEAR_M = 0.012
"""The search about the axis covers places up to here, m."""
POSED = 3
"""Arrangements whose points are compared with those of layouts."""
_STEP_M = 5e-3
"""Distance of the places that are tried first, m: it changes the phase of an echo by up to 0.8 rad."""
_STEPS_M = (3e-3, 1.5e-3)
"""Steps from the likeliest of them to the place."""
_AROUND = np.array([1, 1 + 1j, 1j, 1j - 1, -1, -1 - 1j, -1j, 1 - 1j])


def settled(contest: Contest, needed: Needed = Needed()) -> Contest:
    """What competes in a recording about the place where its object stands: the contest itself, run, where
    that is the axis, or what is tried about it has a name.
    """
    if decide(contest.run(), needed).status == "identified":
        return contest
    centres = [likeliest(contest.spectra), *_of_reflectors(contest)]
    there = max((contest.about(place) for place in centres), key=Contest.look)
    # Its centre is as uncertain about that place, which may be anywhere, as it would be about the axis.
    cost = float(np.log(REACH_M**2 / (2 * contest.priors.centre_m**2) / ELSEWHERE))
    if there.look() - cost <= contest.look():
        return contest
    there.run()
    there.hypotheses += [hypothesis.moved(-there.place, cost) for hypothesis in contest.hypotheses]
    return there


def _of_reflectors(contest: Contest) -> list[complex]:
    """The place where reflectors that were found about the axis stand as a layout's do, if there is one."""
    free = [h for h in contest.hypotheses if type(h.estimate.model) is Model and h.estimate.model.tag]
    free = sorted((h for h in free if h.layout is None), key=lambda h: -h.log_z)[:POSED]
    posed: list[tuple[float, complex]] = []
    for hypothesis in free:
        for _, model, x, _ in as_layouts(hypothesis.estimate, contest.layouts):
            place = model.split(x)[0]
            if NEAR_M <= abs(place) <= REACH_M:
                there = contest.spectra.about(place)
                posed.append((best_powers(there, model, moved(model, x, -place), 1e-2)[1], place))
    return [max(posed, key=itemgetter(0))[1]] if posed else []


def likeliest(spectra: Spectra) -> complex:
    """The place off the axis, x + jy, m, about which clutter and a round body explain most."""
    thinned = spectra.thinned(2)
    x = np.arange(-REACH_M, REACH_M + _STEP_M / 2, _STEP_M)
    centres = (x + 1j * x[:, None]).ravel()
    centres = centres[(np.abs(centres) <= REACH_M) & (np.abs(centres) >= NEAR_M)]
    for step in _STEPS_M:
        best = centres[int(np.argmax(_evidence(thinned, centres)))]
        centres = np.append(best, best + step * _AROUND)
    return complex(centres[int(np.argmax(_evidence(thinned, centres)))])


def _evidence(spectra: Spectra, centres: Complex) -> Floats:
    """(C,) log evidences of clutter about centres (C,), with or without a round body there, nats."""
    shifted = np.exp(1j * spectra.kappa[:, None, None] * _beyond(spectra, centres)) * spectra.data[:, None]
    best = np.full(len(centres), -np.inf)
    for whitener in spectra.whole:
        white = whitener.apply(shifted)
        body = whitener.apply(np.ones((len(shifted), 1, spectra.views), dtype=np.complex128))
        for clutter in CLUTTER[1:]:
            variance = 1 + clutter * (spectra.moving[:, None] * whitener.variance)[:, None]
            log = -(np.abs(white) ** 2 / variance).sum(axis=(0, 2)) - np.log(variance).sum()
            seen = np.abs((body.conj() * white / variance).sum(axis=2)) ** 2
            size = (np.abs(body) ** 2 / variance).sum(axis=2)
            gain = np.zeros(len(centres))
            for power in BODY:
                prior = power * spectra.moving[:, None]
                gain = np.maximum(gain, (seen / (1 / prior + size) - np.log1p(prior * size)).sum(axis=0))
            best = np.maximum(best, log + gain)
    return best


def _beyond(spectra: Spectra, centres: Complex) -> Floats:
    """(C, V) by how much farther from the antenna centres (C,) are than the axis, m."""
    range_m = np.hypot(np.abs(spectra.antenna - centres[:, None]), spectra.height_m)
    return np.asarray(range_m - np.hypot(np.abs(spectra.antenna), spectra.height_m))
