"""The field next to many round shells at once: cylinders of metal, of a dielectric wall, or of both.

An infinite upright cylinder in a plane wave, the antenna in the direction 0, phases referred to the axis,
time convention exp(+j omega t). For upright polarisation the axial field is electric (TM), for horizontal
polarisation magnetic (TE); outside it is

    G(r, phi) = sum_n j^n [J_n(kr) + R_n H_n^(2)(kr)] exp(j n phi),  n over all integers.

Continuous at every interface are G and dG/dr (TM), or G and (1 / eps) dG/dr (TE). Sources: Bowman, Senior,
Uslenghi, Electromagnetic and Acoustic Scattering by Simple Shapes, 1969, section 2.2; Balanis, Advanced
Engineering Electromagnetics, 1989, sections 11.5 and 11.7.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError
from tagid.fields.bessel import Bessel, bessel


@dataclass(frozen=True)
class Shell:
    """A round body.

    Attributes:
        radius_m: outer radius, m.
        wall_m: thickness of the dielectric wall, m; 0 for bare metal.
        permittivity: relative permittivity of the wall.
        metal: a metal core inside the wall; empty otherwise. Water is nearly one.
        polarisation: "V", electric field along the axis, or "H", across it.
        filling: relative permittivity of what fills the wall where there is no metal.
    """

    radius_m: float
    wall_m: float
    permittivity: float
    metal: bool
    polarisation: str = "V"
    filling: float = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.wall_m < self.radius_m or self.permittivity < 1:
            raise DataError(f"a shell has a wall of {self.wall_m} m around {self.radius_m} m")
        if self.polarisation not in ("V", "H"):
            raise DataError(f"polarisation is {self.polarisation!r}, expected V or H")


def reflection(
    wavenumber: NDArray[np.float64], shells: Sequence[Shell], order: int
) -> NDArray[np.complex128]:
    """(S, F, order + 1) coefficients R_n of shells (S,) of the orders 0 to `order`, at wavenumbers (F,) in
    free space, rad/m; R_-n = R_n.
    """
    # What the polarisation does not change is found once.
    bodies = [replace(shell, polarisation="V") for shell in shells]
    alone = list(dict.fromkeys(bodies))
    place = {shell: i for i, shell in enumerate(alone)}
    at = np.array([place[body] for body in bodies])
    k = np.asarray(wavenumber, dtype=np.float64)[None, :]
    outer = np.array([shell.radius_m for shell in alone])[:, None]
    inner = outer - np.array([shell.wall_m for shell in alone])[:, None]
    metal = np.array([shell.metal for shell in shells])[:, None, None]
    electric = np.array([shell.polarisation == "V" for shell in shells])[:, None, None]
    permittivity = np.array([shell.permittivity for shell in alone])[:, None]
    filling = np.array([shell.filling for shell in alone])[:, None]
    inside, q = k * np.sqrt(filling), k * np.sqrt(permittivity)
    core, free = _of(bessel(order, inside * inner), at), _of(bessel(order, k * outer), at)
    at_inner, at_outer = _of(bessel(order, q * inner), at), _of(bessel(order, q * outer), at)
    inside, q, inner, outer, permittivity, filling = (
        values[at] for values in (inside, q, inner, outer, permittivity, filling)
    )
    # The pair of continuous quantities at the inner face: on metal E = 0 (TM) or dG/dr = 0 (TE).
    field = np.where(metal, np.where(electric, 0.0, 1.0), core.j)
    within = inside[..., None] / np.where(electric, 1.0, filling[..., None])
    slope = np.where(metal, np.where(electric, 1.0, 0.0) * k[..., None], core.dj * within)
    scale = np.maximum(np.maximum(np.abs(field), np.abs(slope / k[..., None])), 1e-250)
    field, slope = field / scale, slope / scale
    weight = np.where(electric, 1.0, permittivity[..., None])
    field, slope = _through(field, slope * weight / q[..., None], (q * inner)[..., None], at_inner, at_outer)
    slope = slope * q[..., None] / weight
    k = k[..., None]
    return np.asarray(-(slope * free.j - k * field * free.dj) / (slope * free.h2 - k * field * free.dh2))


def _of(values: Bessel, index: NDArray[np.intp]) -> Bessel:
    return Bessel(values.j[index], values.y[index], values.dj[index], values.dy[index])


def _through(
    field: NDArray[np.float64],
    slope: NDArray[np.float64],
    argument: NDArray[np.float64],
    inner: Bessel,
    outer: Bessel,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Field and its derivative at the outer face of a layer; J Y' - Y J' = 2 / (pi x)."""
    c = np.pi * argument / 2 * (field * inner.dy - slope * inner.y)
    d = np.pi * argument / 2 * (slope * inner.j - field * inner.dj)
    return np.asarray(c * outer.j + d * outer.y), np.asarray(c * outer.dj + d * outer.dy)


def echoes(
    wavenumber: NDArray[np.float64], shells: Sequence[Shell], radius_m: float, angle_rad: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """(2, S, F, P) two-way responses of a small isotropic reflector next to every shell (S,), at wavenumbers
    (F,), rad/m.

    First that of an electric dipole, E . E, then that of a magnetic one, H . H, in units of the incident
    field. In free space both are exp(2jk r cos phi), and only their sum is known; next to a wall they differ.
    By reciprocity they hold the direct way, those by way of the body once and twice; only what bounces
    between reflector and body more than once is missing.

    The reflector is r, m, from the axis, in the directions phi (P,), rad, relative to the antenna. Raises
    DataError if it lies inside a shell.
    """
    if any(shell.radius_m > radius_m for shell in shells):
        raise DataError(f"a reflector {radius_m * 1e3:g} mm from the axis lies inside a shell")
    order = orders(wavenumber, radius_m)
    electric = np.array([shell.polarisation == "V" for shell in shells])
    return responses(wavenumber, reflection(wavenumber, shells, order), electric, radius_m, angle_rad)


def orders(wavenumber: NDArray[np.float64], radius_m: float) -> int:
    """Highest order that the field at a distance from the axis, m, has."""
    x = float(np.max(wavenumber)) * radius_m
    return int(np.ceil(x + 4 * x ** (1 / 3) + 3))


def responses(
    wavenumber: NDArray[np.float64],
    coefficients: NDArray[np.complex128],
    electric: NDArray[np.bool_],
    radius_m: float,
    angle_rad: NDArray[np.float64],
) -> NDArray[np.complex128]:
    """See `echoes`: beside shells of coefficients (S, F, order + 1), upright where electric (S,)."""
    x = np.asarray(wavenumber, dtype=np.float64) * radius_m
    n = np.arange(coefficients.shape[2])
    away = bessel(len(n) - 1, x)
    turn = np.where(n == 0, 1, 2) * np.array([1, 1j, -1, -1j])[n % 4]
    around = np.multiply.outer(n, angle_rad)
    cosine, sine = np.cos(around), np.asarray(-n[:, None] * np.sin(around), dtype=np.float64)
    radial = (away.j + coefficients * away.h2) * turn
    # The axial field, and the other one, its curl over jk; both are of unit length far away.
    axial = _summed(radial, cosine) ** 2
    along = _summed((away.dj + coefficients * away.dh2) * turn, cosine)
    outward = _summed(radial, sine) / x[:, None]
    across = -(along**2) - outward**2
    upright = electric[:, None, None]
    return np.stack([np.where(upright, axial, across), np.where(upright, across, axial)])


def _summed(terms: NDArray[np.complex128], shapes: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Terms (S, F, N) times real shapes (N, P)."""
    parts = np.concatenate([terms.real, terms.imag]).reshape(-1, len(shapes)) @ shapes
    parts = parts.reshape(2, *terms.shape[:2], -1)
    return np.asarray(parts[0] + 1j * parts[1])
