"""What a reflector beside a round wall returns, for walls of every size and material that may be there.

Where the pattern of a reflector on a body is free, three to five complex amplitudes per frequency, two
reflectors imitate four. But the wall's own waves fix the pattern. A reflector of octahedral symmetry answers
the electric and the magnetic field alike from all sides, so that beside a known wall two amplitudes per
frequency are left, its electric and its magnetic strength. In free space the two add up to one. A wall that
reverses one field doubles the other: the electric dipole alone leaves 0.4 to 3 % of full-wave tags on
cans and cups, 3 to 15 % on thick glass, both together 0.2 to 2 % and 1 to 9 %.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from tagid.fields.shells import Shell, echoes
from tagid.tags.bodies.spectra import Spectra

DIPOLES = 2
"""Electric and magnetic."""
ANGLES = 256
"""Angles of a table, between which patterns are interpolated: to 0.5 % of their steepest part."""
LEAST_M, STEP_M, CLEAR_M = 0.018, 2e-3, 4.5e-3
"""Radius of the smallest body and steps to the largest, which the reflectors' centres clear by so much."""
FARTHEST_M = 0.035
"""No reflector stands farther outside the wall that carries it."""
COATED = (3.5e-3, 5.5)
"""A wall around water, which is nearly metal: its thickness, m, and permittivity."""


@dataclass(frozen=True)
class Family:
    """Materials of round bodies.

    Attributes:
        walls: dielectric ones, thickness in m and permittivity.
        filled: metal as well, and a wall around water.
    """

    walls: tuple[tuple[float, float], ...]
    filled: bool


ANY = Family(
    tuple((wall_m, permittivity) for wall_m in (2.5e-3, 4.5e-3) for permittivity in (2.3, 4.0, 6.0, 8.5)),
    True,
)
"""Cans, and walls of plastic, ceramic, glass and the porcelain of mugs."""
THIN = Family(tuple((wall_m, 2.3) for wall_m in (0.8e-3, 1.6e-3, 2.5e-3)), False)
"""Plastic bottles and cups. A thin wall shows by its thickness times its permittivity less one."""

FINER_M, FINER_WALL_M, FINER_PERMITTIVITY = 1e-3, 1e-3, 1.2
"""Steps to the walls between those of the family: radius, thickness, and the ratio of permittivities."""


def bodies_of(family: Family, radius_m: float) -> tuple[Shell, ...]:
    """Bodies of a family on which reflectors may stand `radius_m` from the axis, in both polarisations."""
    found = []
    sizes = np.arange(LEAST_M, radius_m - CLEAR_M, STEP_M)
    for radius in sizes[sizes > radius_m - FARTHEST_M - STEP_M / 2]:
        for polarisation in ("V", "H"):
            if family.filled:
                found.append(Shell(float(radius), 0.0, 1.0, True, polarisation))
                found.append(Shell(float(radius), *COATED, True, polarisation))
            found += [Shell(float(radius), *wall, False, polarisation) for wall in family.walls]
    return tuple(found)


def between(family: Family, wall: Shell, radius_m: float) -> tuple[Shell, ...]:
    """A body of a family and those between it and its neighbours there.

    Args:
        family: no thicker wall than its thickest is given, no thinner one, nor other permittivities.
        wall: its polarisation is kept.
        radius_m: of the reflectors, whose centres all of them clear, m.
    """
    steps = np.array([-1, 0, 1])
    radii = wall.radius_m + FINER_M * steps
    thicknesses = permittivities = np.zeros(1)
    if not wall.metal:
        thick, strong = (np.array(some) for some in zip(*family.walls, strict=True))
        thicknesses = np.clip(FINER_WALL_M * steps, thick.min() - wall.wall_m, thick.max() - wall.wall_m)
        permittivities = wall.permittivity * FINER_PERMITTIVITY**steps
        permittivities = np.clip(permittivities, strong.min(), strong.max()) - wall.permittivity
    return tuple(
        dict.fromkeys(
            replace(
                wall,
                radius_m=float(radius),
                wall_m=float(wall.wall_m + thickness),
                permittivity=float(wall.permittivity + permittivity),
            )
            for radius, thickness, permittivity in product(radii, thicknesses, permittivities)
            if wall.wall_m + thickness < radius <= radius_m - CLEAR_M
        )
    )


@dataclass(frozen=True, eq=False)
class Paths:
    """Ways from the antenna to reflectors on rings, in H arrangements of K.

    The pattern is that of a plane wave. The path is the reflector's own, so that its range and the curvature
    of the wave on the lit side are exact.

    Attributes:
        waves: (H, F, K, V) complex128 echo of every reflector in free space.
        index: (H, K, V) the angle of a table at or below that between outward direction and antenna,
        part: (H, K, V) and the way from there to the next one, 0 to 1.
    """

    waves: NDArray[np.complex128]
    index: NDArray[np.intp]
    part: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        spectra: Spectra,
        centres: NDArray[np.complex128],
        radii: NDArray[np.float64],
        angles: NDArray[np.float64],
        heights: NDArray[np.float64],
    ) -> Paths:
        """Of arrangements.

        Args:
            spectra: the scans.
            centres: (H,) of body and ring, x + jy, m.
            radii: (H, K) of the reflectors from there, m.
            angles: (H, K) their directions, rad.
            heights: (H, K) above the object's plane, m.
        """
        local = (spectra.antenna[None] - centres[:, None])[:, None] * np.exp(-1j * angles)[..., None]
        plane = np.abs(local - radii[..., None])
        distance = np.hypot(plane, spectra.height_m - heights[..., None])
        waves = np.moveaxis(spectra.waves(distance) * (spectra.distance_m / distance) ** 2, 0, 1)
        at = np.angle(local) * (ANGLES / (2 * np.pi))
        low = np.floor(at)
        return cls(waves, low.astype(np.intp) % ANGLES, at - low)


@dataclass(frozen=True, eq=False)
class Patterns:
    """Patterns beside every body of a family.

    Attributes:
        family: to which the bodies belong.
        radius_m: distance of the reflectors from the axis, m.
        shells: (S,) the bodies.
        relative: (DIPOLES, S, F, ANGLES) complex128 two-way responses of both dipoles over that of a
            reflector in free space, at angles 2 pi / ANGLES apart between outward direction and antenna,
            seen from the axis.
    """

    family: Family
    radius_m: float
    shells: tuple[Shell, ...]
    relative: NDArray[np.complex128]

    @classmethod
    def of(cls, spectra: Spectra, radius_m: float, family: Family = ANY) -> Patterns:
        """Those of a radius, at the frequencies of spectra; the last ones are kept."""
        return _patterns(spectra.wavenumbers.tobytes(), round(radius_m, 4), family)

    def finer(self, spectra: Spectra, walls: Iterable[int]) -> Patterns:
        """Those of some of the bodies, by index, and of bodies between these and their neighbours."""
        chosen = dict.fromkeys(self.shells[i] for i in walls)
        around = dict.fromkeys(
            one for wall in chosen for one in (wall, *between(self.family, wall, self.radius_m))
        )
        return self.beside(spectra, tuple(around))

    def beside(self, spectra: Spectra, shells: tuple[Shell, ...]) -> Patterns:
        """Those beside other bodies."""
        return _of(spectra.wavenumbers, self.family, self.radius_m, shells)

    def thinned(self, step: int) -> Patterns:
        """At every `step`-th frequency only."""
        return replace(self, relative=np.ascontiguousarray(self.relative[:, :, ::step]))

    def columns(
        self, paths: Paths, shells: NDArray[np.intp], dipoles: int = DIPOLES
    ) -> NDArray[np.complex128]:
        """(dipoles, H, F, K, V) echo of every reflector, as an electric dipole and as a magnetic one.

        Args:
            paths: of H arrangements, or of one that stands beside H bodies.
            shells: (H,) indices of the bodies.
            dipoles: 1 for the electric one alone.
        """
        count, f = self.relative.shape[1:3]
        row = (np.arange(dipoles)[:, None, None] * count + shells[:, None]) * f + np.arange(f)
        row = row[..., None, None] * ANGLES
        flat, index = self.relative.reshape(-1), paths.index[:, None]
        here, ahead = flat[row + index], flat[row + (index + 1) % ANGLES]
        return np.asarray(paths.waves * (here + (ahead - here) * paths.part[:, None]))


@lru_cache(maxsize=8)
def _patterns(wavenumbers: bytes, radius_m: float, family: Family) -> Patterns:
    return _of(np.frombuffer(wavenumbers), family, radius_m, bodies_of(family, radius_m))


def _of(
    wavenumbers: NDArray[np.float64], family: Family, radius_m: float, shells: tuple[Shell, ...]
) -> Patterns:
    # Spectra count both ways: kappa = 2k.
    k = wavenumbers / 2
    angles = 2 * np.pi * np.arange(ANGLES) / ANGLES
    direct = np.exp(2j * k[:, None] * radius_m * np.cos(angles))
    return Patterns(family, radius_m, shells, echoes(k, shells, radius_m, angles) / direct)
