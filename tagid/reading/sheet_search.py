"""Where sheets may be, and reflectors in and beside one: starts of the descent.

All sizes, turns and centres of a sheet are tried. The harmonics of its echo are a table, which is kept; about
another centre the data move instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.fields.thin_shell import BoxShell
from tagid.reading.arrangement import Arrangement
from tagid.reading.columns import REACH_M, Priors
from tagid.reading.descent import Powers
from tagid.reading.remainder import Remainder, grid
from tagid.reading.search import Tables
from tagid.reading.sheet import HEAD, STEP, Kind, SheetColumns, SheetModel, in_frame, quadrant
from tagid.reading.spectra import Spectra
from tagid.types import Complex, Floats

TURNED_RAD = 1.1
"""Half a step between the turns that are tried turns the highest harmonic by less."""
NEARER = 0.1
"""Step between the logarithms of the distances of tables: the waves' curvature changes little."""
LONGEST = 1.5
"""Ratio of the half axes of an ellipse, at most, in the search."""
EVERY = 2
"""Every so many-th frequency is used."""
_GRID_M, _GRID = 5e-3, 2
_FLOOR = 3e-3
"""Share of the echo that a right sheet leaves."""
_FAINT, GROUPED = 1e-4, 3
"""Share of an echo's energy in harmonics beyond the last one, whose number is a multiple of the second."""
COARSE = 3
"""Boxes of every so many-th half size are tried, and the neighbours of the best."""
RING = 72
"""Places on a ring about a sheet."""


@dataclass(frozen=True, eq=False)
class Start:
    """A sheet at parameters (HEAD + 2,), and the share of the data's logarithm that it explains, nats."""

    kind: Kind
    half_m: tuple[float, float]
    score: float
    centre: complex
    turn: float

    def begun(self, disc: int, priors: Priors = Priors()) -> tuple[SheetModel, Floats]:
        """The model and its parameters."""
        size = np.log(np.array(self.half_m) / self.kind.size_m)
        x = np.r_[self.centre.real, self.centre.imag, self.turn, size, np.zeros(HEAD - 3)]
        return replace(SheetModel.of(self.kind, self.half_m, disc), priors=priors), x


@lru_cache(maxsize=4096)
def _harmonics(kappa: bytes, distance_m: float, kind: Kind, half_m: tuple[float, float]) -> Complex:
    """(F, M) of the echo of a sheet: the sum over m of these times cos(2 m phi), phi the aspect.

    The highest, faint ones are left out.
    """
    wavenumber = np.frombuffer(kappa)
    count = quadrant(wavenumber, kind.shell(*half_m, kind.strength_m))
    aspect = np.pi / 2 * (np.arange(count) + 0.5) / count
    around = Spectra(
        np.zeros((len(wavenumber), count), dtype=np.complex128),
        wavenumber,
        distance_m * np.exp(1j * aspect),
        np.zeros(count),
        distance_m,
        np.ones(len(wavenumber)),
        False,
    )
    x = np.r_[np.zeros(3), np.log(np.array(half_m) / kind.size_m), np.zeros(HEAD - 3)]
    echo = SheetColumns(SheetModel.of(kind, half_m, 0), around, x).values[:, 0]
    harmonics = echo @ np.cos(2 * np.arange(count) * aspect[:, None]) * (2 / count)
    harmonics[:, 0] /= 2
    energy = np.cumsum(_power(harmonics[:, ::-1]), axis=1)[:, ::-1]
    strong = int((energy > _FAINT * energy[:, :1]).any(axis=0).sum())
    return np.asarray(harmonics[:, : -(-strong // GROUPED) * GROUPED], dtype=np.complex64)


class Seeker:
    """The search for sheets in one recording.

    Args:
        held: (F, J, V) columns that something else explains.
    """

    def __init__(self, spectra: Spectra, held: Complex | None = None) -> None:
        self._spectra = spectra
        self._kappa = np.ascontiguousarray(spectra.kappa[::EVERY])
        self._distance = float(np.exp(round(np.log(spectra.distance_m) / NEARER) * NEARER))
        line = _GRID_M * np.arange(-_GRID, _GRID + 1)
        grid = (line[:, None] + 1j * line).ravel()
        self._centres = grid[np.abs(grid) < 2.1 * _GRID_M]
        data = spectra.data[::EVERY]
        from_centre = np.abs(spectra.antenna - self._centres[:, None])
        moved = np.exp(1j * self._kappa[:, None, None] * (from_centre - spectra.distance_m))
        keep = [np.ones_like(data)] + ([] if held is None else list(np.moveaxis(held[::EVERY], 1, 0)))
        basis = np.linalg.qr(np.stack(keep, axis=2))[0]
        residual = data - (basis @ (np.swapaxes(basis.conj(), 1, 2) @ data[..., None]))[..., 0]
        self._energy = (np.abs(residual) ** 2).sum(axis=1)
        every = np.concatenate([residual[:, :, None], basis], axis=2)
        # (F, V, (1 + J) C) data and held columns about every centre.
        seen = every[..., None] * np.swapaxes(moved, 1, 2)[:, :, None]
        self._parts = every.shape[2]
        self._seen = seen.reshape(*seen.shape[:2], -1).astype(np.complex64)
        self._turned: dict[tuple[int, int], tuple[Floats, Complex, NDArray[np.float32]]] = {}

    def _turns(self, harmonics: int, alike: int) -> tuple[Floats, Complex, NDArray[np.float32]]:
        """Turns (T,), inner products of harmonics with what is seen, and the harmonics as they are seen.

        The products are (F, M, 1 + J, T, C), the harmonics (M, p, V) at p turns, after which their energy
        comes again.
        """
        if (harmonics, alike) not in self._turned:
            views, step = self._spectra.views, TURNED_RAD / harmonics
            period = count = int(np.ceil(2 * np.pi / alike / step))
            if self._spectra.full_turn:
                period = int(np.ceil(2 * np.pi / views / step))
                while period * views % alike:
                    period += 1
                count = period * views // alike
            turn = 2 * np.pi / alike * np.arange(count) / count
            m = 2 * np.arange(harmonics)[:, None]
            here, there = m * self._spectra.direction, m * turn
            cosine, sine = (f(here).astype(np.float32) @ self._seen for f in (np.cos, np.sin))
            along, across = (f(there).astype(np.float32)[:, None, :, None] for f in (np.cos, np.sin))
            shape = *cosine.shape[:2], self._parts, 1, -1
            inner = along * cosine.reshape(shape) + across * sine.reshape(shape)
            seen = np.cos(here[:, None] - there[:, :period, None]).astype(np.float32)
            self._turned[harmonics, alike] = turn, inner, seen
        return self._turned[harmonics, alike]

    def fitted(self, kind: Kind, sizes: Sequence[tuple[float, float]]) -> list[Start]:
        """The best turn and centre of every sheet."""
        sizes = [(round(a, 4), round(b, 4)) for a, b in sizes]
        kappa = self._kappa.tobytes()
        groups: dict[tuple[int, int], tuple[list[tuple[float, float]], list[Complex]]] = {}
        for half_m in sizes:
            echo = _harmonics(kappa, self._distance, kind, half_m)
            alike = 4 if kind.shell is BoxShell and half_m[0] == half_m[1] else 2
            some, echoes = groups.setdefault((echo.shape[1], alike), ([], []))
            some.append(half_m)
            echoes.append(echo)
        starts: list[Start] = []
        for (_, alike), (some, echoes) in groups.items():
            starts += self._fitted(kind, some, np.stack(echoes, axis=1), alike)
        return starts

    def _fitted(
        self, kind: Kind, sizes: Sequence[tuple[float, float]], echo: Complex, alike: int
    ) -> list[Start]:
        views, harmonics = self._spectra.views, echo.shape[2]
        turn, inner, seen = self._turns(harmonics, alike)
        size = _power(echo @ seen.reshape(harmonics, -1)).reshape(*echo.shape[:2], -1, views).sum(axis=3)
        size = size[..., np.arange(len(turn)) % size.shape[2], None]
        # (F, S, 1 + J, T, C)
        power = _power(echo.conj() @ inner.reshape(len(echo), harmonics, -1))
        power = power.reshape(*echo.shape[:2], *inner.shape[2:])
        least = np.maximum(size - power[:, :, 1:].sum(axis=2), 1e-4 * views)
        share = power[:, :, 0] / least / self._energy.astype(np.float32)[:, None, None, None]
        rest = (np.maximum(1 - share, 0) + _FLOOR).prod(axis=0)
        residual = rest.reshape(len(sizes), -1)
        best = residual.argmin(axis=1)
        return [
            Start(
                kind,
                half_m,
                -float(np.log(residual[s, i])) * views * EVERY,
                complex(self._centres[i % len(self._centres)]),
                float(turn[i // len(self._centres)]),
            )
            for s, (half_m, i) in enumerate(zip(sizes, best, strict=True))
        ]

    def best(self, kind: Kind, count: int) -> list[Start]:
        """The sheets that explain most, none of about the size of a better one."""
        sizes = kind.sizes_m
        if kind.shell is not BoxShell:
            pairs = [(a, b) for i, a in enumerate(sizes) for b in sizes[i:] if b < LONGEST * a]
            return _unlike(self.fitted(kind, pairs), count)
        some = sizes[::COARSE]
        starts = self.fitted(kind, [(a, b) for i, a in enumerate(some) for b in some[i:]])
        factors = (1 / STEP, 1.0, STEP)
        for start in _unlike(starts, count):
            a, b = start.half_m
            starts += self.fitted(
                kind, [(a * f, b * g) for f in factors for g in factors if (f, g) != (1, 1)]
            )
        return _unlike(starts, count)


def _power(x: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(x.real**2 + x.imag**2)


def _unlike(starts: Sequence[Start], count: int) -> list[Start]:
    kept: list[Start] = []
    for start in sorted(starts, key=lambda other: -other.score):
        if all(np.abs(np.log(np.array(start.half_m) / other.half_m)).max() > 0.06 for other in kept):
            kept.append(start)
            if len(kept) == count:
                break
    return kept


def beside(
    spectra: Spectra,
    model: SheetModel,
    x: Floats,
    tags: Sequence[Arrangement],
    centre: complex,
    powers: Powers,
) -> tuple[Tables, Tables, Complex]:
    """Tables of reflectors about a sheet.

    Args:
        x: parameters of the untagged model.
        tags: of the layouts, about a centre x + jy, m.

    Returns:
        Tables of the layouts, in `RING` turns; of single reflectors that lie anywhere; and their places (N,),
        x + jy, m.
    """
    rings_of_tags = [list(zip(np.round(tag.radius_m, 4), tag.height_m, strict=True)) for tag in tags]
    rings = sorted({spot_ring for some in rings_of_tags for spot_ring in some})
    columns = SheetColumns(model, spectra, x)
    remainder = Remainder.of(spectra, model, columns.values, powers)
    turns = np.exp(2j * np.pi * np.arange(RING) / RING)
    positions = np.concatenate([centre + r * turns for r, _ in rings])
    ring = remainder.whitened(columns.reflectors(positions, np.repeat([z for _, z in rings], RING)))
    anywhere = complex(x[0], x[1]) + grid(min(max(model.sheet(x).radius_m * 1.2, 0.05), 1.5 * REACH_M))
    if not model.transfer.clear:
        anywhere = anywhere[model.sheet(x).outside_m(in_frame(x, anywhere)) >= 0]
    spots = remainder.whitened(columns.reflectors(anywhere, np.zeros(len(anywhere))))
    chosen = remainder.likeliest(spots)
    turned = []
    for tag, some in zip(tags, rings_of_tags, strict=True):
        steps = np.rint(tag.angle / (2 * np.pi / RING)).astype(np.intp) + np.arange(RING)[:, None]
        rows = np.array([rings.index(spot_ring) for spot_ring in some]) * RING + steps % RING
        turned.append(ring[:, rows].sum(axis=2))
    level = np.repeat([z == 0 for _, z in rings], RING) & (np.arange(len(positions)) % 2 == 0)
    spots = np.concatenate([ring[:, level], spots[:, chosen]], axis=1)
    every = np.concatenate([positions[level], anywhere[chosen]])
    whole = remainder.tables(np.concatenate(turned, axis=1), RING)
    return whole, remainder.tables(spots, len(every)), every
