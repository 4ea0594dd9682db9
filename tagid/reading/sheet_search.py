"""Where sheets may be, and reflectors in and beside one: starts of the descent.

All sizes, turns and centres of a sheet are tried. Its echo at every aspect is a table, which is kept; about
another centre the data move instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tagid.fields.thin_shell import BoxShell, ShellField
from tagid.reading.columns import CLOSEST_M, REACH_M
from tagid.reading.descent import Powers, variance
from tagid.reading.search import Tables, dense, grown
from tagid.reading.sheet import HEAD, STEP, Kind, SheetColumns, SheetModel
from tagid.reading.spectra import Complex, Floats, Spectra

ASPECTS = 720
"""Of a table: half a step turns the harmonic 50 by 0.2 rad."""
TURN_RAD = np.deg2rad(2.5)
"""Turns of a sheet that are tried."""
LONGEST = 1.5
"""Ratio of the half axes of an ellipse, at most, in the search."""
EVERY = 2
"""Every so many-th frequency is used."""
_GRID_M, _GRID = 4e-3, 2
_FLOOR = 3e-3
"""Share of the echo that a right sheet leaves."""
_KEPT = 5
"""Square boxes whose sides, and oblong ones whose neighbours, are tried."""
RING = 72
"""Places on a ring about a sheet."""
SPOTS, SPOT_M = 96, 7e-3
"""Places anywhere about a sheet, and the grid from which they are chosen, m."""


@dataclass(frozen=True, eq=False)
class Start:
    """A sheet at parameters (HEAD + 2,), and the share of the data's logarithm that it explains, nats."""

    kind: Kind
    half_m: tuple[float, float]
    score: float
    centre: complex
    turn: float

    def begun(self, disc: int) -> tuple[SheetModel, Floats]:
        """The model and its parameters."""
        size = np.log(np.array(self.half_m) / self.kind.size_m)
        x = np.r_[self.centre.real, self.centre.imag, self.turn, size, np.zeros(HEAD - 3)]
        return SheetModel.of(self.kind, self.half_m, disc), x


@lru_cache(maxsize=1024)
def _aspects(kappa: bytes, distance_m: float, kind: Kind, half_m: tuple[float, float]) -> Complex:
    """(F, ASPECTS) echo of a sheet from all sides."""
    wavenumber = np.frombuffer(kappa) / 2
    shell = kind.shell(*half_m, kind.strength_m)
    orders = 2 * wavenumber[-1] * shell.radius_m
    count = 8 * int(np.ceil((orders + 2 * orders ** (1 / 3) + 2) / 4))
    cells = SheetModel.of(kind, half_m, 0).cells
    field = ShellField.of(wavenumber, shell, cells)
    echo = field.echo(distance_m * np.exp(2j * np.pi * np.arange(count) / count))
    harmonics = np.zeros((len(wavenumber), ASPECTS), dtype=np.complex128)
    m = np.fft.fftfreq(count, 1 / count).astype(np.intp)
    harmonics[:, m] = np.fft.fft(echo, axis=1) / count
    return np.asarray(np.fft.ifft(harmonics, axis=1) * ASPECTS / np.abs(echo).mean()).astype(np.complex64)


class Seeker:
    """The search for sheets in one recording.

    Args:
        held: (F, J, V) columns that something else explains.
    """

    def __init__(self, spectra: Spectra, held: Complex | None = None) -> None:
        self._kappa = np.ascontiguousarray(spectra.kappa[::EVERY])
        self._distance = round(spectra.distance_m, 2)
        line = _GRID_M * np.arange(-_GRID, _GRID + 1)
        grid = (line[:, None] + 1j * line).ravel()
        self._centres = grid[np.abs(grid) < 2.3 * _GRID_M]
        data = spectra.data[::EVERY]
        from_centre = np.abs(spectra.antenna - self._centres[:, None])
        moved = np.exp(1j * self._kappa[:, None, None] * (from_centre - spectra.distance_m))
        keep = [np.ones_like(data)] + ([] if held is None else list(np.moveaxis(held[::EVERY], 1, 0)))
        basis = np.linalg.qr(np.stack(keep, axis=2))[0]
        left = data - (basis @ (np.swapaxes(basis.conj(), 1, 2) @ data[..., None]))[..., 0]
        self._energy = (np.abs(left) ** 2).sum(axis=1)
        every = np.concatenate([left[:, :, None], basis], axis=2)
        # (F, V, C (1 + J)) data and held columns about every centre.
        seen = np.moveaxis(moved, 1, 2)[..., None] * every[:, :, None]
        self._parts = seen.shape[3]
        self._seen = seen.reshape(*seen.shape[:2], -1).astype(np.complex64)
        self._antenna = np.rint(spectra.direction * ASPECTS / (2 * np.pi)).astype(np.intp)
        self._views = spectra.views

    def fitted(self, kind: Kind, half_m: tuple[float, float]) -> Start:
        """The best turn and centre of a sheet."""
        half_m = (round(half_m[0], 4), round(half_m[1], 4))
        table = _aspects(self._kappa.tobytes(), self._distance, kind, half_m)
        alike = 4 if kind.shell is BoxShell and half_m[0] == half_m[1] else 2
        steps = np.rint(np.arange(0, 2 * np.pi / alike, TURN_RAD) * ASPECTS / (2 * np.pi)).astype(np.intp)
        echo = table[:, (self._antenna - steps[:, None]) % ASPECTS]
        inner = (echo.conj() @ self._seen).reshape(*echo.shape[:2], -1, self._parts)
        power = np.abs(inner) ** 2
        size = (np.abs(echo) ** 2).sum(axis=2)[..., None] - power[..., 1:].sum(axis=3)
        share = power[..., 0] / np.maximum(size, 1e-4 * self._views) / self._energy[:, None, None]
        score = -self._views * np.log(np.maximum(1 - share, 0) + _FLOOR).sum(axis=0)
        t, c = np.unravel_index(int(score.argmax()), score.shape)
        turn = float(steps[t]) * 2 * np.pi / ASPECTS
        return Start(kind, half_m, float(score[t, c]) * EVERY, complex(self._centres[c]), turn)

    def best(self, kind: Kind, count: int) -> list[Start]:
        """The sheets that explain most, none of about the size of a better one."""
        sizes = kind.sizes_m
        if kind.shell is not BoxShell:
            pairs = [(a, b) for i, a in enumerate(sizes) for b in sizes[i:] if b < LONGEST * a]
            return _unlike([self.fitted(kind, pair) for pair in pairs], count)
        # A square whose side is one of two of an oblong box explains the flashes of two of its walls.
        found = [self.fitted(kind, (a, a)) for a in sizes]
        sides = sorted(one.half_m[0] for one in _unlike(found, _KEPT))
        found += [self.fitted(kind, (a, b)) for i, a in enumerate(sides) for b in sides[i + 1 :]]
        for one in _unlike(found, 2):
            a, b = one.half_m
            near = ((a * STEP, b), (a / STEP, b), (a, b * STEP), (a, b / STEP))
            found += [self.fitted(kind, pair) for pair in near]
        return _unlike(found, count)


def _unlike(starts: Sequence[Start], count: int) -> list[Start]:
    found: list[Start] = []
    for start in sorted(starts, key=lambda one: -one.score):
        if all(np.abs(np.log(np.array(start.half_m) / one.half_m)).max() > 0.06 for one in found):
            found.append(start)
            if len(found) == count:
                break
    return found


@dataclass(frozen=True, eq=False)
class Beside:
    """Single reflectors about a sheet: the first `len(rings)` times `RING` on rings, then those anywhere.

    Attributes:
        table: as of other bodies.
        places: (S,) x + jy, m; spots: (N,) indices of some that lie anywhere.
    """

    table: Tables
    places: Complex
    spots: NDArray[np.int32]


def beside(
    spectra: Spectra,
    model: SheetModel,
    x: Floats,
    rings: Sequence[tuple[float, float]],
    centre: complex,
    powers: Powers,
) -> Beside:
    """Tables of reflectors about a sheet.

    Args:
        x: parameters of the untagged model.
        rings: radius and height of each, m, about a centre x + jy, m.
    """
    columns = SheetColumns(model, spectra, x)
    whitener = spectra.whiteners[model.disc]
    root = np.sqrt(variance(spectra, model, powers.clutter))
    body = whitener.apply(columns.values) / root[:, None]
    own = model.power(spectra.moving, powers.body, powers.tag, powers.oval)
    factor = np.linalg.cholesky(body @ np.swapaxes(body.conj(), 1, 2) + np.eye(own.shape[1]) / own[:, None])
    # What the sheet leaves of w is w - q q^H w, in inner products with anything.
    q = np.linalg.solve(factor, body)
    data = spectra.white[model.disc] / root
    y = data - (np.swapaxes(q, 1, 2) @ (q.conj() @ data[..., None]))[..., 0]
    base = -float((data.conj() * y).sum().real) - 2 * float(np.log(root).sum())
    base -= float(np.log(np.einsum("fnn->fn", factor).real ** 2 * own).sum())

    def seen(places: Complex, heights: Floats) -> Complex:
        return np.asarray(whitener.apply(columns.reflectors(places, heights)) / root[:, None])

    turns = np.exp(2j * np.pi * np.arange(RING) / RING)
    places = np.concatenate([centre + r * turns for r, _ in rings])
    anywhere = complex(x[0], x[1]) + _grid(max(model.sheet(x).radius_m * 1.2, 0.05))
    w = seen(anywhere, np.zeros(len(anywhere)))
    power = spectra.moving[:, None] * powers.tag
    size = (np.abs(w) ** 2).sum(axis=2) - (np.abs(w @ np.swapaxes(q.conj(), 1, 2)) ** 2).sum(axis=2)
    right = (w.conj() @ y[..., None])[..., 0]
    gain = (np.abs(right) ** 2 / (1 / power + size) - np.log1p(power * size)).sum(axis=0)
    chosen = np.argsort(-gain)[:SPOTS]
    w = np.concatenate([seen(places, np.repeat([z for _, z in rings], RING)), w[:, chosen]], axis=1)
    # Tables of one place a block.
    held = (w @ np.swapaxes(q.conj(), 1, 2))[:, :, None]
    table = dense(w[:, :, None], w.conj() @ y[..., None], held, power[None, :, 0], base, len(rings), RING)
    spots = np.arange(len(places) + len(chosen), dtype=np.int32)
    level = np.repeat([z == 0 for _, z in rings], RING) & (spots[: len(places)] % 2 == 0)
    spots = np.concatenate([spots[: len(places)][level], spots[len(places) :]])
    return Beside(table, np.concatenate([places, anywhere[chosen]]), spots)


def _grid(radius_m: float) -> Complex:
    line = np.arange(-radius_m, radius_m + SPOT_M / 2, SPOT_M)
    places = (line[:, None] + 1j * line).ravel()
    return np.asarray(places[np.abs(places) <= min(radius_m, 1.5 * REACH_M)])


def anywhere(found: Beside, most: int, kept: int) -> list[tuple[float, NDArray[np.int32]]]:
    """The best sets of one to `most` reflectors anywhere, `kept` of each number: log evidence and indices."""
    places = found.places[found.spots]
    clear = np.abs(places[:, None] - places) >= CLOSEST_M
    sets = grown(found.table, found.spots, clear, clear, most, kept)
    return [(log, found.spots[chosen]) for log, chosen in sets]
