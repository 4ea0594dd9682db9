"""How unevenly an object turned: errors of the stated angles, which all hypotheses of a recording share.

The direction of the antenna in view v differs from the stated one by the sum of t_i e_i(v), t_i of unit
variance: one and two cycles a turn, and of every antenna height the scale of its angles and where its turn
began. A turned antenna is an object that is turned back, so the slopes over t are those of the parameters
that turn the object. A whole even turn has no scale to find, and is left as it is stated: its bodies, which
no hypothesis describes wholly, would be read as uneven. Where a device states the angles and the scans do
not come again, a whole turn is not known to be one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from tagid.reading.columns import Model
from tagid.reading.descent import Estimate, Powers, best_powers, climbed, spread, variance
from tagid.reading.evidence import fit
from tagid.reading.spectra import Spectra
from tagid.types import Floats

CYCLES_RAD = (0.01, 0.005)
"""Standard deviations of the error of the angles of one and of two cycles a turn, cosine and sine, rad."""
SCALE = 0.02
"""Standard deviation of the scale of the angles of a part of a turn where no device states one: a calibrated
robot slips by as much on another floor. Over a whole turn the scans themselves tell the scale."""
BEGUN_RAD = 0.02
"""Standard deviation of the angle between the turns at two antenna heights, rad: from the images of three
points `tagid.pipeline.alignment` finds it to 1.2 degrees with 18 or 24 views, to 0.5 with 36 (rms)."""
PAYS = 3.0
"""Nats that an uneven turn gains at least before everything is looked for again with it."""
MOST = 8
"""Hypotheses by which the angles are tried, each the best of its kind."""
FARTHEST = 3.0
"""No device turns less evenly than this, standard deviations: what looks like it is an object that no
hypothesis describes (a pair on a can with a handle: 5, for 100 nats)."""
_ROUNDS, _AGAIN = 6, 3
"""Steps to the angles that suit a hypothesis, and how often its powers are chosen again on the way."""


def cycles(direction: Floats) -> Floats:
    """(2 K, V) cosine and sine of every cycle of the error of angles (V,), rad."""
    turned = np.arange(1, len(CYCLES_RAD) + 1)[:, None] * direction
    return np.stack([np.cos(turned), np.sin(turned)], axis=1).reshape(-1, turned.shape[1])


def errors(spectra: Spectra) -> Floats:
    """(T, V) errors of the stated angles of one standard deviation, rad."""
    scale = SCALE if spectra.scale_sigma is None else spectra.scale_sigma
    rows = np.repeat(CYCLES_RAD, 2)[:, None] * cycles(spectra.direction)
    turns = spectra.rooms > 0
    scales = np.zeros(turns.shape)
    for views, row in zip(turns, scales, strict=True):
        row[views] = scale * turned_so_far(spectra.direction[views])
    return np.concatenate([rows, scales, BEGUN_RAD * turns[1:]])


def turned_so_far(direction: Floats) -> Floats:
    """(V,) angles since the start of a recording, or since its widest gap, less their mean, rad.

    Args:
        direction: (V,) of the antenna, in the order of recording, rad.
    """
    steps = np.angle(np.exp(1j * np.diff(direction)))
    way = 1.0 if steps.sum() > 0 else -1.0
    turned = np.mod(way * (direction - direction[0]) + 1e-9, 2 * np.pi)
    ordered = np.sort(turned)
    gaps = np.diff(np.append(ordered, 2 * np.pi))
    # A whole turn begins with its first view, a part of one after its gap.
    gaps[-1] += np.median(gaps)
    since = np.mod(turned - ordered[(int(gaps.argmax()) + 1) % len(ordered)] + 1e-9, 2 * np.pi)
    return np.asarray(way * (since - since.mean()))


def spin(model: Model, x: Floats) -> Floats:
    """(P,) how the parameters change as the whole object turns about the axis, per rad."""
    out, tag, about = np.zeros(len(x)), model.tag, model.about
    for at in {about.start, *model.place_rows}:
        out[at], out[at + 1] = -x[at + 1], x[at]
    if model.body_parameters:
        out[2] = 1.0
    if model.shapes:
        out[2], out[3] = -2 * x[3], 2 * x[2]
    if tag is not None:
        out[model.head : model.head + tag.turns] = 1.0
    return out


@dataclass(frozen=True, eq=False)
class Turned:
    """A recording with its antennas where they truly stood.

    Attributes:
        log_z: log evidence of the hypothesis by which they were found, nats.
        cost: what the errors of the angles cost in it: all hypotheses at these angles cost as much.
        errors: (T,) of the stated angles, standard deviations.
    """

    spectra: Spectra
    log_z: float
    cost: float
    errors: Floats


def fitted(
    spectra: Spectra, estimate: Estimate, least: float = -np.inf, start: Floats | None = None
) -> Turned | None:
    """The angles that suit a hypothesis; None where its log evidence will hardly reach the least, nats.

    Args:
        spectra: with the angles as stated.
        estimate: the hypothesis, at the angles whose errors are `start`: (T,), None for the stated ones.
    """
    model, powers, rows = estimate.model, estimate.powers, errors(spectra)
    size = len(estimate.x)
    z = np.append(estimate.x, np.zeros(len(rows)) if start is None else start)
    precision = np.append(model.precision, np.ones(len(rows)))
    given = least - estimate.log_z + estimate.log
    for _ in range(_AGAIN):
        z, here = climbed(_expanded(spectra, model, powers), precision, z, _ROUNDS, given)
        # Wrong angles look like clutter.
        again, _ = best_powers(spectra.turned(z[size:] @ rows), model, z[:size])
        if again == powers:
            break
        powers = again
    t, (curved, volume) = z[size:], spread(here.hessian, precision)
    log_z = here.log + 0.5 * size * np.log(2 * np.pi) - 0.5 * volume
    if log_z < least or np.abs(t).max() > FARTHEST:
        return None
    cost = 0.5 * float(t @ t + volume - np.linalg.slogdet(curved[:size, :size])[1])
    return Turned(spectra.turned(t @ rows), float(log_z), cost, t)


def _expanded(
    spectra: Spectra, model: Model, powers: Powers
) -> Callable[[Floats], tuple[float, Floats, Floats]]:
    """Log density of parameters and errors of the angles, its gradient and its curvature."""
    rows, whitener, white = errors(spectra), spectra.whiteners[model.disc], spectra.white[model.disc]
    lam = variance(spectra, model, powers.clutter)
    power = model.power(spectra.moving, *powers.amplitudes)
    size = model.parameters

    def expanded(z: Floats) -> tuple[float, Floats, Floats]:
        x, t = z[:size], z[size:]
        columns = model.at(spectra.turned(t @ rows), x)
        fit_here = fit(whitener.apply(columns.values), white, lam, power)
        back = columns.slopes(whitener.adjoint(fit_here.adjoint).conj())
        moved = columns.slopes(fit_here.amplitudes[..., None])
        turned = -spin(model, x)
        back = np.concatenate([back, np.tensordot(turned, back, 1) * rows[:, None]])
        moved = np.concatenate([moved, np.tensordot(turned, moved, 1) * rows[:, None]])
        hessian = fit_here.curvature(whitener.apply(np.swapaxes(moved, 0, 1)) / np.sqrt(lam)[:, None])
        log, slope, pull = model.log_prior(x, slopes=True)
        hessian[:size, :size] += pull
        hessian[size:, size:] += np.eye(len(t))
        gradient = 2 * back.sum(axis=(1, 2)).real + np.append(slope, -t)
        return fit_here.log + log - 0.5 * float(t @ t), gradient, hessian

    return expanded


def straightened(
    spectra: Spectra, every: Sequence[Estimate], best: float, start: Floats | None = None
) -> Turned | None:
    """The recording at the angles that hypotheses show; None for a whole turn, and where those do as well.

    Args:
        spectra: with the angles as stated.
        every: hypotheses at the angles whose errors are `start`: (T,), None for the stated ones.
        best: log evidence of the likeliest one, nats.
    """
    if spectra.full_turn:
        return None
    kinds: dict[tuple[bool, int, int], Estimate] = {}
    for estimate in sorted(every, key=lambda estimate: -estimate.log_z):
        tag = estimate.model.tag
        moves = (0, 0) if tag is None else (tag.turns, tag.count)
        kinds.setdefault((estimate.model.odd > 0, *moves), estimate)
    turned = [fitted(spectra, kind, best + PAYS, start) for kind in list(kinds.values())[:MOST]]
    return max(filter(None, turned), key=attrgetter("log_z"), default=None)
