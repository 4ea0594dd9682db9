"""A thin sheet as the body: its echo, and reflectors that are seen through its field.

A helmet's shell, the walls of a carton, a cup or a can, not enrolled (`tagid.fields.thin_shell`). The sheet
returns one column per power of the cosine of incidence, a small reflector the square of the field at its
place. Odd scatterers do the same, or are seen past the sheet: what stands far beside it, or over it. The
parameters of a model begin with those of the sheet: its centre x, y, its turn, and the logarithms of two half
sizes and of its strength over those of the population. Those of `tagid.reading.columns.Model` follow; their
centre is that of the tag about the sheet's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import exp
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.fields.thin_shell import (
    BoxShell,
    EllipticShell,
    ShellField,
    ShellView,
    ThinShell,
    line_source_table,
)
from tagid.loops import loop
from tagid.reading.arrangement import MOUNTING_SD_M
from tagid.reading.columns import CLOSE_SD_M, Model
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.plain import POINTS
from tagid.reading.transfers.transfer import Transfer
from tagid.types import Complex, Floats

_sheet = loop("tagid.reading._sheet")

OBLIQUITIES = 3
"""Columns of a sheet, see `ShellView.echoes`."""
THIN_M, CERAMIC_M, METAL_M, STRENGTH_SD = 2.8e-3, 10e-3, 1.0, 0.25
"""(eps - 1) d of thin sheets, of cups and of metal, m, and the standard deviation of their logarithms. A
sheet that ends above and below acts as half of what it is. 1 m leaves 3e-4 of the echo of a metal box."""
CLEAR_M = 6e-3
"""No centre of a reflector lies nearer to a sheet, m."""
HALF_M = (0.012, 0.3)
"""Half sizes lie between these, m."""
WEAKEST = 1.5
"""Logarithm of a strength over its mean, at most and at least."""
HEAD = 6
"""Parameters of the sheet."""
CELL_M = 11e-3
"""Cells of the contour: a fifth of the shortest wavelength; 8 mm give the same evidence to 1 nat."""
_STEP = np.array([1e-6, 1e-6, 1e-5, 1e-5, 1e-5, 1e-4])
"""Finite differences of the sheet's parameters; of a place it is the first."""


STEP = 1.05
"""Between half sizes that are searched."""


@dataclass(frozen=True, eq=False)
class Kind:
    """A population of sheets.

    Attributes:
        transfer: name and words.
        shell: its class.
        size_m: mean half size, m; size_sd: standard deviation of its logarithm.
        tag_sd_m: standard deviation of a tag's centre about the sheet's, m.
        sizes_m: half sizes that are searched, m.
        strength_m: mean (eps - 1) d, m.
        tagged_m: radii at which reflectors are looked for about it, m, where its own echo hardly tells one.
    """

    transfer: Transfer
    shell: type[ThinShell]
    size_m: float
    size_sd: float
    tag_sd_m: float
    sizes_m: tuple[float, ...]
    strength_m: float
    tagged_m: tuple[float, ...] = ()


def _transfer(name: str, words: str, clear: bool = False) -> Transfer:
    return Transfer(name, words, True, (1.0,), POINTS.table, clear=clear)


def _sizes(least_m: float, count: int) -> tuple[float, ...]:
    return tuple(least_m * STEP**i for i in range(count))


SHELL = Kind(
    _transfer("shell", "a thin shell", True), EllipticShell, 0.072, 0.22, 3e-3, _sizes(0.05, 15), THIN_M
)
BOX = Kind(
    _transfer("box", "a box of thin walls", True), BoxShell, 0.063, 0.5, 10e-3, _sizes(0.025, 35), THIN_M
)
METAL = Kind(_transfer("metal box", "a box of metal"), BoxShell, 0.055, 0.5, 3e-3, _sizes(0.02, 39), METAL_M)
CAN = Kind(
    _transfer("metal can", "a body of metal"),
    EllipticShell,
    size_m=0.036,
    size_sd=0.35,
    tag_sd_m=MOUNTING_SD_M,
    sizes_m=_sizes(0.02, 22),
    strength_m=METAL_M,
    tagged_m=(0.032, 0.04),
)
CUP = Kind(
    _transfer("cup", "a cup", True), EllipticShell, 0.037, 0.25, MOUNTING_SD_M, _sizes(0.025, 15), CERAMIC_M
)
KINDS = (SHELL, BOX, METAL, CAN, CUP)


@dataclass(frozen=True, eq=False)
class SheetModel(Model):
    """A hypothesis with a sheet.

    Attributes:
        kind: of the sheet.
        cells: of its contour.
    """

    kind: Kind = SHELL
    cells: int = 72

    @classmethod
    def of(cls, kind: Kind, half_m: tuple[float, float], disc: int) -> SheetModel:
        """An untagged one about so large."""
        around = 4 * sum(half_m) if kind.shell is BoxShell else np.pi * sum(half_m)
        cells = max(8 * round(around / CELL_M / 8), 48)
        return cls(kind.transfer, None, True, disc, kind=kind, cells=cells)

    @property
    def body_parameters(self) -> int:
        return HEAD

    @property
    def shapes(self) -> int:
        """None: the sheet has its own."""
        return 0

    @property
    def lifts(self) -> int:
        """A sheet's reflectors stand as they were enrolled."""
        return 0

    @property
    def body_columns(self) -> int:
        return OBLIQUITIES

    @property
    def columns(self) -> int:
        return OBLIQUITIES + (self.tag is not None) + self.unlike + self.odd

    @property
    def past(self) -> NDArray[np.bool_]:
        """(odd,) whether an odd scatterer is seen past the sheet."""
        return np.array([face is not None for face in self._faces], dtype=bool)

    def sheet(self, x: Floats) -> ThinShell:
        """The sheet about its own centre and axes."""
        kind = self.kind
        across, along = (min(max(kind.size_m * exp(min(size, 9.0)), HALF_M[0]), HALF_M[1]) for size in x[3:5])
        return kind.shell(across, along, kind.strength_m * exp(min(max(x[5], -WEAKEST), WEAKEST)))

    def shape(self, x: Floats) -> Floats:
        """(6,) half sizes and strength, m, and their slopes over their parameters, over the strength."""
        sheet = self.sheet(x)
        inside = [HALF_M[0] < half < HALF_M[1] for half in (sheet.across_m, sheet.along_m)]
        slopes = sheet.across_m * inside[0], sheet.along_m * inside[1], float(abs(x[5]) < WEAKEST)
        return np.array([sheet.across_m, sheet.along_m, sheet.sheet_m, *slopes])

    def power(self, moving: Floats, body: float, tag: float, oval: float) -> Floats:
        """(F, n) prior variances of the amplitudes; oval: of the obliquities."""
        rest = super().power(moving, body, tag, oval)[:, 3:]
        body_powers = body * np.array([1.0] + [oval] * (OBLIQUITIES - 1))
        return np.asarray(np.concatenate([moving[:, None] * body_powers, rest], axis=1))

    def _sds(self) -> Floats:
        size, rest = self.kind.size_sd, super()._sds()
        rest[:2] = self.kind.tag_sd_m
        turn = 2 * np.pi / np.sqrt(12)
        return np.concatenate([[self.priors.centre_m] * 2, [turn, size, size, STRENGTH_SD], rest])

    @cached_property
    def _normal(self) -> NDArray[np.bool_]:
        return np.concatenate([[True, True, False, True, True, True], super()._normal])

    def _log_prior(self, x: Floats) -> tuple[float, Floats, Floats]:
        """See `Model`: four turns and exchanges of axes are one sheet."""
        log, slope, hessian = super()._log_prior(x)
        return log + float(np.log(4 / (2 * np.pi))), slope, hessian

    def crowding(self, x: Floats) -> Floats:
        """See `Model`: no reflector stands in the sheet, and nothing inside metal, where it is not seen."""
        points = self.positions(x)
        if not self.transfer.clear:
            points = np.concatenate([points, self._spots(x)[..., ~self.past]], axis=-1)
        halves = np.clip(self.kind.size_m * np.exp(np.minimum(x[..., 3:5], 9.0)), *HALF_M)
        sheets: Any = SimpleNamespace(across_m=halves[..., :1], along_m=halves[..., 1:])
        outside = self.kind.shell.outside_m(sheets, in_frame(x, points))
        if self.transfer.clear:
            outside = np.abs(outside)
        return np.concatenate([super().crowding(x), np.maximum(CLEAR_M - outside, 0) / CLOSE_SD_M], axis=-1)

    def at(self, spectra: Spectra, x: Floats, slopes: bool = True) -> SheetColumns:
        return SheetColumns(self, spectra, x)


@dataclass(frozen=True, eq=False)
class SheetColumns:
    """Columns of a sheet and its reflectors at some parameters."""

    model: SheetModel
    spectra: Spectra
    x: Floats

    def _compiled(self, slopes: bool) -> tuple[Complex, Complex]:
        """Columns and rates by the compiled loop; without slopes the rates are empty."""
        spectra, model = self.spectra, self.model
        shape = (len(spectra.kappa), model.columns, spectra.views)
        values = np.empty(shape, dtype=np.complex128)
        rates = np.empty((len(self.x), *shape) if slopes else 0, dtype=np.complex128)
        before, after = _handed(spectra, model)
        x = np.ascontiguousarray(self.x, dtype=np.float64)
        aspects = quadrant(spectra.kappa, model.sheet(x))
        past = model.past.astype(np.int64)
        _sheet.columns(*before, x, model.shape(x), values, past, rates, *after, aspects)
        return values, rates

    @cached_property
    def _field(self) -> ShellField:
        return ShellField.of(self.spectra.kappa / 2, self.model.sheet(self.x), self.model.cells)

    @cached_property
    def view(self) -> ShellView:
        """The sheet from all antennas."""
        return self._field.seen_from(in_frame(self.x, self.spectra.antenna))

    def reflectors(self, positions: Complex, heights: Floats) -> Complex:
        """(F, K, V) echoes of small reflectors at places x + jy, m."""
        return _reflectors(self.view, self.spectra, self.x, positions, heights)

    @cached_property
    def values(self) -> Complex:
        return self._seen(self.view, self.x) if _sheet is None else self._compiled(False)[0]

    def _seen(self, view: ShellView, x: Floats) -> Complex:
        model = self.model
        odd = model.split(x)[3]
        echoes = view.echoes(OBLIQUITIES)
        parts = [echoes / np.sqrt((np.abs(echoes[:, :1]) ** 2).mean(axis=2, keepdims=True))]
        if model.tag is not None:
            seen = _reflectors(view, self.spectra, x, model.positions(x), model.tag.height_m)
            parts += [seen.sum(axis=1, keepdims=True), *([seen] if model.unlike else [])]
        if len(odd):
            parts.append(self._odd(view, x, odd))
        return np.concatenate(parts, axis=1)

    def _odd(self, view: ShellView, x: Floats, odd: Complex) -> Complex:
        """(F, odd, V) echoes of the odd scatterers at places x + jy, m."""
        waves, _ = self.spectra.waves(odd, np.zeros(len(odd)))
        there = ~self.model.past
        waves[:, there] *= view.relative(in_frame(x, odd[there]))
        return np.asarray(waves * self.model.windows(self.spectra.direction))

    @cached_property
    def expanded(self) -> tuple[Complex, Complex]:
        """(F, n, V) columns and their (P, F, n, V) slopes."""
        return (self.values, self._rates()) if _sheet is None else self._compiled(True)

    def _rates(self) -> Complex:
        model, spectra, x = self.model, self.spectra, self.x
        out = np.zeros((len(x), *self.values.shape), dtype=np.complex128)
        for i in range(HEAD):
            there = x.copy()
            there[i] += _STEP[i]
            sheet = self if i < 3 else SheetColumns(model, spectra, there)
            seen = self._seen(sheet._field.seen_from(in_frame(there, spectra.antenna)), there)
            out[i] = (seen - self.values) / _STEP[i]
        centre, turn, _, odd = model.split(x)
        step = float(_STEP[0])
        if model.tag is not None:
            tag, positions = model.tag, model.positions(x)
            near = np.concatenate([positions, positions + step, positions + 1j * step])
            seen = self.reflectors(near, np.tile(tag.height_m, 3))
            here, right, up = np.split(seen, 3, axis=1)
            along_x, along_y = (right - here) / step, (up - here) / step
            first = model.head
            outward = np.exp(1j * (tag.angle + turn[tag.turn]))
            for i in range(tag.count):
                for row, way in (
                    (HEAD, 1.0 + 0j),
                    (HEAD + 1, 1j),
                    (first + tag.turn[i], 1j * (positions[i] - centre)),
                    (first + tag.turns + tag.stretch[i], outward[i]),
                ):
                    moved = along_x[:, i] * way.real + along_y[:, i] * way.imag
                    out[row, :, OBLIQUITIES] += moved
                    if model.unlike:
                        out[row, :, OBLIQUITIES + 1 + i] += moved
        for i in range(len(odd)):
            row, column = len(x) - 2 * len(odd) + 2 * i, i - len(odd)
            for axis, way in enumerate((step, 1j * step)):
                moved = self._odd(self.view, x, odd + way)[:, i] - self.values[:, column]
                out[row + axis, :, column] = moved / step
        return out

    def slopes(self, weights: Complex) -> Complex:
        return np.asarray((self.expanded[1] * weights).sum(axis=2))


@lru_cache(maxsize=8)
def _handed(spectra: Spectra, model: SheetModel) -> tuple[tuple[object, ...], tuple[object, ...]]:
    """What the compiled loop takes before and after the parameters."""
    table, first, step = line_source_table()
    unit = model.kind.shell(1.0, 1.0, 1.0).outline(model.cells).contour[: model.cells // 4]
    k = 0 if model.tag is None else model.tag.count
    tag, groups = np.zeros((3, k)), np.zeros((2, k), dtype=np.int64)
    if model.tag is not None:
        tag[:] = model.tag.radius_m, model.tag.angle, model.tag.height_m
        groups[:] = model.tag.turn, model.tag.stretch
    place = np.stack([spectra.antenna.real, spectra.antenna.imag, spectra.height_m])
    views = np.concatenate([place, model.windows(spectra.direction)])
    away = float(np.abs(spectra.antenna).mean())
    before = views, spectra.kappa / 2, np.stack([unit.real, unit.imag]), table, tag, groups
    is_round = int(model.kind.shell is EllipticShell)
    return before, (spectra.distance_m, away, first, step, is_round, model.odd)


def in_frame(x: Floats, points: Complex) -> Complex:
    """Points (.., N), x + jy, m, about the centre and axes of a sheet of parameters (.., P)."""
    return np.asarray((points - (x[..., :1] + 1j * x[..., 1:2])) * np.exp(-1j * x[..., 2:3]))


def quadrant(kappa: Floats, shell: ThinShell) -> int:
    """Aspects of a quadrant that hold all harmonics of a sheet's echo, which are even."""
    orders = kappa[-1] * shell.radius_m
    return int(np.ceil((orders + 2 * orders ** (1 / 3) + 2) / 2))


def _reflectors(view: ShellView, spectra: Spectra, x: Floats, positions: Complex, heights: Floats) -> Complex:
    direct, _ = spectra.waves(positions, heights)
    return np.asarray(direct * view.relative(in_frame(x, positions)))
