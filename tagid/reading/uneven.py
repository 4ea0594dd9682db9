"""How unevenly an object turned: errors of the stated angles, which all hypotheses of a recording share.

The direction of the antenna in view v differs from the stated one by the sum of t_i e_i(v), t_i of unit
variance: one and two cycles a turn, and, on a part of a turn, the scale of its angles. A turned antenna is an
object that is turned back, so the slopes over t are those of the parameters that turn the object.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tagid.reading.columns import Model
from tagid.reading.descent import Found, variance
from tagid.reading.evidence import fit
from tagid.reading.spectra import Floats, Spectra

CYCLES_RAD = (0.01, 0.005)
"""Standard deviations of the error of the angles of one and of two cycles a turn, cosine and sine, rad."""
SCALE = 0.02
"""Standard deviation of the scale of the angles of a part of a turn: a calibrated robot slips by as much on
another floor; over a whole turn the scans themselves tell the scale."""
PAYS = 3.0
"""Nats that an uneven turn gains at least before everything is looked for again with it."""
_ROUNDS, _ENOUGH = 6, 0.1


def cycles(direction: Floats) -> Floats:
    """(2 K, V) cosine and sine of every cycle of the error of angles (V,), rad."""
    turned = np.arange(1, len(CYCLES_RAD) + 1)[:, None] * direction
    return np.stack([np.cos(turned), np.sin(turned)], axis=1).reshape(-1, turned.shape[1])


def errors(spectra: Spectra) -> Floats:
    """(T, V) errors of the stated angles of one standard deviation, rad."""
    rows = np.repeat(CYCLES_RAD, 2)[:, None] * cycles(spectra.direction)
    if spectra.full_turn:
        return np.asarray(rows)
    turn = np.sort(spectra.direction)
    gaps = np.diff(np.append(turn, turn[0] + 2 * np.pi))
    first = turn[(int(gaps.argmax()) + 1) % len(turn)]
    since = np.mod(spectra.direction - first + 1e-9, 2 * np.pi)
    return np.concatenate([rows, SCALE * (since - since.mean())[None]])


def spin(model: Model, x: Floats) -> Floats:
    """(P,) how the parameters change as the whole object turns about the axis, per rad."""
    out, tag, about = np.zeros(len(x)), model.tag, model.about
    places = {0, about.start, *range(len(x) - model.spot * model.odd, len(x), model.spot)}
    for at in places:
        out[at], out[at + 1] = -x[at + 1], x[at]
    if model.body_parameters:
        out[2] = 1.0
    if model.shapes:
        out[2], out[3] = -2 * x[3], 2 * x[2]
    if tag is not None:
        out[model.head : model.head + tag.turns] = 1.0
    return out


def fitted(spectra: Spectra, found: Found) -> tuple[Floats, float]:
    """The errors t (T,) of the angles that suit a hypothesis, and its log evidence with them, nats."""
    stated, model, powers = spectra.stated or spectra, found.model, found.powers
    rows, whitener, white = errors(stated), spectra.whiteners[model.disc], spectra.white[model.disc]
    lam = variance(spectra, model, powers.clutter)
    power = model.power(spectra.moving, powers.body, powers.tag, powers.oval)

    def expanded(z: Floats) -> tuple[float, Floats, Floats]:
        x, t = z[: len(found.x)], z[len(found.x) :]
        columns = model.at(stated.turned(t @ rows), x)
        one = fit(whitener.apply(columns.values), white, lam, power)
        back = columns.slopes(whitener.adjoint(one.adjoint).conj())
        moved = columns.slopes(one.amplitudes[..., None])
        turned = -spin(model, x)
        back = np.concatenate([back, np.tensordot(turned, back, 1) * rows[:, None]])
        moved = np.concatenate([moved, np.tensordot(turned, moved, 1) * rows[:, None]])
        hessian = one.curvature(whitener.apply(np.swapaxes(moved, 0, 1)) / np.sqrt(lam)[:, None])
        log, slope, pull = model.log_prior(x, slopes=True)
        hessian[: len(x), : len(x)] += pull
        hessian[len(x) :, len(x) :] += np.eye(len(t))
        gradient = 2 * back.sum(axis=(1, 2)).real + np.append(slope, -t)
        return one.log + log - 0.5 * float(t @ t), gradient, hessian

    z = np.append(found.x, np.zeros(len(rows)) if spectra.uneven is None else spectra.uneven)
    precision = np.append(model.precision, np.ones(len(rows)))
    log, gradient, hessian = expanded(z)
    damping = 1e-2
    for _ in range(_ROUNDS):
        damped = hessian + damping * np.diag(np.diag(hessian) + precision)
        step = np.linalg.solve(damped, gradient)
        if step @ gradient < _ENOUGH:
            break
        there = expanded(z + step)
        if there[0] > log:
            z, (log, gradient, hessian), damping = z + step, there, damping / 5
        else:
            damping *= 10
    curved = hessian + np.diag(np.where(precision > np.diag(hessian), precision, 0))
    log_z = log + 0.5 * len(found.x) * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(curved)[1]
    return z[len(found.x) :], float(log_z)


def straightened(spectra: Spectra, some: Sequence[Found]) -> Spectra | None:
    """The recording with its antennas where they truly stood; None where it does not pay to move them.

    Args:
        some: the best hypothesis of every kind.
    """
    t, log_z = max((fitted(spectra, one) for one in some), key=lambda one: one[1])
    if log_z < max(one.log_z for one in some) + PAYS:
        return None
    stated = spectra.stated or spectra
    return stated.turned(t @ errors(stated), t)
