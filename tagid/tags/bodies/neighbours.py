"""Whether neighbours in place of a layout's reflectors explain the echo before a wall as well.

With a pattern that is free in every frequency, two neighbours on either side of a reflector imitate it, and
it imitates them: a common pattern of a few terms and a pair of places hold nearly the same echoes. What tells
them apart is which patterns a reflector before a wall can have (`wall`). The layout and the neighbours that
imitate it are fitted with these patterns alone, the same number of amplitudes for all; radius, distance
from the wall and its material are searched for each, by either polarisation. Where the echo is polarised
upright, free patterns of three terms hold a reflector on metal to 0.1 %, so that neighbours that explain it
as well are no artefact of them: the layout is ahead only where horizontal patterns do as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.body_reading import BodySettings, Placed
from tagid.tags.bodies.reflectors_fit import COMMON, Batch, Columns, Fitter, Linear, joined, solve
from tagid.tags.bodies.wall import METAL, SERIES, TERMS, Material, Wall, series

RADII_M = (-0.010, -0.004, 0.002, 0.008, 0.016)
"""Of the ring about the layout's nominal radius: a reflector stands where its body has a wall."""
GAPS_M = (0.009, 0.013, 0.018)
MATERIALS = (METAL, Material(0.004, 7.0), Material(0.004, 4.0), Material(0.003, 3.0), Material(0.002, 2.5))
"""Metal, porcelain, ceramic, thin ceramic or glass, and plastic."""
LEAST_GAP_M, MOST_GAP_M = 0.004, 0.026
STEP_M = 3e-3
REACH_M = 4e-3
"""The ring's radius moves so far from that of the pattern."""
KEPT = 1
"""Walls of each polarisation from which an arrangement is fitted."""
SAME_RAD = float(np.deg2rad(4.0))
"""Arrangements whose reflectors differ by less are the same."""


@dataclass(frozen=True, eq=False)
class WalledFitter(Fitter):
    """A fitter of reflectors before walls.

    Attributes:
        patterns: (H, F, TERMS, SERIES) of every row of a batch, see `wall.series`.
    """

    patterns: NDArray[np.complex128] = field(
        default_factory=lambda: np.zeros((0, 0, TERMS, SERIES), np.complex128)
    )

    @classmethod
    def like(cls, fitter: Fitter, walls: Sequence[Wall]) -> WalledFitter:
        """A fitter of the same spectra and body, one wall for each row."""
        patterns = series(fitter.spectra.wavenumbers, walls)
        return cls(
            fitter.spectra, fitter.body, fitter.priors, fitter.variance, fitter.body_at, patterns=patterns
        )

    def left(self, batch: Batch) -> NDArray[np.float64]:
        """(H,) energy left at the places of a batch."""
        return solve(self.spectra.data, self._walled(self.plain(batch))).left

    def plain(self, batch: Batch) -> Columns:
        """Columns of the cosines that the patterns are made of."""
        wide = replace(batch, tilt=0 * batch.tilt, terms=0 * batch.terms + SERIES)
        return Columns.of(self.spectra, self.body, wide)

    def _walled(self, plain: Columns) -> NDArray[np.complex128]:
        values = plain.values
        return np.concatenate([values[:, :, :1], self.patterns @ values[:, :, 1:]], axis=2)

    def _linear(self, batch: Batch) -> Linear:
        plain = self.plain(batch)
        columns = self._walled(plain)
        solved = solve(self.spectra.data, columns)
        body, own = solved.amplitudes[:, :, :1], solved.amplitudes[:, :, None, 1:]
        cosines = np.concatenate([body, (own @ self.patterns)[:, :, 0]], axis=2)
        wide = replace(batch, tilt=0 * batch.tilt)
        return self._along(wide, plain, replace(solved, amplitudes=cosines), columns)


def led_before_wall(
    fitter: Fitter, best: Placed, split: Sequence[Placed], tag: float, settings: BodySettings
) -> bool:
    """Whether a layout on an enrolled body leaves less before a wall than neighbours in its place.

    Args:
        fitter: of the spectra and the body.
        best: the layout where it was found; false where it is as wide as a shell, which has no round wall.
        split: arrangements that have neighbours in place of its reflectors, best first.
        tag: energy that the layout explains.
        settings: see `BodySettings`.
    """
    nominal = float(best.batch.radii[0][best.batch.present[0] > 0].mean())
    if nominal >= settings.wide_m:
        return False
    others: list[Placed] = []
    for placed in split:
        if len(others) < settings.neighbours and all(placed.apart_rad(o) > SAME_RAD for o in others):
            others.append(placed)
    lefts = lefts_before_walls(fitter, [best.batch, *(_loosened(o.batch) for o in others)], nominal)
    upright, horizontal = lefts[0]
    if horizontal - upright > settings.upright_share * tag:
        return False
    return float(lefts[0].min()) < float(lefts[1:].min())


def _loosened(row: Batch) -> Batch:
    """One row with every angle free; its centre, its radius and the body's pose are."""
    width = row.radii.shape[1]
    present = COMMON + np.flatnonzero(row.present[0])
    return replace(row, moves=np.eye(COMMON + width)[None, [*range(COMMON), *present]])


def lefts_before_walls(
    fitter: Fitter, arrangements: Sequence[Batch], nominal_m: float
) -> NDArray[np.float64]:
    """(A, 2) energies that arrangements leave before the wall that suits each best, upright and horizontal.

    Args:
        fitter: of the spectra and the body.
        arrangements: one row each, with how it may move.
        nominal_m: radius of the layout's ring, m.
    """
    rows = joined(list(arrangements))
    count = len(rows.at)
    thin = fitter.spectra.thinned(2)
    which, walls = _first_walls(replace(fitter, spectra=thin), rows, nominal_m)
    rows = rows.some(which)
    batch, left = _fitted(fitter, rows, walls, 4)
    for change in (_wider, _narrower, _outer, _inner, _denser, _thinner):
        new = [change(wall) for wall in walls]
        moved, found = _fitted(fitter, batch, new, 2)
        better = found < left
        walls = [b if ok else a for a, b, ok in zip(walls, new, better, strict=True)]
        batch = batch.moved(np.where(better[:, None], moved.at, batch.at))
        left = np.where(better, found, left)
    left = np.minimum(left, _fitted(fitter, batch, walls, 4)[1])
    return np.asarray(left.reshape(count, 2, KEPT).min(axis=2))


def _first_walls(fitter: Fitter, rows: Batch, nominal_m: float) -> tuple[NDArray[np.intp], list[Wall]]:
    """Rows and walls to begin with: the best of each polarisation for every row."""
    spectra, count = fitter.spectra, len(rows.at)
    lefts: list[NDArray[np.float64]] = []
    walls: list[Wall] = []
    for offset in RADII_M:
        some = [
            Wall(horizontal, nominal_m + offset, gap, material)
            for horizontal in (False, True)
            for gap in GAPS_M
            for material in MATERIALS
        ]
        begun = _before(rows, some[:1] * count)
        plain = WalledFitter.like(fitter, some[:1]).plain(begun).values
        # (W, H, F, C, V)
        walled = series(spectra.wavenumbers, some)[:, None] @ plain[:, :, 1:]
        body = np.broadcast_to(plain[:, :, :1], (*walled.shape[:3], 1, walled.shape[4]))
        columns = np.concatenate([body, walled], axis=3)
        left = solve(spectra.data, columns.reshape(-1, *columns.shape[2:])).left
        lefts.append(left.reshape(len(some), count))
        walls += some
    found = np.concatenate(lefts)
    which: list[int] = []
    chosen: list[Wall] = []
    for i in range(count):
        for horizontal in (False, True):
            order = [int(w) for w in np.argsort(found[:, i]) if walls[int(w)].horizontal == horizontal]
            which += [i] * KEPT
            chosen += [walls[w] for w in order[:KEPT]]
    return np.array(which), chosen


def _fitted(
    fitter: Fitter, rows: Batch, walls: Sequence[Wall], rounds: int
) -> tuple[Batch, NDArray[np.float64]]:
    """Rows before walls, moved to where they leave least."""
    return WalledFitter.like(fitter, walls).fitted(_before(rows, walls), rounds)


def _before(rows: Batch, walls: Sequence[Wall]) -> Batch:
    """Rows on the rings of walls; where a row was fitted, it keeps its radius as far as it may."""
    radius = np.array([wall.radius_m for wall in walls])
    at = rows.at.copy()
    offset = rows.radii[:, 0] + at[:, 2] - radius
    at[:, 2] = np.where(np.abs(offset) <= REACH_M, offset, 0.0)
    one = np.ones(len(radius))
    return replace(
        rows,
        at=at,
        radii=radius[:, None] * rows.present,
        tilt=0 * one,
        terms=TERMS * one,
        low=-REACH_M * one,
        high=REACH_M * one,
        prior_radius=0 * one,
    )


def _wider(wall: Wall) -> Wall:
    return replace(wall, gap_m=min(wall.gap_m + STEP_M, MOST_GAP_M))


def _narrower(wall: Wall) -> Wall:
    return replace(wall, gap_m=max(wall.gap_m - STEP_M, LEAST_GAP_M))


def _outer(wall: Wall) -> Wall:
    return replace(wall, radius_m=wall.radius_m + STEP_M)


def _inner(wall: Wall) -> Wall:
    return replace(wall, radius_m=wall.radius_m - STEP_M)


def _denser(wall: Wall) -> Wall:
    return replace(wall, material=MATERIALS[max(MATERIALS.index(wall.material) - 1, 0)])


def _thinner(wall: Wall) -> Wall:
    return replace(wall, material=MATERIALS[min(MATERIALS.index(wall.material) + 1, len(MATERIALS) - 1)])
