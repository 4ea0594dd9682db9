"""Exact scattering of round bodies in a plane wave, and the field at a point next to or inside them.

An infinite round cylinder with an upright axis, of metal or of concentric layers, in a plane wave whose
electric field is parallel to the axis (TM). With the antenna in the direction phi = 0, the phase reference on
the axis and the time convention exp(+j omega t), the field outside is

    E(r, phi) = sum_n j^n [J_n(kr) + R_n H_n^(2)(kr)] exp(j n phi),  n over all integers,

and in the core, of wavenumber q, sum_n j^n C_n J_n(qr) exp(j n phi). Sources: Bowman, Senior, Uslenghi,
Electromagnetic and Acoustic Scattering by Simple Shapes, 1969, section 2.2; Balanis, Advanced Engineering
Electromagnetics, 1989, section 11.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np

from tagid.errors import DataError
from tagid.fields.bessel import bessel, first_kind
from tagid.types import Complex, Floats


@dataclass(frozen=True)
class Layer:
    """One layer of a round body, from the next inner layer (or the axis) to its outer radius.

    Attributes:
        radius_m: outer radius, m.
        permittivity: relative permittivity, with a negative imaginary part for losses; infinite for metal,
            which only the innermost layer may be.
    """

    radius_m: float
    permittivity: complex = 1.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.radius_m) and 0 < self.radius_m <= 1):
            raise DataError(f"a layer has a radius of {self.radius_m} m, expected up to 1 m")
        if not self.metal and not (self.permittivity.real > 0 and self.permittivity.imag <= 0):
            raise DataError(f"a layer has a relative permittivity of {self.permittivity}")

    @property
    def metal(self) -> bool:
        """Whether the layer is a perfect conductor."""
        return bool(np.isinf(self.permittivity.real))


def orders(ka: float) -> int:
    """Highest order n that contributes at the radius a; terms fall off faster than exponentially beyond."""
    return int(np.ceil(ka + 6 * ka ** (1 / 3) + 8))


def _index(layer: Layer) -> complex:
    """Refractive index; real for a lossless layer, whose Bessel functions are then much faster."""
    index = np.sqrt(layer.permittivity + 0j)
    return float(index.real) if index.imag == 0 else complex(index)


def ring_m(layers: tuple[Layer, ...]) -> float:
    """Depth behind the axis at which the response of a round body has decayed, one-way m.

    Around the back of metal runs a single creeping wave; dielectric walls guide waves around several times.
    """
    return 0.2 if all(layer.metal for layer in layers) else 0.6


@dataclass(frozen=True, eq=False)
class Multipoles:
    """A round body solved at a set of wavenumbers.

    Attributes:
        wavenumber: (F,) in free space, rad/m.
        layers: layers of the body, from the innermost outwards.
        reflected: (F, N + 1) complex128 coefficients R_n, n = 0..N; R_-n = R_n.
        transmitted: (F, N + 1) complex128 coefficients C_n of the core; zero for metal.
    """

    wavenumber: Floats
    layers: tuple[Layer, ...]
    reflected: Complex
    transmitted: Complex

    @classmethod
    def of(cls, wavenumber: Floats, layers: Sequence[Layer]) -> Multipoles:
        """Solve a body.

        E and dE/dr are continuous at every interface (all layers are non-magnetic), so the pair is carried
        from the axis outwards; the Wronskian of J_n and Y_n inverts each step. Raises DataError: no layer,
        radii that do not increase, or metal outside the innermost layer.
        """
        radii = [layer.radius_m for layer in layers]
        if not layers or radii != sorted(set(radii)) or any(layer.metal for layer in layers[1:]):
            raise DataError("layers of a round body need increasing radii, and metal only as the innermost")
        k = np.asarray(wavenumber, dtype=np.float64)[:, None]
        most = orders(float(k.max()) * radii[-1])
        core = layers[0]
        shape = (len(k), most + 1)
        field, slope, scale = np.zeros(shape, complex), np.ones(shape, complex), np.ones(shape)
        if not core.metal:
            q = k * _index(core)
            within = bessel(most, (q * core.radius_m)[:, 0])
            field, slope = within.j, q * within.dj
            # Only the ratio matters; at high orders both are very small.
            scale = np.maximum(np.maximum(np.abs(field), np.abs(slope / q)), 1e-250)
            field, slope = field / scale, slope / scale
        for inner, layer in pairwise(layers):
            q = k * _index(layer)
            a = q * inner.radius_m
            at_a, at_b = (bessel(most, (q * boundary.radius_m)[:, 0]) for boundary in (inner, layer))
            # E = c J + d Y, with J Y' - Y J' = 2 / (pi x).
            c = np.pi * a / 2 * (field * at_a.dy - slope / q * at_a.y)
            d = np.pi * a / 2 * (slope / q * at_a.j - field * at_a.dj)
            field, slope = c * at_b.j + d * at_b.y, q * (c * at_b.dj + d * at_b.dy)
        free = bessel(most, (k * radii[-1])[:, 0])
        below = slope * free.h2 - k * field * free.dh2
        reflected = -(slope * free.j - k * field * free.dj) / below
        # J + R H = (2j / (pi r)) field / below, again by the Wronskian; the core's part is 1 / (field scale).
        inside = 0j if core.metal else 2j / (np.pi * radii[-1])
        transmitted: Complex = np.asarray(inside / below / scale, dtype=np.complex128)
        return cls(k[:, 0], tuple(layers), reflected.astype(np.complex128), transmitted)

    def backscatter(self) -> Complex:
        """(F,) monostatic S = sum_n (-1)^n R_n over all integers n; the echo width is (4 / k) |S|^2."""
        n = np.arange(self.reflected.shape[1])
        return np.asarray(self.reflected @ (np.where(n == 0, 1, 2) * (-1.0) ** n), dtype=np.complex128)

    def field(self, radius_m: float, angle_rad: Floats) -> Complex:
        """(F, P) field at points outside the body or in its core, relative to the incident field on the axis.

        By reciprocity a small scatterer at such a point returns its free-space echo times this field squared:
        directly both ways, once via the body, and via the body both ways. Only multiple reflection between
        scatterer and body is neglected.

        The points are radius_m from the axis, in the directions (P,), rad, relative to the antenna's. Raises
        DataError if they are inside metal or a wall.
        """
        outside = radius_m >= self.layers[-1].radius_m
        core = self.layers[0]
        if not outside and (core.metal or radius_m > core.radius_m):
            raise DataError(f"the point {radius_m * 1e3:g} mm from the axis lies in the body's wall or metal")
        x = self.wavenumber[:, None] * radius_m
        solved = np.arange(self.reflected.shape[1])[None]
        if outside:
            n = np.arange(max(solved.size, orders(float(x.max())) + 1))[None]
            radial = first_kind(n.size - 1, x[:, 0]).astype(np.complex128)
            # Beyond the body's own orders R_n vanishes while the Hankel function overflows.
            radial[:, : solved.size] += self.reflected * bessel(solved.size - 1, x[:, 0]).h2
        else:
            n = solved
            radial = self.transmitted * first_kind(n.size - 1, (x * _index(core))[:, 0])
        weight = np.where(n == 0, 1, 2) * np.array([1, 1j, -1, -1j])[n % 4]
        return np.asarray((radial * weight) @ np.cos(n.T * np.asarray(angle_rad)[None]), dtype=np.complex128)


@lru_cache(maxsize=16)
def _solved(layers: tuple[Layer, ...], wavenumber: bytes) -> Multipoles:
    return Multipoles.of(np.frombuffer(wavenumber), layers)


def solve(wavenumber: Floats, layers: tuple[Layer, ...]) -> Multipoles:
    """`Multipoles.of` with a cache of the last bodies: a body and its scatterers share a solution."""
    return _solved(layers, np.ascontiguousarray(wavenumber, dtype=np.float64).tobytes())
