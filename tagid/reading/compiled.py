"""The posterior density of a model of points by the compiled loop: `columns` and `evidence` at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tagid.loops import loop
from tagid.reading.bounce import BOUNCE_M, TOUCH_M
from tagid.reading.columns import CLOSE_SD_M, REACH_M, RING_M, SHAPE_M, Model, nearest_ring, pairs, table_of
from tagid.reading.sheet import SheetColumns, SheetModel
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.transfer import Transfer
from tagid.types import Complex, Floats

_evidence = loop("tagid.reading._evidence")

Amplitudes = tuple[float, float, float]
"""Prior powers of body and reflectors, over the moving energy, and of oval tangents, over the body's."""
_POWERS: dict[tuple[object, tuple[Amplitudes, ...]], Floats] = {}
"""Prior powers (H, n) of the columns of a kind of model: few kinds and few sets of powers are tried."""
_KEPT = 2
"""Steps of a descent whose columns are kept beside the last."""
_MOST = 32
"""Columns or parameters that the compiled loop takes, at most."""


def fits(model: Model) -> bool:
    """Whether the compiled loop is present and takes a model of its size."""
    return _evidence is not None and max(model.columns + 1, model.parameters) <= _MOST


class Compiled:
    """Log density of one recording and of the parameters x (P,) of a model, amplitudes integrated out."""

    def __init__(self, spectra: Spectra, model: Model) -> None:
        tag, transfer = model.tag, model.transfer
        self.model = model
        k = 0 if tag is None else tag.count
        reflectors, groups = np.zeros((3, k)), np.zeros((4, k), dtype=np.int64)
        tables: Complex = np.zeros(0, dtype=np.complex128)
        if tag is not None:
            reflectors[:] = tag.radius_m, tag.angle, tag.height_m
            rings = [nearest_ring(r) for r in tag.radius_m]
            radii = sorted(set(rings))
            index = [radii.index(r) for r in rings]
            groups[:] = tag.turn, tag.stretch, index, tag.lift if model.lifts else np.full(k, -1)
            tables = _stacked(transfer, spectra.kappa.tobytes(), tuple(radii))
        seen = model.seeing(spectra.direction)
        place = spectra.antenna.real, spectra.antenna.imag, spectra.height_m, spectra.direction
        kappa, clutter, white, bases = _recording(spectra)
        body = model.body_columns
        shared = kappa, clutter[model.disc], white[model.disc], bases[model.disc]
        prior = np.concatenate([model.pull, model.precision[None]]), *_limits(model)
        views = np.concatenate([np.stack([*place, seen.astype(float)]), model.windows(spectra.direction)])
        self._before = (views, *shared, reflectors, groups, tables, *prior)
        numbers = body, len(transfer.power), model.bounces, model.odd, model.spot
        self._after = (spectra.distance_m, BOUNCE_M, TOUCH_M, *numbers)

    @staticmethod
    def of(spectra: Spectra, model: Model) -> Compiled | None:
        """That of a model; None where numpy is to do it: without the compiled loop, or for other columns."""
        is_compiled = type(model) in (Model, SheetModel) and fits(model)
        return _of(spectra, model) if is_compiled else None

    def values(self, x: Floats, some: Sequence[Amplitudes], clutter: Sequence[float]) -> Floats:
        """(G, H) log densities under G powers of the clutter and H of the others."""
        out = np.empty((len(clutter), len(some)))
        self._run(_evidence.values, x, tuple(some), clutter, out)
        return out

    def expanded(self, x: Floats, powers: Amplitudes, clutter: float) -> tuple[float, Floats, Floats]:
        """Log density, its gradient (P,), and the Gauss-Newton Hessian (P, P) of minus it."""
        p = len(x)
        out = np.empty(1 + p + p * p)
        self._run(_evidence.expand, x, (powers,), (clutter,), out)
        return float(out[0]), out[1 : 1 + p], out[1 + p :].reshape(p, p)

    def descended(
        self, x: Floats, powers: Amplitudes, clutter: float, rounds: int, far_m: float, enough: float
    ) -> tuple[Floats, float, Floats, Floats]:
        """The parameters that `descent.descend` ends at, and what `expanded` gives there."""
        p = len(x)
        out = np.empty(p + 1 + p + p * p)
        self._run(_evidence.descend, x, (powers,), (clutter,), out, rounds, far_m, enough)
        return out[:p], float(out[p]), out[p + 1 : 2 * p + 1], out[2 * p + 1 :].reshape(p, p)

    def _run(
        self,
        function: Callable[..., None],
        x: Floats,
        some: tuple[Amplitudes, ...],
        clutter: Sequence[float],
        out: Floats,
        *more: float,
    ) -> None:
        x = np.ascontiguousarray(x, dtype=np.float64)
        function(*self._before, x, self._power(some), np.array(clutter), out, *self._after, *more)

    def _power(self, some: tuple[Amplitudes, ...]) -> Floats:
        model = self.model
        kind = (
            type(model),
            model.transfer.power,
            model.body_columns,
            model.unlike,
            model.faced,
            model.bounces,
            model.tagged,
        )
        power = _POWERS.get((kind, some))
        if power is None:
            unit = np.ones(1)
            power = np.concatenate([model.power(unit, *amplitudes) for amplitudes in some])
            _POWERS[kind, some] = power
        return power


class Given(Compiled):
    """The same of a model whose columns are given: of a sheet, and values alone of any other."""

    def __init__(self, spectra: Spectra, model: Model) -> None:
        self.model, self._spectra = model, spectra
        self._last: list[tuple[bytes, Complex, Complex | None]] = []

    def values(self, x: Floats, some: Sequence[Amplitudes], clutter: Sequence[float]) -> Floats:
        out = np.empty((len(clutter), len(some)))
        columns, _ = self.columns(x, slopes=False)
        self._given(_evidence.given_values, columns, np.zeros(0), tuple(some), clutter, out)
        return out + self.model.log_prior(x)[0]

    def expanded(self, x: Floats, powers: Amplitudes, clutter: float) -> tuple[float, Floats, Floats]:
        p = len(x)
        out = np.empty(1 + p + p * p)
        columns, rates = self.columns(x, slopes=True)
        assert rates is not None
        self._given(_evidence.given_expand, columns, rates, (powers,), (clutter,), out)
        log, slope, pull = self.model.log_prior(x, slopes=True)
        return float(out[0]) + log, out[1 : 1 + p] + slope, out[1 + p :].reshape(p, p) + pull

    def columns(self, x: Floats, *, slopes: bool) -> tuple[Complex, Complex | None]:
        """Columns and rates, see `SheetColumns`; a descent asks for those of its last steps again."""
        place = x.tobytes()
        for at, values, rates in self._last:
            if at == place and not (slopes and rates is None):
                return values, rates
        here = self.model.at(self._spectra, x, slopes)
        expanded = here.expanded if isinstance(here, SheetColumns) and slopes else (here.values, None)
        self._last = [(place, *expanded), *self._last[:_KEPT]]
        return expanded

    def _given(
        self,
        function: Callable[..., None],
        values: Complex,
        rates: Complex | Floats,
        some: tuple[Amplitudes, ...],
        clutter: Sequence[float],
        out: Floats,
    ) -> None:
        kappa, variance, white, bases = _recording(self._spectra)
        disc = self.model.disc
        shared = kappa, variance[disc], white[disc], bases[disc]
        pack = np.ascontiguousarray
        function(*shared, pack(values), pack(rates), self._power(some), np.array(clutter), out)


def _limits(model: Model) -> tuple[NDArray[np.int64], Floats]:
    """What `Model.crowding` and the prior of shapes need, see `prior` in `_evidence.c`."""
    first, second, rise, least = pairs(model.tag, model.odd)
    free = np.zeros(0) if model.tag is None else model.tag.free[model.tag.stretch]
    inside = REACH_M if model.tag is None else float(model.tag.radius_m.max())
    scale, reach = SHAPE_M if model.shapes else 0.0, model.priors.reach_m
    bounds = [model.log_at_mean, scale, inside, *RING_M, CLOSE_SD_M, reach]
    return np.concatenate([free, first, second]).astype(np.int64), np.concatenate([bounds, rise, least])


@lru_cache(maxsize=8)
def _of(spectra: Spectra, model: Model) -> Compiled:
    return Given(spectra, model) if isinstance(model, SheetModel) else Compiled(spectra, model)


@lru_cache(maxsize=2)
def _recording(spectra: Spectra) -> tuple[Floats, list[Floats], list[Complex], list[NDArray[np.generic]]]:
    """What all models of a recording share: frequencies, and of every disc variance, data and basis."""
    turn = np.exp(-2j * np.pi * np.arange(spectra.views) / spectra.views)
    pack = np.ascontiguousarray
    return (
        np.stack([spectra.kappa, spectra.moving]),
        [pack(whitener.variance) for whitener in spectra.whiteners],
        [pack(white) for white in spectra.white],
        [turn if whitener.basis is None else pack(whitener.basis) for whitener in spectra.whiteners],
    )


@lru_cache(maxsize=64)
def _stacked(transfer: Transfer, kappa: bytes, radii: tuple[float, ...]) -> Complex:
    """(R, P, F, ANGLES) tables of reflectors at distances from the axis, m."""
    return np.stack([table_of(transfer, kappa, radius) for radius in radii])
