"""From a start to the most probable parameters of a model: the only descent of the room."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from tagid.reading.columns import Columns, Model
from tagid.reading.evidence import Fit, fit, log_evidence
from tagid.reading.spectra import Floats, Spectra

CLUTTER = (0.0, 1e-4, 1e-3, 1e-2, 1e-1)
"""Powers of the clutter that are tried, over the moving energy."""
TAG = (0.03, 0.3, 3.0)
"""Powers of a reflector that are tried, over the moving energy."""
BODY = (0.1, 3.0, 100.0, 3000.0)
"""Powers of a body that are tried, over the moving energy: what does not move is the room's."""
OVAL = (1e-5, 1e-3, 1e-1)
"""Powers of a body's oval part that are tried, over the body's."""
_FAR_M = 0.03
"""No centre lies farther from the axis."""


@dataclass(frozen=True)
class Powers:
    """Prior powers of clutter, body and reflectors over the moving energy, of ovals over the body's."""

    clutter: float
    body: float = 100.0
    tag: float = 0.3
    oval: float = 1e-3


@dataclass(frozen=True, eq=False)
class Found:
    """A model at its most probable parameters.

    Attributes:
        x: (P,) parameters.
        log: log posterior density there, amplitudes integrated out, nats.
        log_z: log evidence, with the parameters integrated out by Laplace's method.
        centre_sd_m: standard deviation of the centre, the larger one.
    """

    model: Model
    x: Floats
    powers: Powers
    log: float
    log_z: float
    centre_sd_m: float

    @property
    def places(self) -> NDArray[np.complex128]:
        """(K,) of the reflectors, m."""
        return self.model.places(self.x)

    @property
    def odd(self) -> NDArray[np.complex128]:
        """(m,) of the odd scatterers, m."""
        return self.model.split(self.x)[3]

    @property
    def centre(self) -> complex:
        """Of the object, m."""
        return complex(self.x[0], self.x[1])


def variance(spectra: Spectra, model: Model, clutter: float) -> Floats:
    """(F, M) lambda: variance of noise and clutter."""
    return np.asarray(1 + clutter * spectra.moving[:, None] * spectra.whiteners[model.disc].variance)


def best_powers(
    spectra: Spectra, model: Model, x: Floats, clutter: float | None = None
) -> tuple[Powers, float]:
    """The powers of the largest evidence at some parameters, and its log density."""
    whitener = spectra.whiteners[model.disc]
    columns = whitener.apply(Columns.of(model, spectra, x, slopes=False).values)
    data = spectra.white[model.disc]
    best, found = -np.inf, Powers(0.0)
    bodies = BODY if model.transfer.body else BODY[:1]
    tags = TAG if model.tag is not None else TAG[1:2]
    for ovals in (OVAL[1:2], OVAL) if model.oval and model.transfer.body else (OVAL[1:2],):
        if len(ovals) > 1:
            bodies, tags = (found.body,), (found.tag,)
        some = list(product(bodies, tags, ovals))
        power = np.stack([model.power(spectra.moving, *one) for one in some])
        sigmas = CLUTTER if clutter is None else (clutter,)
        for sigma in sigmas if len(ovals) == 1 else (found.clutter,):
            values = log_evidence(columns, data, variance(spectra, model, sigma)[None], power)
            i = int(values.argmax())
            if values[i] > best:
                best, found = float(values[i]), Powers(sigma, *some[i])
    return found, best + model.log_prior(x)[0] - model.overlap(x)


@dataclass(frozen=True, eq=False)
class _Here:
    log: float
    gradient: Floats
    hessian: Floats


def _value(
    spectra: Spectra, model: Model, x: Floats, lam: Floats, power: Floats
) -> tuple[float, Columns, Fit]:
    columns = Columns.of(model, spectra, x)
    whitener = spectra.whiteners[model.disc]
    found = fit(whitener.apply(columns.values), spectra.white[model.disc], lam, power)
    return found.log + model.log_prior(x)[0] - model.overlap(x), columns, found


def _expanded(
    spectra: Spectra, model: Model, x: Floats, lam: Floats, value: tuple[float, Columns, Fit]
) -> _Here:
    log, columns, found = value
    whitener = spectra.whiteners[model.disc]
    back = whitener.adjoint(found.adjoint)
    gradient = 2 * columns.slopes(back.conj()).sum(axis=(1, 2)).real
    moved = np.swapaxes(columns.slopes(found.amplitudes[..., None]), 0, 1)
    hessian = found.curvature(whitener.apply(moved) / np.sqrt(lam)[:, None])
    _, slope, pull = model.log_prior(x)
    gradient += slope
    hessian += pull
    if model.overlap(x) > 0:
        for i in range(len(x)):
            step = np.zeros(len(x))
            step[i] = 1e-5
            gradient[i] -= (model.overlap(x + step) - model.overlap(x - step)) / 2e-5
            hessian[i, i] += 1 / 1e-3**2
    return _Here(log, gradient, hessian)


def descend(spectra: Spectra, model: Model, x: Floats, powers: Powers, rounds: int) -> tuple[Floats, _Here]:
    """Levenberg and Marquardt's method from x at fixed powers."""
    lam = variance(spectra, model, powers.clutter)
    power = model.power(spectra.moving, powers.body, powers.tag, powers.oval)
    value = _value(spectra, model, x, lam, power)
    here = _expanded(spectra, model, x, lam, value)
    damping = 1e-2
    for _ in range(rounds):
        size = np.diag(here.hessian) + model.precision
        step = np.linalg.solve(here.hessian + damping * np.diag(size), here.gradient)
        trial = x + step
        promised = float(step @ here.gradient)
        if promised < 0.02:
            break
        near = np.hypot(trial[0], trial[1]) < _FAR_M
        value = _value(spectra, model, trial, lam, power) if near else value
        if near and value[0] > here.log:
            x, gained = trial, value[0] - here.log
            here = _expanded(spectra, model, x, lam, value)
            damping /= 5
            if gained < 0.02:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return x, here


def refined(
    spectra: Spectra,
    model: Model,
    x: Floats,
    stages: tuple[float | None, ...] = (1e-2, None),
    rounds: int = 6,
) -> Found:
    """The most probable parameters near a start.

    Args:
        stages: powers of the clutter, one after the other: much clutter widens the maximum; None: the best.
        rounds: of every stage.
    """
    x = np.asarray(x, dtype=float)
    for clutter in stages:
        powers, _ = best_powers(spectra, model, x, clutter)
        x, here = descend(spectra, model, x, powers, rounds)
    powers, log = best_powers(spectra, model, x)
    curved = here.hessian + np.where(np.diag(here.hessian) > 0, 0, 1) * np.eye(len(x))
    curved = here.hessian + np.diag(np.where(model.precision > np.diag(here.hessian), model.precision, 0))
    sign, volume = np.linalg.slogdet(curved)
    if sign <= 0:
        volume = float(np.log(np.maximum(np.diag(curved), 1e-300)).sum())
    log_z = log + 0.5 * len(x) * np.log(2 * np.pi) - 0.5 * float(volume)
    spread = float(1 / np.sqrt(max(np.linalg.eigvalsh(curved[:2, :2])[0], 1e-30)))
    return Found(model, x, powers, log, log_z, spread)
