"""The pattern of a small reflector before a round wall, from the fields around a cylinder.

A reflector at radius r before a wall of radius a is met by the wave itself, by what the wall returns, and in
the shadow by what creeps around it or passes through; by reciprocity its answer takes the same ways back. A
small one answers as dipoles do, so its echo towards the angle psi is

    sum_p g_p E_p(r, psi)^2 exp(-2jkr cos(psi)),

E_p the components of the total field of a plane wave from that angle, the factor for the phase that its
distance has anyway. For upright polarisation E_z dominates, and the magnetic field across it is taken beside
it; for horizontal, the electric field along and across the wall. With U = E_z or H_z,

    U = sum_n j^n (J_n(kr) + R_n H_n(kr)) exp(j n psi)

(H_n of the second kind, R_n of `tagid.fields.shells`), these are U and (1/k) dU/dr, or the latter and
1/(kr) dU/dpsi. Beside a wall of unknown polarisation these components tell the two apart; the invariants of
both fields, which `cylinder_patterns` fits, do not.

Of full-wave reflectors on metal cans this leaves 0.1 to 1 % with upright and 1 to 3 % with horizontal
polarisation, with two free amplitudes at each frequency; on ceramic cups 4 to 7 %, where three free terms
leave 20 to 40 %. With so little freedom, one reflector cannot imitate two neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.fields.bessel import bessel
from tagid.fields.shells import Shell, reflection

TERMS = 2
"""Free amplitudes at each frequency."""
SERIES = 24
"""Cosines of psi that hold a pattern: reflectors within 65 mm, up to 5 GHz."""
_SAMPLES = 96
_BEYOND = 8
"""Orders of the field beyond kr."""


@dataclass(frozen=True)
class Material:
    """What a wall is made of.

    Attributes:
        wall_m: thickness, m; 0 for metal.
        permittivity: relative.
    """

    wall_m: float
    permittivity: float


METAL = Material(0.0, 1.0)


@dataclass(frozen=True)
class Wall:
    """A round wall, and a reflector before it.

    Attributes:
        horizontal: the radar's polarisation lies across the axis, else along it.
        radius_m: of the ring of reflectors, m.
        gap_m: from the wall to the reflectors' centres, m.
        material: of the wall.
    """

    horizontal: bool
    radius_m: float
    gap_m: float
    material: Material

    @property
    def shell(self) -> Shell:
        """The body."""
        made = self.material
        polarisation = "H" if self.horizontal else "V"
        return Shell(
            self.radius_m - self.gap_m, made.wall_m, made.permittivity, made.wall_m == 0, polarisation
        )


def series(wavenumbers: NDArray[np.float64], walls: Sequence[Wall]) -> NDArray[np.complex128]:
    """(W, F, TERMS, SERIES) coefficients of cos(n psi) of the patterns, each of unit RMS over psi.

    Args:
        wavenumbers: (F,) kappa = 2 k, rad/m.
        walls: (W,), see `Wall`.
    """
    k = wavenumbers / 2
    outside = k * np.array([wall.radius_m for wall in walls])[:, None]
    horizontal = np.array([wall.horizontal for wall in walls])
    n = np.arange(int(np.ceil(outside.max())) + _BEYOND + 1)
    back = reflection(k, [wall.shell for wall in walls], len(n) - 1)
    here = bessel(len(n) - 1, outside)
    weight = 1j**n * np.where(n > 0, 2, 1)
    angle = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES
    even, odd = np.cos(np.outer(n, angle)), -n[:, None] * np.sin(np.outer(n, angle))
    field = weight * (here.j + back * here.h2)
    outward = (weight * (here.dj + back * here.dh2)) @ even
    pattern = np.stack([field @ even, outward], axis=2)
    pattern[horizontal] = np.stack([outward, field @ odd / outside[..., None]], axis=2)[horizontal]
    pattern = pattern**2 * np.exp(-2j * outside[..., None] * np.cos(angle))[:, :, None]
    pattern /= np.sqrt((np.abs(pattern) ** 2).mean(axis=-1, keepdims=True))
    found = np.fft.fft(pattern, axis=-1)[..., :SERIES] / _SAMPLES
    found[..., 1:] *= 2
    return np.asarray(found)
