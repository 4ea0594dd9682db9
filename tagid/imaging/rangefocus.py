"""The path delay of scans taken from free antenna positions, estimated from the echoes, with a test of the
estimate.

A radar on a rail measures every range with the same unknown delay of cables and electronics; a metre of it
defocuses the image and moves all that is in it. The curvature of the echoes over the path tells it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.imaging.backprojection import upsample_at_carrier
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.pathside import STRAIGHT_WAVELENGTHS, sides_to_search
from tagid.imaging.pointmodel import needed_evidence
from tagid.imaging.preprocess import thinned
from tagid.imaging.types import BasebandScans
from tagid.signal import fitted_peak
from tagid.types import Floats

SEARCH_WAVELENGTHS = 13.18
"""Half width of the search where none is given: 1 m for a P440, a few metres of cable."""
MAX_SEARCH_WAVELENGTHS = 2.001 * SEARCH_WAVELENGTHS

LEAST_CONTRAST = 2.5
"""Power of an echo at its best delay over the median of the search; an echo with less comes into focus
nowhere. Of noise alone, the largest of some 10^5 trials is 1.9 times the median of the largest of 350."""
_LEAST_EXPECTED_RATIO = 1.02
"""Power in focus on the true side of a path over that on the other, as its bend lets expect it, from which on
the two are compared: less is lost by a tracker's errors."""
LEAST_GHOST_RATIO = 1.05
"""Measure of the best delay over that of a rival which is the mirror image on the other side of the path. The
geometry alone makes the difference, and all pieces have it alike."""
MOST_SIGMA_WAVELENGTHS = 1 / 8
"""Largest jackknife error of a delay that is taken."""
MOST_ECHO_SIGMA_WAVELENGTHS = 1 / 4
"""The same of the jackknife over the echoes, of which two alone agree by chance to no better than that."""
LEAST_SECOND = 0.25
"""Power of the second echo over that of the first, below which one round body may be all that is seen."""
_MOST_RADIUS_WAVELENGTHS = 4
"""Largest radius of such a body: 0.3 m for a P440."""
PIECES = 10
"""Pieces of the path that are asked whether they agree."""
_LOBE = 0.5
_LEAST_AGREEING = 1.5

_VIEWS = 200
_POINTS = 6
_POINT_FLOOR = 0.1
"""Echoes weaker than this part of the strongest are left out of the search. What is left of the leakage is
often the strongest, and comes into focus at no delay."""
_SHOWN_FLOOR = 0.25
"""Focused echoes weaker than this part of the strongest are left out of the result: what is left of a mirror
image has up to a fifth."""
_COARSE, _FINE, _FINEST = 0.2635, 0.0527, 0.0132
"""Steps in range of the places that an echo may have, for the search, near its end and at its end, in
wavelengths (20, 4 and 1 mm for a P440). A delay can in part be taken for a change of range, so that places
too far apart would draw the delay to them; the jackknife triples what they add to its spread."""
_FINEST_REACH = 0.25
"""Part of the places about an echo that the finest steps try, about the place found before."""
_MIRROR_FLOOR = 0.9
"""An echo weaker than this part of the one at its mirror place is its image, not another reflector."""
_SPOT_WAVELENGTHS = 1.976
"""Echoes nearer in range than this (15 cm for a P440, one and a half range resolutions) are one."""
_ALONG_WAVELENGTHS = 0.79
"""Half width of the places tried along an echo's bearing: the range envelope."""
_NEAREST_WAVELENGTHS = 2.635
"""Nearer than this (0.2 m for a P440) there is only leakage."""


@dataclass(frozen=True)
class EchoPoint:
    """A strong echo: where it lies once the delay is known, and how strong it is.

    Attributes:
        x_m, y_m: place in the plane z = 0, m.
        amplitude: of the image there.
    """

    x_m: float
    y_m: float
    amplitude: float


@dataclass(frozen=True)
class DelayFocus:
    """What the search for the path delay found.

    Attributes:
        delay_m: one-way metres that were subtracted from the scans' ranges; 0 if nothing was.
        contrast: focus measure at the best delay over its median in the search.
        reliable: the best lies inside the search and the pieces of the path agree on it; only then is it
            taken.
        points: the strong echoes, strongest first, at the delay taken.
        best_m: the best guess, m, taken or not; None if there was no search.
        evidence: how far the focus measure of the best delay is above that of the best rival outside its
            lobe, in jackknife standard errors over pieces of the path; `needed_evidence(PIECES)` is needed.
        reason: why it was not taken; empty if it was.
        sigma_m: standard error by the jackknife over pieces of the path and over the echoes, m; nan where not
            known.
        alike: whether both sides of the path explain the scans alike; None where one alone was searched.
    """

    delay_m: float
    contrast: float
    reliable: bool
    points: tuple[EchoPoint, ...] = ()
    best_m: float | None = None
    evidence: float = 0.0
    reason: str = ""
    sigma_m: float = float("nan")
    alike: bool | None = None

    @property
    def needed(self) -> float:
        return needed_evidence(PIECES)

    def facts(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {
            "taken": self.reliable,
            "used_m": self.delay_m,
            "best_guess_m": self.best_m,
            "evidence": self.evidence,
            "sigma_m": self.sigma_m if np.isfinite(self.sigma_m) else None,
            "evidence_needed": self.needed,
            "contrast": self.contrast,
            "reason": self.reason,
            "sides_alike": self.alike,
        }


def search_range_m(wavelength_m: float) -> float:
    return SEARCH_WAVELENGTHS * wavelength_m


def focus_delay(
    scans: BasebandScans,
    search_m: float | None = None,
    towards: tuple[float, float] = (0.0, 0.0),
    *,
    compare: bool = False,
) -> tuple[BasebandScans, DelayFocus]:
    """The same scans with the path delay subtracted from their ranges, or unchanged where they do not tell
    it.

    A short piece of the path about its middle tells range and bearing of the strongest echoes whatever the
    delay is. Moved along its bearing by a trial delay, each echo is focused with the whole path at the place
    near it where |f|^2 is largest, f = 1/V sum_v z_v(d_v + delay) exp(2jk d_v). The delay is searched in
    steps that the path's angles ask for, then twice by a parabola, with finer places each time.

    Only echoes that come into focus count (`LEAST_CONTRAST`). The best delay is taken only if it lies inside
    the search, stands above every rival (`needed_evidence`) and stays where it is when pieces of the path, or
    echoes, are left out (`MOST_SIGMA_WAVELENGTHS`): a path that bends sideways gives an echo above or below
    the plane another delay than one in it.

    A path that bends a little is searched on both of its sides, each with a delay of its own, and the side
    with more power in focus counts where it has as much more as the bend lets expect.

    Args:
        scans: baseband scans of free antenna positions that hold the object at every delay of the search.
        search_m: half width of the search, one-way m; None: `search_range_m`.
        towards: a point (x, y) on the side of a nearly straight path that matters, m; the other side mirrors
            it.
        compare: also search the other side, where the path bends; `towards` counts where they are alike.

    Returns:
        The scans, their ranges corrected where the result is reliable, and what was found.

    Raises:
        UsageError: search_m is not between 0 and `MAX_SEARCH_WAVELENGTHS`.
    """
    lam = scans.wavelength_m
    search_m = search_range_m(lam) if search_m is None else search_m
    if not 0 < search_m <= MAX_SEARCH_WAVELENGTHS * lam:
        most = MAX_SEARCH_WAVELENGTHS * lam
        raise UsageError(f"the delay search is +-{search_m} m", f"Give up to {most:.3g} m.")
    few = thinned(scans, _VIEWS)
    sides = sides_to_search(scans.aperture.positions, lam, towards, compare)
    searched = [_search(scans, few, side, search_m) for side in sides]
    focus = searched[0].focus
    if len(searched) > 1:
        bright, dim = sorted(searched, key=lambda side: -side.power)
        if _told_apart(few, bright, dim, search_m):
            focus = replace(_with_all_around(scans, few, bright.focus), alike=False)
        else:
            focus = _of_either_side(few, searched[0], searched[1])
    if not focus.reliable:
        return scans, focus
    return replace(scans, range_start_m=scans.range_start_m - focus.delay_m), focus


@dataclass(frozen=True, eq=False)
class _Searched:
    """The search of one side of a path.

    Attributes:
        focus: its result.
        side: unit normal (2,) towards it; None for all directions.
        reference, echoes: of `_strong_echoes`.
        power: of all its echoes in focus, at the best delay.
        points: where they are then.
    """

    focus: DelayFocus
    side: Floats | None
    reference: Floats
    echoes: Floats
    power: float = 0.0
    points: tuple[EchoPoint, ...] = ()


def _told_apart(few: BasebandScans, bright: _Searched, dim: _Searched, search_m: float) -> bool:
    """Whether the brighter side of a path is brighter by as much as its bend lets expect.

    Noiseless scans of the points of the brighter side are searched on both.
    """
    if not bright.points or not dim.points:
        return bool(bright.points)
    positions = np.array([[p.x_m, p.y_m] for p in bright.points])
    strengths = np.array([p.amplitude for p in bright.points])
    simulated = replace(few, samples=ForwardOperator(few, positions).forward(strengths))
    power, other = (
        _search(simulated, simulated, searched.side, search_m).power for searched in (bright, dim)
    )
    expected = power / max(other, 1e-30)
    # Were the points on the other side, the ratio would be the inverse: it must be nearer to this than to 1.
    return bool(expected >= _LEAST_EXPECTED_RATIO and bright.power >= np.sqrt(expected) * dim.power)


def _with_all_around(scans: BasebandScans, few: BasebandScans, focus: DelayFocus) -> DelayFocus:
    """The result with the echoes of both sides, of which only those in focus at its delay are real."""
    if not focus.reliable:
        return focus
    return replace(focus, points=_in_focus(few, *_strong_echoes(scans, None), focus.delay_m))


def _of_either_side(few: BasebandScans, first: _Searched, second: _Searched) -> DelayFocus:
    """The first side's result where the scans do not tell the sides apart: a delay counts if both have it."""
    focus, other = replace(first.focus, alike=True), second.focus
    apart = abs((focus.best_m or 0.0) - (other.best_m or 0.0))
    if not focus.reliable or apart <= MOST_SIGMA_WAVELENGTHS * few.wavelength_m:
        return focus
    reason = "both sides of the path explain the scans alike, each with another delay"
    focus = replace(focus, delay_m=0.0, reliable=False, reason=reason)
    return _not_taken(few, first.reference, first.echoes, focus)


def _search(scans: BasebandScans, few: BasebandScans, side: Floats | None, search_m: float) -> _Searched:
    """The search for the delay on one side of the path, or all about it; `few` are the scans thinned."""
    lam = few.wavelength_m
    reference, echoes = _strong_echoes(scans, side)
    if not len(echoes):
        return _Searched(DelayFocus(0.0, 1.0, False, reason="there is no echo"), side, reference, echoes)
    step = _delay_step(few, reference, echoes)
    delays = np.linspace(-search_m, search_m, 2 * int(np.ceil(search_m / step)) + 1)
    tried = _measure(few, reference, echoes, delays, _COARSE * lam)
    counted = tried.responding()
    measure = tried.power @ (counted if counted.any() else np.ones(len(echoes)))
    best = int(np.argmax(measure))
    contrast = float(measure[best] / max(float(np.median(measure)), 1e-30))
    width = float(delays[1] - delays[0])
    around = width * np.linspace(-1, 1, 5)
    guess = float(delays[best])

    def searched(
        best_m: float, evidence: float, reason: str, sigma: float, shown: tuple[EchoPoint, ...] = ()
    ) -> _Searched:
        taken = 0.0 if reason else best_m
        focus = DelayFocus(taken, contrast, not reason, shown, best_m, evidence, reason, sigma)
        focus = _not_taken(few, reference, echoes, focus) if reason else focus
        power = _measure(few, reference, echoes, best_m + around, _FINE * lam).power.sum(axis=1).max()
        points = _measure(few, reference, echoes, np.array([best_m]), _FINE * lam).points
        return _Searched(focus, side, reference, echoes, float(power), points)

    if not counted.any():
        return searched(guess, 0.0, "no echo comes into focus at one delay more than at others", float("nan"))
    focused = echoes[counted > 0]
    # Between the steps a peak may be higher than at any of them: both are compared at their tops.
    top, evidence, ghost = _measure(few, reference, focused, guess + around, _FINE * lam), np.inf, False
    rival = _rival(measure, best)
    if rival is not None:
        other = _measure(few, reference, focused, float(delays[rival]) + around, _FINE * lam)
        if other.power.sum(axis=1).max() > top.power.sum(axis=1).max():
            top, other, guess = other, top, float(delays[rival])
        better = top.without().max(axis=1) - other.without().max(axis=1)
        evidence = float(better.mean() / max(_spread(better), 1e-30))
        ratio = top.power.sum(axis=1).max() / other.power.sum(axis=1).max()
        ghost = bool((top.sides() != other.sides()).any()) and ratio >= LEAST_GHOST_RATIO
    reason = ""
    if not abs(guess) < search_m * 0.999:
        reason = "the best delay is at the edge of the search"
    elif not (evidence >= needed_evidence(PIECES) or ghost):
        reason = "the pieces of the path do not agree on one delay"
    delay, pieces, over_echoes = guess, float("nan"), 0.0
    # The peak is flat: the parabola needs the whole lobe, also where the places are finest.
    for steps, reach in () if reason else ((_FINE, 1.0), (_FINEST, _FINEST_REACH)):
        trials = delay + width * np.linspace(-1, 1, 13)
        fine = _measure(few, reference, focused, trials, steps * lam, reach)
        pieces = _spread(np.array([_peak(trials, measure) for measure in fine.without()]))
        over_echoes = _spread(np.array([_peak(trials, measure) for measure in fine.without_an_echo()]))
        delay = _peak(trials, fine.power.sum(axis=1))
        kept = _measure(few, reference, focused, np.array([delay]), steps * lam, reach).points
        real = _real(kept, few.aperture.positions, focused, lam)
        focused = _centred_on(kept, reference, delay, focused)[real]
    if not reason and not pieces <= MOST_SIGMA_WAVELENGTHS * lam:
        reason = "the pieces of the path give different delays"
    elif not reason and not over_echoes <= MOST_ECHO_SIGMA_WAVELENGTHS * lam:
        reason = "the echoes give different delays"
    elif not reason and _passes_for_round(delay, fine.power[int(np.argmin(np.abs(trials - delay)))], lam):
        reason = "one echo dominates, which a round body at the given ranges would explain as well"
    sigma = float(np.hypot(pieces, over_echoes))
    if reason:
        return searched(delay, evidence, reason, sigma)
    shown = echoes[tried.agreeing(int(np.argmin(np.abs(delays - guess))))]
    return searched(delay, evidence, "", sigma, _in_focus(few, reference, shown, delay))


def _passes_for_round(delay: float, powers: Floats, lam: float) -> bool:
    """Whether echoes (n,) with a delay may be that of one convex body, nearer than its axis by its radius."""
    first, second = np.sort(np.append(powers, [0.0, 0.0]))[:-3:-1]
    return bool(-_MOST_RADIUS_WAVELENGTHS * lam <= delay < 0 and second < LEAST_SECOND * first)


def _rival(measure: Floats, best: int) -> int | None:
    """The best delay outside the lobe about the best one; None if there is no other.

    The lobe reaches down to its feet: its flank below half power is no rival of its top.
    """
    lobe = measure >= _LOBE * measure[best]
    first, last = best, best
    while first > 0 and (lobe[first - 1] or measure[first - 1] < measure[first]):
        first -= 1
    while last < len(measure) - 1 and (lobe[last + 1] or measure[last + 1] < measure[last]):
        last += 1
    outside = measure.copy()
    outside[first : last + 1] = -np.inf
    rival = int(np.argmax(outside))
    return rival if np.isfinite(outside[rival]) else None


def _not_taken(few: BasebandScans, reference: Floats, echoes: Floats, focus: DelayFocus) -> DelayFocus:
    """The result with the places of the echoes at the ranges as given."""
    points = _measure(few, reference, echoes, np.zeros(1), _COARSE * few.wavelength_m).points
    return replace(focus, points=_strongest_first(points))


def find_echoes(scans: BasebandScans, towards: tuple[float, float] = (0.0, 0.0)) -> tuple[EchoPoint, ...]:
    """Places of the strong echoes at the ranges as given, strongest first; arguments of `focus_delay`."""
    (side,) = sides_to_search(scans.aperture.positions, scans.wavelength_m, towards, compare=False)
    reference, echoes = _strong_echoes(scans, side)
    return _in_focus(thinned(scans, _VIEWS), reference, echoes, 0.0) if len(echoes) else ()


def _in_focus(few: BasebandScans, reference: Floats, echoes: Floats, delay: float) -> tuple[EchoPoint, ...]:
    """Places of the echoes with a delay, strongest first, without mirror images of stronger ones."""
    lam = few.wavelength_m
    points = _measure(few, reference, echoes, np.array([delay]), _FINE * lam).points
    real = _real(points, few.aperture.positions, echoes, lam)
    return _strongest_first(tuple(points[i] for i in real))


def _strongest_first(points: tuple[EchoPoint, ...]) -> tuple[EchoPoint, ...]:
    top = max((p.amplitude for p in points), default=0.0)
    kept = [p for p in points if p.amplitude >= _SHOWN_FLOOR * top]
    return tuple(sorted(kept, key=lambda p: -p.amplitude))


def _strong_echoes(scans: BasebandScans, side: Floats | None) -> tuple[Floats, Floats]:
    """Middle of the piece (3,), and the strongest echoes (n, 3) as labelled range, bearing and |f|, on one
    side of the path (its unit normal) or all about it.

    The piece is so short, sqrt(lambda R) of path, that curvature does not tell there.
    """
    positions = scans.aperture.positions
    middle = len(positions) // 2
    reach = float(np.median(scans.ranges_m))
    lam = scans.wavelength_m
    limit = np.sqrt(np.pi / scans.wavenumber * 2 * max(reach, _NEAREST_WAVELENGTHS / 2 * lam)) / 2
    piece = np.flatnonzero(np.linalg.norm(positions - positions[middle], axis=1) <= limit)
    centre = positions[piece].mean(axis=0)
    length = max(float(np.ptp(positions[piece], axis=0).max()), STRAIGHT_WAVELENGTHS / 2 * lam)
    bearings = np.arange(0, 2 * np.pi, np.clip(np.pi / scans.wavenumber / (4 * length), 0.01, 0.1))
    if side is not None:
        bearings = bearings[np.cos(bearings) * side[0] + np.sin(bearings) * side[1] > 0.1]
    fine, start, step = upsample_at_carrier(scans, piece)
    ranges = np.arange(
        max(scans.ranges_m[0], _NEAREST_WAVELENGTHS * lam), scans.ranges_m[-1], scans.range_step_m / 2
    )
    x = centre[0] + np.outer(ranges, np.cos(bearings))
    y = centre[1] + np.outer(ranges, np.sin(bearings))
    image = np.zeros(x.shape, dtype=np.complex64)
    seen = zip(*(a[piece] for a in scans.aperture.antennas), strict=True)
    for row, antennas in zip(fine, seen, strict=True):
        distance = _ranges(x, y, antennas)
        image += row[np.clip(np.rint((distance - start) / step), 0, len(row) - 1).astype(np.intp)]
    magnitude = np.abs(image) / len(piece)
    return centre, _peaks(magnitude, ranges, bearings, _SPOT_WAVELENGTHS * lam)


def _peaks(magnitude: NDArray[np.floating], ranges: Floats, bearings: Floats, apart_m: float) -> Floats:
    """The strongest cells (n, 3) of (range, bearing), none within that range and 0.15 rad of a stronger
    one."""
    remaining = magnitude.astype(np.float64)
    top = float(remaining.max(initial=0.0))
    spots: list[tuple[float, float, float]] = []
    while len(spots) < _POINTS:
        i, j = np.unravel_index(int(np.argmax(remaining)), remaining.shape)
        if remaining[i, j] <= _POINT_FLOOR * top or top == 0:
            break
        spots.append((float(ranges[i]), float(bearings[j]), float(remaining[i, j])))
        turn = np.abs((bearings - bearings[j] + np.pi) % (2 * np.pi) - np.pi)
        remaining[np.ix_(np.abs(ranges - ranges[i]) < apart_m, turn < 0.15)] = 0
    return np.array(spots, dtype=np.float64).reshape(-1, 3)


def _delay_step(scans: BasebandScans, reference: Floats, echoes: Floats) -> float:
    """Step in delay that turns no view's phase by more than a quarter turn against the middle of the path."""
    lam = scans.wavelength_m
    place = reference[:2] + echoes[:1, 0, None] * np.stack([np.cos(echoes[:1, 1]), np.sin(echoes[:1, 1])], 1)
    sight = np.append(place[0], 0.0) - scans.aperture.positions
    sight /= np.maximum(np.linalg.norm(sight, axis=1, keepdims=True), 1e-9)
    ahead = np.append(place[0], 0.0) - reference
    spread = float((1 - sight @ (ahead / np.linalg.norm(ahead))).max())
    return float(np.clip(np.pi / 4 / (scans.wavenumber * max(spread, 1e-6)), 0.0527 * lam, 0.395 * lam))


@dataclass(frozen=True, eq=False)
class _Measure:
    """How well the echoes come into focus.

    Attributes:
        power: (delays, echoes) |f|^2 at the best place.
        sums: (pieces, delays, echoes, places) sum over the views of a piece of the path.
        points: the places at the last delay.
        pairs: echoes that mirror each other.
    """

    power: Floats
    sums: NDArray[np.complex64]
    points: tuple[EchoPoint, ...]
    pairs: list[tuple[int, int]]

    def responding(self) -> Floats:
        """(echoes,) 1 where the echo comes into focus somewhere in the search, 0 if no delay makes a
        difference."""
        middle = np.maximum(np.median(self.power, axis=0), 1e-30)
        responds = self.power.max(axis=0) / middle >= LEAST_CONTRAST
        for i, j in self.pairs:
            responds[j] = responds[i]
        return np.asarray(responds, dtype=np.float64)

    def agreeing(self, best: int) -> NDArray[np.bool_]:
        """(echoes,) True if the echo comes into focus at this delay, if less clearly than those that
        count."""
        middle = np.maximum(np.median(self.power, axis=0), 1e-30)
        top = self.power.max(axis=0)
        agrees = (top >= _LEAST_AGREEING * middle) & (self.power[best] >= _LOBE * top)
        for i, j in self.pairs:
            agrees[j] = agrees[i]
        return np.asarray(agrees | (self.responding() > 0), dtype=bool)

    def sides(self) -> NDArray[np.bool_]:
        """(pairs,) whether the first of two that mirror each other is the brighter at the best delay."""
        raw = (np.abs(self.sums.sum(axis=0)) ** 2).max(axis=2)[int(np.argmax(self.power.sum(axis=1)))]
        return np.array([raw[i] >= raw[j] for i, j in self.pairs], dtype=bool)

    def without(self) -> Floats:
        """(pieces, delays) sum over the echoes of |f|^2 at the best place, one piece of the path left out."""
        total = self.sums.sum(axis=0)
        without_part = np.array([(np.abs(total - s) ** 2).max(axis=2) for s in self.sums], dtype=np.float64)
        return np.asarray(_brighter(without_part, self.pairs).sum(axis=2), dtype=np.float64)

    def without_an_echo(self) -> Floats:
        """(echoes, delays) power without each echo that counts; its own where there is one only."""
        counted = self.power[:, self.power.any(axis=0)]
        if counted.shape[1] < 2:
            return counted.T
        return np.asarray((counted.sum(axis=1, keepdims=True) - counted).T)


def _spread(values: Floats) -> float:
    """Jackknife standard error of a figure from its values with one piece left out."""
    count = len(values)
    return float(np.sqrt((count - 1) / count * ((values - values.mean()) ** 2).sum()))


def _centred_on(points: tuple[EchoPoint, ...], reference: Floats, delay: float, echoes: Floats) -> Floats:
    """The echoes (n, 3) with the range and bearing at which they were focused with that delay."""
    off = np.array([[p.x_m, p.y_m] for p in points]).reshape(-1, 2) - reference[:2]
    bearing = np.arctan2(off[:, 1], off[:, 0])
    return np.stack([np.linalg.norm(off, axis=1) + delay, bearing, echoes[:, 2]], axis=1)


def _measure(
    scans: BasebandScans,
    reference: Floats,
    echoes: Floats,
    delays: Floats,
    step_m: float,
    part: float = 1.0,
) -> _Measure:
    """Focus of the echoes at the delays; places of an echo are tried `step_m` apart along its bearing.

    `part` of the places that the short piece of the path leaves open are tried.
    """
    lam = scans.wavelength_m
    spread = np.ptp(scans.aperture.positions, axis=0).max()
    # As fine as the whole path resolves, as wide as the short piece leaves open.
    d_bearing = np.clip(np.pi / scans.wavenumber / (4 * max(spread, 0.66 * lam)), 2e-3, 0.05)
    d_bearing *= min(1.0, 2 * step_m / (_COARSE * lam))
    widest = 0.05 * part
    bearing = np.arange(-widest, widest + d_bearing / 2, d_bearing)
    reach = _ALONG_WAVELENGTHS * lam * part
    along = np.arange(-reach, reach + step_m / 2, step_m)
    fine, start, step = upsample_at_carrier(scans, slice(None))
    radius = echoes[None, :, None, None, 0] - delays[:, None, None, None] + along[None, None, :, None]
    angle = echoes[None, :, None, None, 1] + bearing[None, None, None, :]
    radius = np.maximum(radius, 0.66 * lam)
    x = (reference[0] + radius * np.cos(angle)).astype(np.float32)
    y = (reference[1] + radius * np.sin(angle)).astype(np.float32)
    views = len(fine)
    pieces = min(PIECES, views)
    sums = np.zeros((pieces, *x.shape), dtype=np.complex64)
    shift = ((delays[:, None, None, None] - start) / step).astype(np.float32)
    single = zip(*(a.astype(np.float32) for a in scans.aperture.antennas), strict=True)
    for v, (row, antennas) in enumerate(zip(fine, single, strict=True)):
        distance = _ranges(x, y, antennas)
        label = distance / np.float32(step) + shift
        sums[v * pieces // views] += row[np.clip(np.rint(label), 0, len(row) - 1).astype(np.int32)]
    shape = (len(delays), len(echoes), -1)
    power = (np.abs(sums.sum(axis=0) / views) ** 2).reshape(shape)
    strongest = power.argmax(axis=2)
    points = tuple(
        EchoPoint(float(x[-1, i].ravel()[k]), float(y[-1, i].ravel()[k]), float(np.sqrt(power[-1, i, k])))
        for i, k in enumerate(strongest[-1])
    )
    best = np.take_along_axis(power, strongest[..., None], axis=2)[..., 0].astype(np.float64)
    pairs = _mirrors(scans.aperture.positions, echoes, lam)
    return _Measure(_brighter(best, pairs), sums.reshape(pieces, *shape), points, pairs)


def _ranges(
    x: NDArray[np.floating], y: NDArray[np.floating], antennas: tuple[NDArray[np.floating], ...]
) -> NDArray[np.floating]:
    """One-way range of points of the plane from one antenna (3,), or half the way by two of them."""
    ways = [np.sqrt((x - a[0]) ** 2 + (y - a[1]) ** 2 + a[2] ** 2) for a in antennas]
    return np.asarray(ways[0] if len(ways) == 1 else (ways[0] + ways[1]) / 2)


def _brighter(power: Floats, pairs: list[tuple[int, int]]) -> Floats:
    """Power (..., echoes) in which of two that mirror each other only the brighter counts: one is the image
    of the other and comes into focus at another delay."""
    out = power.copy()
    for i, j in pairs:
        out[..., i], out[..., j] = np.maximum(out[..., i], out[..., j]), 0
    return out


def _real(points: tuple[EchoPoint, ...], positions: Floats, echoes: Floats, lam: float) -> list[int]:
    """Which of the focused echoes are no mirror image of a stronger one."""
    kept = set(range(len(points)))
    for i, j in _mirrors(positions, echoes, lam):
        strong, weak = (i, j) if points[i].amplitude >= points[j].amplitude else (j, i)
        if points[weak].amplitude < _MIRROR_FLOOR * points[strong].amplitude:
            kept.discard(weak)
    return sorted(kept)


def _mirrors(positions: Floats, echoes: Floats, lam: float) -> list[tuple[int, int]]:
    """Pairs of echoes of one range whose bearings mirror each other about the path near its middle."""
    middle = len(positions) // 2
    near = positions[max(0, middle - len(positions) // 10) : middle + len(positions) // 10 + 1, :2]
    along = near[-1] - near[0]
    path = np.arctan2(along[1], along[0])
    pairs = []
    for i in range(len(echoes)):
        for j in range(i + 1, len(echoes)):
            off = (echoes[i, 1] + echoes[j, 1] - 2 * path + np.pi) % (2 * np.pi) - np.pi
            if abs(off) < 0.2 and abs(echoes[i, 0] - echoes[j, 0]) < _SPOT_WAVELENGTHS * lam:
                pairs.append((i, j))
    return pairs


def _peak(at: Floats, values: Floats) -> float:
    return fitted_peak(at, values, int(np.argmax(values)), 3)
