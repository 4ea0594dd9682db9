"""Reflectors before a round wall, by the exact fields around a cylinder.

A small reflector answers the electric and the magnetic field of a wave, and by reciprocity the echo takes the
same ways back (`tagid.fields.shells.echoes`). Beside a known wall two amplitudes per frequency are left; a
class of walls of any radius, thickness and permittivity has the principal patterns of all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from tagid.fields.shells import Shell, orders, reflection, responses
from tagid.reading.transfers.transfer import ANGLES, MIDDLE_M, Tables, Transfer, aspects, principal

GAP_M, STEP_M = (6e-3, 28e-3), 3e-3
"""From the wall to the reflectors' centres, m, and step between the radii of the members of a class."""
SMALLEST = 0.4
"""Radius of the smallest body, over that of the reflectors' ring."""
STRENGTHS = ((0.5, 0.2), (0.2, 0.3))
"""Covariance of the strengths of both dipoles, electric first; a small metal sphere has them as 2 to 1."""
RADIUS_SD_M = 4e-3
"""A ring that is glued to a body stands where the body's wall is."""
_FAR_M = 0.14
"""The fields of the members are found at once for rings up to multiples of this."""

Field = NDArray[np.complex128]


@dataclass(frozen=True)
class Walls:
    """A class of walls.

    Attributes:
        wall_m, permittivity: of the members; thickness 0 is bare metal.
        metal: there is metal, or water, inside the wall.
        clear: the waves pass the wall as if it were not there.
        filling: relative permittivities of what fills the wall where there is no metal.
    """

    wall_m: tuple[float, ...]
    permittivity: tuple[float, ...]
    metal: bool = False
    clear: bool = False
    filling: tuple[float, ...] = (1.0,)

    def shells(self, radius_m: float, polarisation: str) -> list[Shell]:
        """The members of a radius, m."""
        every = product(self.wall_m, self.permittivity, self.filling)
        return [
            Shell(radius_m, thick, permittivity, self.metal, polarisation, filling)
            for thick, permittivity, filling in every
        ]

    def table(self, polarisation: str, terms: int) -> Tables:
        """Tables of reflectors beside a member of any radius that may carry them."""

        def table(kappa: NDArray[np.float64], radius_m: float) -> Field:
            if self.clear and radius_m <= MIDDLE_M:
                # The first pattern is that of all members in front, up to what the walls change.
                middle = np.zeros((terms, len(kappa), ANGLES), dtype=np.complex128)
                middle[0] = np.sqrt(np.sum(STRENGTHS))
                return middle
            k = kappa / 2
            rings = int(np.ceil(radius_m / _FAR_M))
            radii, either = _coefficients(k.tobytes(), self, rings)
            coefficients = either["VH".index(polarisation)]
            inside = (radii >= radius_m - farthest_m(radius_m)) & (radii <= radius_m - nearest_m(radius_m))
            if not inside.any():
                inside[np.argmin(np.abs(radii - radius_m + nearest_m(radius_m)))] = True
            some = coefficients[inside].reshape(-1, *coefficients.shape[2:])
            electric = np.full(len(some), polarisation == "V")
            return patterns(k, some[..., : orders(k, radius_m) + 1], electric, radius_m, terms)

        return table


def nearest_m(radius_m: float) -> float:
    """From reflectors on a ring to the nearest wall that may stand inside, m."""
    return min(GAP_M[0], 0.2 * radius_m) - 1e-6


def farthest_m(radius_m: float) -> float:
    """From reflectors on a ring to the farthest wall, m."""
    return min(GAP_M[1], (1 - SMALLEST) * radius_m) + 1e-6


@lru_cache(maxsize=16)
def _coefficients(wavenumber: bytes, walls: Walls, rings: int) -> tuple[NDArray[np.float64], Field]:
    """Radii (R,), m, and coefficients (2, R, S, F, N) of the members for V and H; see `reflection`."""
    k, reach_m = np.frombuffer(wavenumber), rings * _FAR_M
    radii = np.arange(STEP_M, reach_m - STEP_M, STEP_M)
    radii = radii[radii > max(walls.wall_m) + 1e-3]
    shells = [shell for p in "VH" for radius in radii for shell in walls.shells(float(radius), p)]
    coefficients = reflection(k, shells, orders(k, reach_m))
    return radii, coefficients.reshape(2, len(radii), -1, *coefficients.shape[1:])


def patterns(
    wavenumber: NDArray[np.float64],
    coefficients: Field,
    electric: NDArray[np.bool_],
    radius_m: float,
    terms: int,
) -> Field:
    """(terms, F, ANGLES) principal patterns beside equally likely bodies; arguments of `responses`."""
    # A response holds twice the orders of the field, and is the same to either side.
    steps = 2 * coefficients.shape[2]
    both = responses(wavenumber, coefficients, electric, radius_m, np.pi * np.arange(steps + 1) / steps)
    mixed = np.sqrt(2) * np.tensordot(np.linalg.cholesky(np.array(STRENGTHS)).T, both, 1)
    once = np.sqrt(np.where(np.arange(steps + 1) % steps, 1.0, 0.5))
    averaged = principal(mixed.reshape(-1, *mixed.shape[2:]) * once, terms) / once
    psi = aspects()[: ANGLES // 2 + 1]
    late = np.exp(-2j * wavenumber[:, None] * radius_m * np.cos(psi))
    half = averaged @ _between(steps) * late
    return np.concatenate([half, half[..., -2:0:-1]], axis=2)


@lru_cache(maxsize=64)
def _between(steps: int) -> NDArray[np.float64]:
    """(steps + 1, ANGLES / 2 + 1) from angles pi i / steps to those of a table, by cosines."""
    i = np.arange(steps + 1)
    once = np.where(i % steps, 1.0, 0.5)
    forward = 2 / steps * once[:, None] * np.cos(np.pi / steps * np.outer(i, i)) * once
    return np.asarray(forward @ np.cos(np.outer(i, aspects()[: ANGLES // 2 + 1])))


def wall(name: str, words: str, walls: Walls, terms: int, polarisation: str = "V") -> Transfer:
    """The transfer of a class of walls to a radar of polarisation "V", along the axis, or "H", across it."""
    name = f"{name}, {polarisation}"
    table = walls.table(polarisation, terms)
    return Transfer(name, words, True, (1.0,) * terms, table, RADIUS_SD_M, clear=walls.clear)


METAL = Walls((0.0,), (1.0,), True)
GLASS = Walls((2e-3, 3e-3, 4.2e-3), (4.0, 5.5, 7.5))
PLASTIC = Walls((0.8e-3, 1.6e-3, 2.5e-3, 3.5e-3), (2.5,), clear=True)
WALLS = tuple(
    coated
    for polarisation in ("V", "H")
    for coated in (
        wall("metal", "metal or a filled vessel", METAL, 3, polarisation),
        wall("glass", "a wall of glass or ceramic", GLASS, 5, polarisation),
        wall("plastic", "a wall of plastic", PLASTIC, 3, polarisation),
    )
)
