"""Reflectors before a round wall, by the exact fields around a cylinder.

A small reflector answers the electric and the magnetic field of a wave, and by reciprocity the echo takes the
same ways back (`tagid.fields.shells.echoes`). Beside a known wall two amplitudes per frequency are left; a
class of walls of any radius, thickness and permittivity has the principal patterns of all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from tagid.fields.shells import Shell, echoes
from tagid.reading.transfers.transfer import ANGLES, Tables, Transfer, aspects, principal

GAP_M, STEP_M = (6e-3, 28e-3), 2.5e-3
"""From the wall to the reflectors' centres, m, and step between the members of a class."""
SMALLEST = 0.4
"""Radius of the smallest body, over that of the reflectors' ring."""
STRENGTHS = ((0.5, 0.2), (0.2, 0.3))
"""Covariance of the strengths of both dipoles, electric first; a small metal sphere has them as 2 to 1."""
RADIUS_SD_M = 4e-3
"""A ring that is glued to a body stands where the body's wall is."""


def gaps(radius_m: float) -> NDArray[np.float64]:
    """Distances from reflectors on a ring to the walls that may stand inside, m."""
    nearest = min(GAP_M[0], 0.2 * radius_m)
    farthest = max(min(GAP_M[1], (1 - SMALLEST) * radius_m), nearest)
    return np.linspace(nearest, farthest, int((farthest - nearest) / STEP_M) + 1)


@dataclass(frozen=True)
class Walls:
    """A class of walls.

    Attributes:
        wall_m, permittivity: of the members; thickness 0 is bare metal.
        metal: there is metal, or water, inside the wall.
        polarisation: of the radar, "V" along the axis or "H" across it.
    """

    wall_m: tuple[float, ...]
    permittivity: tuple[float, ...]
    metal: bool = False
    polarisation: str = "V"

    def shells(self, radius_m: float) -> list[Shell]:
        """Bodies that may carry reflectors at a distance from the axis, m."""
        every = product(gaps(radius_m), self.wall_m, self.permittivity)
        return [
            Shell(float(radius_m - gap), thick, permittivity, self.metal, self.polarisation)
            for gap, thick, permittivity in every
        ]


def beside(shells: Callable[[float], Sequence[Shell]], terms: int) -> Tables:
    """Tables of reflectors beside bodies that depend on the radius of their ring, m."""
    # A pattern is the same to either side.
    psi, mix = aspects()[: ANGLES // 2 + 1], np.linalg.cholesky(np.array(STRENGTHS))

    def table(kappa: NDArray[np.float64], radius_m: float) -> NDArray[np.complex128]:
        k = kappa / 2
        free = np.exp(2j * k[:, None] * radius_m * np.cos(psi))
        both = echoes(k, shells(radius_m), radius_m, psi) / free
        mixed = np.sqrt(2) * np.tensordot(mix.T, both, 1)
        half = principal(mixed.reshape(-1, *mixed.shape[2:]), terms)
        return np.concatenate([half, half[..., -2:0:-1]], axis=2)

    return table


def wall(name: str, words: str, walls: Walls, terms: int) -> Transfer:
    """The transfer of a class of walls."""
    name = f"{name}, {walls.polarisation}"
    return Transfer(name, words, True, (1.0,) * terms, beside(walls.shells, terms), RADIUS_SD_M)


METAL = Walls((0.0,), (1.0,), True)
GLASS = Walls((2e-3, 3e-3, 4.2e-3), (4.0, 5.5, 7.5))
PLASTIC = Walls((0.8e-3, 1.6e-3, 2.5e-3, 3.5e-3), (2.5,))
WALLS = tuple(
    one
    for polarisation in ("V", "H")
    for one in (
        wall("metal", "metal or a filled vessel", replace(METAL, polarisation=polarisation), 3),
        wall("glass", "a wall of glass or ceramic", replace(GLASS, polarisation=polarisation), 5),
        wall("plastic", "a wall of plastic", replace(PLASTIC, polarisation=polarisation), 3),
    )
)
