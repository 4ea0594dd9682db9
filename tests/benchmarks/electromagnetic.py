"""Cylinders by the exact series and plates by physical optics, for the objects that imaging is compared on.

Point models do not show the effect of an imaging method on a can or a box. These bodies have the correct
amplitude, phase and frequency dependence in one unit, so cans and boxes can share a scene. Bodies that carry
a tag are in `tagid.simulate.bodies`.

Amplitudes are scattering lengths b in metres, E_scattered = b exp(-jkR) / R for a unit incident field; the
radar cross-section is 4 pi |b|^2. Bodies provide points (`scattering.Body`): a frequency-dependent response
is a few points along the line of sight whose delayed pulses sum to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import DataError
from tagid.fields.bessel import bessel
from tagid.simulate.scattering import Body, Returns
from tagid.simulate.taps import BAND_HZ, fit_taps, tap_offsets
from tagid.types import Floats

_DIFFERENCE_M = 1e-3
"""Half distance of the point pair that gives the factor jk of physical optics; sin(2 k d) is off by 1 % at
6 GHz."""


def cylinder_series(ka: Floats) -> NDArray[np.complex128]:
    """Monostatic scattering of an infinite conducting cylinder in a plane wave, S(ka), same shape as ka.

    S = -sum_n (-1)^n J_n(ka) / H_n^(2)(ka), n over all integers, for an electric field along the axis. The
    echo width is (4 / k) |S|^2 and goes to pi a for large ka. Time convention exp(+j omega t); phase
    reference is the axis. Source: Bowman, Senior, Uslenghi, Electromagnetic and Acoustic Scattering by Simple
    Shapes, 1969, section 2.2.
    """
    ka = np.asarray(ka, dtype=np.float64)
    # The terms fall faster than exponentially for n > ka.
    most = int(np.ceil(ka.max() + 6 * ka.max() ** (1 / 3) + 8))
    total = np.zeros(ka.shape, dtype=np.complex128)
    functions = bessel(most, ka)
    h2 = functions.h2
    for n in range(most + 1):
        total -= (1 if n == 0 else 2) * (-1) ** n * functions.j[..., n] / h2[..., n]
    return total


@dataclass(frozen=True)
class ConductingCylinder:
    """An upright conducting cylinder, such as a can, by the exact series, which includes creeping waves.

    Scattering length of a length h at broadside: b = j h S(ka) / pi (a slice of the infinite cylinder's
    current, valid beyond 2 h^2 / lambda: 0.4 m for a can of 12 cm).

    Attributes:
        radius_m, height_m: m.
        centre_m: (x, y) of its axis, m.
    """

    radius_m: float
    height_m: float = 0.12
    centre_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.radius_m) and 0 < self.radius_m <= 5 and 0 < self.height_m <= 10):
            raise DataError(f"cylinder of radius {self.radius_m} m and height {self.height_m} m")

    def scattering_length(self, frequency_hz: Floats) -> NDArray[np.complex128]:
        """b (m) at frequencies of any shape, phase reference on the axis."""
        ka = 2 * np.pi * np.asarray(frequency_hz) / SPEED_OF_LIGHT * self.radius_m
        return 1j * self.height_m / np.pi * cylinder_series(ka)

    def returns(self, antennas: Floats) -> Returns:
        """The response as points along the line from the antenna through the axis."""
        offset, amplitude = _taps(self)
        away = np.asarray(self.centre_m) - antennas[:, :2]
        away = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
        xy = np.asarray(self.centre_m) + offset[None, :, None] * away[:, None, :]
        z = np.clip(antennas[:, 2], -self.height_m / 2, self.height_m / 2)
        points = np.concatenate([xy, np.broadcast_to(z[:, None, None], (*xy.shape[:2], 1))], axis=2)
        return Returns(points, np.broadcast_to(amplitude, points.shape[:2]).copy())


@lru_cache(maxsize=64)
def _taps(cylinder: ConductingCylinder) -> tuple[Floats, NDArray[np.complex128]]:
    """Offsets behind the axis (n,), m, and amplitudes (n,)."""
    a = cylinder.radius_m
    # From in front of the specular point to behind the creeping wave around the back.
    offset = tap_offsets(-a - 0.1, np.pi / 2 * a + 0.2)
    return offset, fit_taps(cylinder.scattering_length, offset)


@dataclass(frozen=True)
class Plate:
    """An upright rectangular plate by physical optics, near field included.

    b = -(jk / 2 pi) Gamma integral cos(theta) exp(-2jk (R' - R)) dS, over Gauss points with their own
    distances; at normal incidence and far away |b| = width height / lambda. Edge diffraction and
    reflection between plates are not modelled.

    Attributes:
        width_m, height_m: m; the height is centred on z = 0.
        centre_m: (x, y), m.
        normal_rad: direction of the normal seen from above, rad.
        reflectivity: Gamma against a conductor's 1: 1 for metal, less for a thin dielectric sheet.
        both_sides: also visible from behind (a transmitting sheet), or only from the front.
    """

    width_m: float
    height_m: float
    centre_m: tuple[float, float] = (0.0, 0.0)
    normal_rad: float = 0.0
    reflectivity: complex = 1.0
    both_sides: bool = False

    def __post_init__(self) -> None:
        sides = (self.width_m, self.height_m)
        if not all(np.isfinite(side) and 0 < side <= 10 for side in sides):
            raise DataError(f"plate of {self.width_m} x {self.height_m} m")

    def returns(self, antennas: Floats) -> Returns:
        """A pair of points for every Gauss node; their difference gives the factor jk."""
        shortest = SPEED_OF_LIGHT / BAND_HZ[1]
        across, weight_x = _gauss(self.width_m, int(np.ceil(8 * self.width_m / shortest)) + 6)
        # The height only adds a small curvature at equal height, a phase of k h^2 / (4 R).
        upward, weight_z = _gauss(self.height_m, int(np.ceil(3 * self.height_m / shortest)) + 4)
        normal = np.array([np.cos(self.normal_rad), np.sin(self.normal_rad), 0.0])
        along = np.array([-normal[1], normal[0], 0.0])
        u, z = np.meshgrid(across, upward, indexing="ij")
        nodes = np.array([*self.centre_m, 0.0]) + u.reshape(-1, 1) * along
        nodes[:, 2] += z.ravel()
        area = np.outer(weight_x, weight_z).ravel()
        sight = antennas[:, None] - nodes
        sight /= np.maximum(np.linalg.norm(sight, axis=2, keepdims=True), 1e-9)
        cosine = sight @ normal
        seen = np.abs(cosine) if self.both_sides else np.maximum(cosine, 0)
        amplitude = -self.reflectivity / (2 * np.pi) * area * seen / (4 * _DIFFERENCE_M)
        points = np.concatenate([nodes + _DIFFERENCE_M * sight, nodes - _DIFFERENCE_M * sight], axis=1)
        return Returns(points, np.concatenate([amplitude, -amplitude], axis=1).astype(np.complex128))


def field(body: Body, antennas: ArrayLike, frequency_hz: Floats) -> NDArray[np.complex128]:
    """sum_i a_i exp(-2jk d_i) of the points of a body: (F,) for an antenna (3,), (F, A) for many (A, 3)."""
    where = np.atleast_2d(antennas)
    returns = body.returns(where)
    distance = np.linalg.norm(returns.points - where[:, None], axis=2)
    k = 2 * np.pi * np.asarray(frequency_hz) / SPEED_OF_LIGHT
    seen = (np.exp(-2j * k[:, None, None] * distance) * returns.amplitudes).sum(axis=2)
    return np.asarray(seen if np.ndim(antennas) == 2 else seen[:, 0])


def _gauss(length: float, count: int) -> tuple[Floats, Floats]:
    """Gauss-Legendre nodes and weights on [-length / 2, length / 2]."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return nodes * length / 2, weights * length / 2


def metal_box(side_m: float, height_m: float, rotation_rad: float = 0.0) -> tuple[Plate, ...]:
    """A closed square box about the origin: four conducting plates; only the illuminated ones scatter."""
    return _walls(side_m, height_m, rotation_rad)


def cardboard_box(side_m: float, height_m: float) -> tuple[Plate, ...]:
    """Four thin dielectric sheets about the origin, visible from both sides; the wave passes them unchanged.

    A sheet much thinner than the wavelength reflects |Gamma| = k t (eps - 1) / 2 at normal incidence (first
    order in t; 0.12 for 4 mm of corrugated board of permittivity 1.7), 90 degrees behind a conductor.
    """
    k = 2 * np.pi * 3.95e9 / SPEED_OF_LIGHT
    return _walls(side_m, height_m, reflectivity=1j * k * 0.004 * (1.7 - 1) / 2, both_sides=True)


def _walls(
    side_m: float,
    height_m: float,
    rotation_rad: float = 0.0,
    reflectivity: complex = 1.0,
    both_sides: bool = False,
) -> tuple[Plate, ...]:
    plates = []
    for quarter in range(4):
        angle = rotation_rad + quarter * np.pi / 2
        middle = (side_m / 2 * float(np.cos(angle)), side_m / 2 * float(np.sin(angle)))
        plates.append(Plate(side_m, height_m, middle, angle, reflectivity, both_sides))
    return tuple(plates)
