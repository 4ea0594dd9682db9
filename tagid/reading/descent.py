"""From a start to the most probable parameters of a model: the only descent of the room."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from tagid.reading.columns import Model
from tagid.reading.compiled import Amplitudes, Compiled, Given, fits
from tagid.reading.evidence import fit, log_evidence
from tagid.reading.spectra import Spectra
from tagid.types import Complex, Floats
from tagid.workers import check_wanted

CLUTTER = (0.0, 1e-4, 1e-3, 1e-2, 1e-1)
"""Powers of the clutter that are tried, over the moving energy."""
TAG = (0.03, 0.25, 2.0)
"""Powers of a reflector that are tried, over the moving energy: it may be seen from a few sides only."""
BODY = (0.1, 3.0, 100.0, 3000.0)
"""Powers of a body that are tried, over the moving energy: what does not move is the room's."""
OVAL = (1e-5, 1e-3, 1e-1)
"""Powers of a body's oval part that are tried, over the body's."""
ENOUGH = 0.02
"""Nats that a step of the descent gains at least, or it is the last."""
_PROMISED = 2.0
"""A descent hardly gains more than so many times what its steps promise."""
_AGAIN = 3
"""Descents more at most, while other powers explain more than those of the last one."""
FAR_M = 0.03
"""No centre lies farther from the axis."""
_ROUND = tuple(np.exp(2j * np.pi * np.arange(60) / 60))
"""Turns by which a reflector is moved along its ring: on the largest, 15 mm, a fifth of a wavelength."""


@dataclass(frozen=True)
class Powers:
    """Prior powers of clutter, body and reflectors over the moving energy, of ovals over the body's."""

    clutter: float
    body: float = 100.0
    tag: float = 0.3
    oval: float = 1e-3

    @property
    def amplitudes(self) -> Amplitudes:
        """Those of the columns."""
        return self.body, self.tag, self.oval


@dataclass(frozen=True, eq=False)
class Estimate:
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

    def whitened(self, spectra: Spectra) -> tuple[Complex, Complex, Floats, Floats]:
        """Columns and data in the basis of the whitener, their variance, and powers: see `evidence.fit`."""
        model = self.model
        columns = spectra.whiteners[model.disc].apply(model.at(spectra, self.x, slopes=False).values)
        lam = variance(spectra, model, self.powers.clutter)
        power = model.power(spectra.moving, *self.powers.amplitudes)
        return columns, spectra.white[model.disc], lam, power

    def beside(self, spectra: Spectra) -> NDArray[np.complex128]:
        """(F, n, V) columns of the reflectors."""
        model = self.model
        values = model.at(spectra, self.x, slopes=False).values
        return values[:, model.body_columns : model.columns - model.odd]

    def unbound(self) -> tuple[Model, Floats]:
        """The model with every reflector free to go anywhere, and its parameters where they stand."""
        model, x = self.model, self.x
        assert model.tag is not None
        tag, rest = model.tag, x[model.head :]
        turns, stretches, rest = np.split(rest, [tag.turns, tag.turns + tag.stretches])
        free = replace(model, tag=tag.unbound(turns[tag.turn]))
        return free, np.r_[x[: model.head], np.zeros(tag.count), stretches[tag.stretch], rest]

    def by_hand(self) -> tuple[Model, Floats]:
        """The model with every reflector a little off its place, as they were glued, and its parameters."""
        model, x = self.model, self.x
        assert model.tag is not None
        tag = model.tag.by_hand()
        turn, stretch, *rest = x[model.head :]
        glued, lift = replace(model, tag=replace(tag, angle=tag.angle + turn)), rest[: model.lifts]
        moved = np.zeros(tag.count), np.full(tag.count, stretch), np.repeat(lift, tag.count)
        return glued, np.r_[x[: model.head], *moved, rest[model.lifts :]]

    def and_alike(self, place: complex, *, odd: bool = False) -> tuple[Model, Floats]:
        """The model with a reflector more, alike and free, and its parameters.

        Args:
            odd: beside the odd scatterers, not instead of them.
        """
        model, x, tag = self.model, self.x, self.model.tag
        assert tag is not None
        more = replace(model, tag=tag.and_one(place - self.centre), odd=model.odd if odd else 0)
        turns, stretches = model.head + tag.turns, model.head + tag.turns + tag.stretches
        lifts = x[stretches:][: model.lifts]
        rest = [0.0], x[turns:stretches], [0.0], lifts, np.zeros(more.lifts - len(lifts))
        return more, np.concatenate([x[:turns], *rest, x[len(x) - more.spot * more.odd :]])

    def more_on_ring(self) -> list[tuple[Model, Floats]]:
        """The models with one more at every turn of the outermost reflector's ring, and their parameters."""
        out = max(self.positions - self.centre, key=abs)
        return [self.and_alike(self.centre + out * turn, odd=True) for turn in _ROUND]

    @property
    def positions(self) -> NDArray[np.complex128]:
        """(K,) of the reflectors, m."""
        return self.model.positions(self.x)

    @property
    def odd(self) -> NDArray[np.complex128]:
        """(m,) of the odd scatterers, m."""
        return self.model.split(self.x)[3]

    @property
    def centre(self) -> complex:
        """Of the object, m."""
        return self.model.split(self.x)[0]


def variance(spectra: Spectra, model: Model, clutter: float) -> Floats:
    """(F, M) lambda: variance of noise, clutter and what differs from an enrolled echo."""
    disc = spectra.moving[:, None] * spectra.whiteners[model.disc].variance
    return np.asarray(1 + model.error(spectra) + clutter * disc)


@dataclass(frozen=True, eq=False)
class _Numpy:
    """What `Compiled` is, for any model."""

    spectra: Spectra
    model: Model

    def values(self, x: Floats, some: Sequence[Amplitudes], clutter: Sequence[float]) -> Floats:
        spectra, model = self.spectra, self.model
        columns = spectra.whiteners[model.disc].apply(model.at(spectra, x, slopes=False).values)
        power = np.stack([model.power(spectra.moving, *amplitudes) for amplitudes in some])
        variances = [variance(spectra, model, sigma)[None] for sigma in clutter]
        logs = [log_evidence(columns, spectra.white[model.disc], lam, power) for lam in variances]
        return np.stack(logs) + model.log_prior(x)[0]

    def expanded(self, x: Floats, powers: Amplitudes, clutter: float) -> tuple[float, Floats, Floats]:
        spectra, model = self.spectra, self.model
        lam, power = variance(spectra, model, clutter), model.power(spectra.moving, *powers)
        columns, whitener = model.at(spectra, x), spectra.whiteners[model.disc]
        fitted = fit(whitener.apply(columns.values), spectra.white[model.disc], lam, power)
        back = whitener.adjoint(fitted.adjoint)
        gradient = 2 * columns.slopes(back.conj()).sum(axis=(1, 2)).real
        moved = np.swapaxes(columns.slopes(fitted.amplitudes[..., None]), 0, 1)
        hessian = fitted.curvature(whitener.apply(moved) / np.sqrt(lam)[:, None])
        log, slope, pull = model.log_prior(x, slopes=True)
        return fitted.log + log, gradient + slope, hessian + pull


class _OwnColumns(_Numpy):
    """The same with values by the compiled loop, from columns by numpy."""

    def values(self, x: Floats, some: Sequence[Amplitudes], clutter: Sequence[float]) -> Floats:
        return Given(self.spectra, self.model).values(x, some, clutter)


def _likelihood(spectra: Spectra, model: Model) -> Compiled | _Numpy:
    plain = fits(model) and np.ndim(model.error(spectra)) == 0
    return Compiled.of(spectra, model) or (_OwnColumns if plain else _Numpy)(spectra, model)


def best_powers(
    spectra: Spectra, model: Model, x: Floats, clutter: float | None = None
) -> tuple[Powers, float]:
    """The powers of the largest evidence at some parameters, and its log density."""
    likelihood = _likelihood(spectra, model)
    best, likeliest = -np.inf, Powers(0.0)
    bodies = BODY if model.transfer.body else BODY[:1]
    tags = TAG if model.tag is not None else TAG[1:2]
    sigmas = CLUTTER if clutter is None else (clutter,)
    for ovals in (OVAL[1:2], OVAL) if model.oval and model.transfer.body else (OVAL[1:2],):
        if len(ovals) > 1:
            bodies, tags = (likeliest.body,), (likeliest.tag,)
        some = list(product(bodies, tags, ovals))
        values = likelihood.values(x, some, sigmas)
        i, j = divmod(int(values.argmax()), len(some))
        if values[i, j] > best:
            best, likeliest = float(values[i, j]), Powers(sigmas[i], *some[j])
    return likeliest, best


@dataclass(frozen=True, eq=False)
class Here:
    """A log posterior density at some parameters, nats, its gradient (P,) and its negative Hessian (P, P)."""

    log: float
    gradient: Floats
    hessian: Floats


def climbed(
    expanded: Callable[[Floats], tuple[float, Floats, Floats]],
    precision: Floats,
    x: Floats,
    rounds: int,
    least: float = -np.inf,
) -> tuple[Floats, Here]:
    """Levenberg and Marquardt's method from x (P,), by what `Here` holds at parameters.

    Args:
        precision: (P,) of the prior, added to the curvature that damps.
        least: given up where the density will hardly reach it, nats.
    """
    here = Here(*expanded(x))
    damping = 1e-2
    for _ in range(rounds):
        size = np.diag(here.hessian) + precision
        step = np.linalg.solve(here.hessian + damping * np.diag(size), here.gradient)
        promised = float(step @ here.gradient)
        if promised < ENOUGH or here.log + _PROMISED * promised < least:
            break
        inside = np.hypot(*(x + step)[:2]) < FAR_M
        there = Here(*expanded(x + step)) if inside else None
        if there is not None and there.log > here.log:
            gained = there.log - here.log
            x, here = x + step, there
            damping /= 5
            if gained < ENOUGH:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return x, here


def descend(spectra: Spectra, model: Model, x: Floats, powers: Powers, rounds: int) -> tuple[Floats, Here]:
    """To the most probable parameters near x at fixed powers."""
    likelihood, given = _likelihood(spectra, model), (powers.amplitudes, powers.clutter)
    if isinstance(likelihood, Compiled) and not isinstance(likelihood, Given):
        x, log, gradient, hessian = likelihood.descended(x, *given, rounds, FAR_M, ENOUGH)
        return x, Here(log, gradient, hessian)
    return climbed(lambda there: likelihood.expanded(there, *given), model.precision, x, rounds)


def spread(hessian: Floats, precision: Floats) -> tuple[Floats, float]:
    """The curvature (P, P), with the prior's where that is more, and the logarithm of its determinant."""
    curved = hessian + np.diag(np.where(precision > np.diag(hessian), precision, 0))
    sign, volume = np.linalg.slogdet(curved)
    return curved, float(volume if sign > 0 else np.log(np.maximum(np.diag(curved), 1e-300)).sum())


def refined(
    spectra: Spectra,
    model: Model,
    x: Floats,
    stages: tuple[float | None, ...] = (1e-2, None),
    rounds: int = 6,
) -> Estimate:
    """The most probable parameters near a start.

    Args:
        stages: powers of the clutter, one after the other: much clutter widens the maximum; None: the best,
            in the end with parameters and powers that are the best of each other.
        rounds: of every stage.
    """
    check_wanted()
    x = np.asarray(x, dtype=float)
    likelihood = _likelihood(spectra, model)
    if isinstance(likelihood, Given):
        likelihood.columns(x, slopes=True)  # a descent will want the slopes, which come at once
    for clutter in stages:
        used, _ = best_powers(spectra, model, x, clutter)
        x, here = descend(spectra, model, x, used, rounds)
    powers, log = best_powers(spectra, model, x)
    for _ in range(_AGAIN if stages[-1] is None else 0):
        if powers == used:
            break
        # The curvature, which the evidence takes, is of the powers of a descent.
        used = powers
        x, here = descend(spectra, model, x, used, rounds)
        powers, log = best_powers(spectra, model, x)
    curved, volume = spread(here.hessian, model.precision)
    log_z = log + 0.5 * len(x) * np.log(2 * np.pi) - 0.5 * volume
    centre_sd = float(1 / np.sqrt(max(np.linalg.eigvalsh(curved[:2, :2])[0], 1e-30)))
    return Estimate(model, x, powers, log, log_z, centre_sd)
