"""The fit of arrangements of alike reflectors beside round walls: places searched, amplitudes solved inside.

Per frequency, with the room subtracted from data and columns alike,

    Y = A echo(body) + g sum_k e_k + m sum_k h_k,

e_k and h_k the echoes of a reflector beside the wall as an electric and as a magnetic dipole
(`cylinder_patterns`). A, g and m are free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.compiled import RingedRows
from tagid.tags.bodies.cylinder_patterns import Paths, Patterns
from tagid.tags.bodies.reflectors_fit import Solved, solve
from tagid.tags.bodies.revolution import RoundBody
from tagid.tags.bodies.spectra import Spectra, centred

RADIUS_M = 4e-3
"""Standard deviation of a reflector's place about its nominal radius: mounting, and the wave's curvature."""
MOST_OFFSET_M = 8e-3
_STEPS_M, _STEP_RAD = 3e-4, 3e-3
"""Finite differences."""


@dataclass(frozen=True, eq=False)
class Ringed:
    """Alike reflectors around one centre beside one wall.

    Attributes:
        shell: index of the body in the family.
        centre: of body and reflectors, x + jy, m.
        offset_m: added to the radii.
        angles: (K,) directions of the reflectors, rad.
        radii: (K,) nominal distances from the centre, m.
        heights: (K,) above the object's plane, m.
        layout: name of the layout, which turns as a whole; None for reflectors whose angles are free.
        left: energy left.
    """

    shell: int
    centre: complex
    offset_m: float
    angles: NDArray[np.float64]
    radii: NDArray[np.float64]
    heights: NDArray[np.float64]
    layout: str | None
    left: float = np.inf


@dataclass(frozen=True, eq=False)
class _Many:
    """Arrangements side by side, padded to K reflectors.

    Attributes:
        rings: all of them.
        moves: (H, P, 3 + K) directions that the fit may take.
    """

    rings: RingedRows
    moves: NDArray[np.float64]

    @classmethod
    def of(cls, rows: Sequence[Ringed]) -> _Many:
        most = max(len(row.angles) for row in rows)
        at, moves = np.zeros((len(rows), 3 + most)), np.zeros((len(rows), 3 + most, 3 + most))
        radii, heights, present = (np.zeros((len(rows), most)) for _ in range(3))
        for i, row in enumerate(rows):
            k = len(row.angles)
            at[i, : 3 + k] = row.centre.real, row.centre.imag, row.offset_m, *row.angles
            radii[i], heights[i, :k], present[i, :k] = row.radii.mean(), row.heights, 1
            radii[i, :k] = row.radii
            moves[i, :3, :3] = np.eye(3)
            if row.layout is None:
                moves[i, 3 : 3 + k, 3 : 3 + k] = np.eye(k)
            else:
                moves[i, 3, 3 : 3 + k] = 1
        shells = np.array([row.shell for row in rows])
        return cls(RingedRows(shells, at, radii, heights, present), moves)


@dataclass(frozen=True, eq=False)
class _Left:
    """What arrangements leave.

    Attributes:
        rest: (H, F, V) of the data.
        energy: (H,) of it.
    """

    rest: NDArray[np.complex128]
    energy: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CylinderFitter:
    """Fits arrangements to spectra.

    Attributes:
        spectra: the scans.
        patterns: beside the bodies of a family, at the frequencies of the scans.
        body: of revolution.
        expected: centre about which reflectors and wall are expected, x + jy, m,
        spread_m: to within this standard deviation.
        variance: of one value's error in the fit.
        known: (F, V) echo of an enrolled body in its pose, in place of that of one of revolution; None for
            the latter.
    """

    spectra: Spectra
    patterns: Patterns
    body: RoundBody
    expected: complex
    spread_m: float
    variance: float
    known: NDArray[np.complex128] | None = None

    def body_echo(self, centres: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """(H, F, V) of the body below arrangements about centres x + jy (H,), m."""
        if self.known is not None:
            return np.broadcast_to(self.known, (len(centres), *self.known.shape))
        return self.body.echo(self.spectra, centres, np.zeros(len(centres)))

    def solved(self, rows: Sequence[Ringed]) -> Solved:
        """Amplitudes (H, F, 3) of the body and of the reflectors' dipoles, and what they leave."""
        return self._solved(_Many.of(rows).rings)

    def beside_other_walls(self, row: Ringed) -> Ringed:
        """The same arrangement beside the wall of its polarisation that leaves least."""
        polarisation = self.patterns.shells[row.shell].polarisation
        walls = enumerate(self.patterns.shells)
        same = np.array([i for i, one in walls if one.polarisation == polarisation])
        energy = self._left(_Many.of([row]).rings.beside(same)).energy
        best = int(np.argmin(energy))
        return replace(row, shell=int(same[best]), left=float(energy[best]))

    def fitted(self, rows: Sequence[Ringed], rounds: int = 4) -> list[Ringed]:
        """Levenberg-Marquardt on all arrangements at once; those that a round does not improve stay."""
        many = _Many.of(rows)
        at, moves = many.rings.at.copy(), many.moves
        steps = np.full(at.shape[1], _STEP_RAD)
        steps[:3] = _STEPS_M
        weight = np.zeros(at.shape[1])
        weight[:2], weight[2] = self.spread_m**-2, RADIUS_M**-2
        mean = np.zeros(at.shape[1])
        mean[:2] = self.expected.real, self.expected.imag
        along = moves * steps
        scale = 2 / self.variance
        now = self._left(many.rings)
        rest, left = now.rest, now.energy
        cost = scale * left + (at - mean) ** 2 @ weight
        damping = np.full(len(at), 1e-2)
        for _ in range(rounds):
            stepped = self._left(many.rings.moved(at[:, None] + along)).rest
            slopes = stepped.reshape(len(at), moves.shape[1], *rest.shape[1:]) - rest[:, None]
            slopes = slopes.reshape(len(at), moves.shape[1], -1).view(np.float64)
            error = rest.reshape(len(at), -1).view(np.float64)
            normal = scale * (slopes @ np.swapaxes(slopes, 1, 2))
            gradient = scale * (slopes @ error[..., None])[..., 0]
            normal = normal + (along * weight) @ np.swapaxes(along, 1, 2)
            gradient = gradient + ((along * weight) @ (at - mean)[..., None])[..., 0]
            size = np.diagonal(normal, axis1=1, axis2=2)
            load = damping[:, None] * size + np.where(size > 0, 1e-9 * size, 1.0)
            step = -np.linalg.solve(normal + load[..., None] * np.eye(size.shape[1]), gradient[..., None])
            trial = at + (np.swapaxes(along, 1, 2) @ step)[..., 0]
            trial[:, 2] = np.clip(trial[:, 2], -MOST_OFFSET_M, MOST_OFFSET_M)
            there = self._left(many.rings.moved(trial[:, None]))
            trial_cost = scale * there.energy + (trial - mean) ** 2 @ weight
            better = trial_cost < cost
            at[better], rest[better] = trial[better], there.rest[better]
            left[better], cost[better] = there.energy[better], trial_cost[better]
            damping = np.where(better, damping / 5, damping * 8)
        return [
            replace(
                row,
                centre=complex(at[i, 0], at[i, 1]),
                offset_m=float(at[i, 2]),
                angles=at[i, 3 : 3 + len(row.angles)].copy(),
                left=float(left[i]),
            )
            for i, row in enumerate(rows)
        ]

    def _left(self, rings: RingedRows) -> _Left:
        if rings.fits():
            return _Left(*rings.rest(self.spectra.tables, self.patterns.relative, self.known))
        solved = self._solved(rings)
        return _Left(solved.rest, solved.left)

    def echoes(self, row: Ringed) -> NDArray[np.complex128]:
        """(F, 2, V) of the reflectors of an arrangement as electric and as magnetic dipoles."""
        return self._columns(_Many.of([row]).rings)[0, :, 1:]

    def _solved(self, rings: RingedRows) -> Solved:
        return solve(self.spectra.data, self._columns(rings))

    def _columns(self, rings: RingedRows) -> NDArray[np.complex128]:
        """(H, F, 3, V) of the body and of the reflectors' dipoles, without the room."""
        centres = np.asarray(rings.at[:, 0] + 1j * rings.at[:, 1])
        echo = self.body_echo(centres)
        radii = rings.radii + rings.at[:, 2:3]
        paths = Paths.of(self.spectra, centres, radii, rings.at[:, 3:], rings.heights)
        each = self.patterns.columns(paths, rings.shells)
        electric, magnetic = (each * rings.present[:, None, :, None]).sum(axis=3)
        return centred(np.stack([echo, electric, magnetic], axis=2))
