"""The log likelihood of a model of points by the compiled loop: `columns` and `evidence` at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tagid.loops import loop
from tagid.reading.bounce import BOUNCE_M, TOUCH_M
from tagid.reading.columns import Model, nearest_ring, table_of
from tagid.reading.sheet import SheetModel
from tagid.reading.spectra import Complex, Floats, Spectra
from tagid.reading.transfers.transfer import Transfer

_evidence = loop("tagid.reading._evidence")

Amplitudes = tuple[float, float, float]
"""Prior powers of body and reflectors, over the moving energy, and of oval tangents, over the body's."""
_MOST = 32
"""Columns or parameters that the compiled loop takes, at most."""


class Compiled:
    """Log likelihood of one recording over the parameters x (P,) of a model.

    The amplitudes are integrated out.
    """

    def __init__(self, spectra: Spectra, model: Model) -> None:
        tag, transfer = model.tag, model.transfer
        self.model = model
        self._powers: dict[tuple[Amplitudes, ...], Floats] = {}
        k = 0 if tag is None else tag.count
        reflectors, groups = np.zeros((3, k)), np.zeros((4, k), dtype=np.int64)
        tables: Complex = np.zeros(0, dtype=np.complex128)
        if tag is not None:
            reflectors[:] = tag.radius_m, tag.angle, tag.height_m
            radii, index = np.unique([nearest_ring(r) for r in tag.radius_m], return_inverse=True)
            groups[:] = tag.turn, tag.stretch, index, tag.lift if model.lifts else np.full(k, -1)
            tables = _stacked(transfer, spectra.kappa.tobytes(), tuple(radii.tolist()))
        seen = model.seeing(spectra.direction)
        place = spectra.antenna.real, spectra.antenna.imag, spectra.height_m, spectra.direction
        kappa, clutter, white, bases = _recording(spectra)
        body = model.body_columns
        shared = kappa, clutter[model.disc], white[model.disc], bases[model.disc]
        self._before = (np.stack([*place, seen.astype(float)]), *shared, reflectors, groups, tables)
        numbers = body, len(transfer.power), model.bounces, model.odd, model.spot
        self._after = (spectra.distance_m, BOUNCE_M, TOUCH_M, *numbers)

    @staticmethod
    def of(spectra: Spectra, model: Model) -> Compiled | None:
        """That of a model; None where numpy is to do it: without the compiled loop, or for other columns."""
        if _evidence is None or max(model.columns + 1, model.parameters) > _MOST:
            return None
        if isinstance(model, SheetModel):
            return Given(spectra, model)
        return _of(spectra, model) if type(model) is Model else None

    def values(self, x: Floats, some: Sequence[Amplitudes], clutter: Sequence[float]) -> Floats:
        """(G, H) log likelihoods under G powers of the clutter and H of the others."""
        out = np.empty((len(clutter), len(some)))
        self._run(_evidence.values, x, tuple(some), clutter, out)
        return out

    def expanded(self, x: Floats, powers: Amplitudes, clutter: float) -> tuple[float, Floats, Floats]:
        """Log likelihood, its gradient (P,), and the Gauss-Newton Hessian (P, P) of minus it."""
        p = len(x)
        out = np.empty(1 + p + p * p)
        self._run(_evidence.expand, x, (powers,), (clutter,), out)
        return float(out[0]), out[1 : 1 + p], out[1 + p :].reshape(p, p)

    def _run(
        self,
        function: Callable[..., None],
        x: Floats,
        some: tuple[Amplitudes, ...],
        clutter: Sequence[float],
        out: Floats,
    ) -> None:
        power = self._powers.get(some)
        if power is None:
            unit = np.ones(1)
            power = np.concatenate([self.model.power(unit, *one) for one in some])
            self._powers[some] = power
        x = np.ascontiguousarray(x, dtype=np.float64)
        function(*self._before, x, power, np.array(clutter), out, *self._after)


class Given(Compiled):
    """The same of a model whose columns are given: of a sheet."""

    model: SheetModel

    def __init__(self, spectra: Spectra, model: SheetModel) -> None:
        self.model, self._spectra = model, spectra

    def values(self, x: Floats, some: Sequence[Amplitudes], clutter: Sequence[float]) -> Floats:
        """See `Compiled.values`."""
        out = np.empty((len(clutter), len(some)))
        columns = self.model.at(self._spectra, x).values
        self._given(_evidence.given_values, columns, np.zeros(0), tuple(some), clutter, out)
        return out

    def expanded(self, x: Floats, powers: Amplitudes, clutter: float) -> tuple[float, Floats, Floats]:
        """See `Compiled.expanded`."""
        p = len(x)
        out = np.empty(1 + p + p * p)
        columns = self.model.at(self._spectra, x).expanded
        self._given(_evidence.given_expand, *columns, (powers,), (clutter,), out)
        return float(out[0]), out[1 : 1 + p], out[1 + p :].reshape(p, p)

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
        disc, unit = self.model.disc, np.ones(1)
        power = np.concatenate([self.model.power(unit, *one) for one in some])
        pack = np.ascontiguousarray
        shared = kappa, variance[disc], white[disc], bases[disc]
        function(*shared, pack(values), pack(rates), power, np.array(clutter), out)


@lru_cache(maxsize=8)
def _of(spectra: Spectra, model: Model) -> Compiled:
    return Compiled(spectra, model)


@lru_cache(maxsize=2)
def _recording(spectra: Spectra) -> tuple[Floats, list[Floats], list[Complex], list[NDArray[np.generic]]]:
    """What all models of a recording share: frequencies, and of every disc variance, data and basis."""
    turn = np.exp(-2j * np.pi * np.arange(spectra.views) / spectra.views)
    pack = np.ascontiguousarray
    return (
        np.stack([spectra.kappa, spectra.moving]),
        [pack(one.variance) for one in spectra.whiteners],
        [pack(one) for one in spectra.white],
        [turn if one.basis is None else pack(one.basis.real) for one in spectra.whiteners],
    )


@lru_cache(maxsize=64)
def _stacked(transfer: Transfer, kappa: bytes, radii: tuple[float, ...]) -> Complex:
    """(R, P, F, ANGLES) tables of reflectors at distances from the axis, m."""
    return np.stack([table_of(transfer, kappa, radius) for radius in radii])
