"""Two-dimensional scattering by cells: a solver unlike the one of surfaces in `train.fullwave`.

Objects are infinite along z, the electric field is along z (TM, antennas upright), time convention
exp(+j omega t). Only what differs from air is cut into cells. Each cell radiates q H0(k d), H0 the Hankel
function of the second kind, as a circle of its area whose field is even; a metal surface is a grid of wires,
each of its spacing's circumference. The amplitudes q solve a symmetric equation; one factorisation serves all
antenna positions. Source: J. H. Richmond, IEEE Trans. Antennas Propag. 13, 1965, p. 334, and 14, 1966, p. 782
(wires).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import j0, j1, y0, y1

from tagid.constants import SPEED_OF_LIGHT
from tagid.types import Complex, Floats

METAL = complex(np.inf)


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of an object.

    Attributes:
        centre_m: (N,) x + jy, m.
        radius_m: (N,) of the circle of the cell's area, or of the wire, m.
        permittivity: (N,) relative, its imaginary part negative for losses; `METAL` for a wire.
    """

    centre_m: Complex
    radius_m: Floats
    permittivity: Complex

    @classmethod
    def of(cls, centre_m: Complex, radius_m: Floats | float, permittivity: complex) -> Cells:
        """Cells of one material."""
        shape = np.shape(centre_m)
        return cls(centre_m, np.broadcast_to(radius_m, shape), np.full(shape, permittivity, dtype=complex))

    def __add__(self, other: Cells) -> Cells:
        return Cells(
            np.concatenate([self.centre_m, other.centre_m]),
            np.concatenate([self.radius_m, other.radius_m]),
            np.concatenate([self.permittivity, other.permittivity]),
        )

    def moved(self, by_m: complex, turn_rad: float = 0.0) -> Cells:
        """The same turned about z = 0 and then moved."""
        return Cells(self.centre_m * np.exp(1j * turn_rad) + by_m, self.radius_m, self.permittivity)


NOTHING = Cells.of(np.zeros(0, complex), 0.0, 1.0)


def ellipse(half_x_m: float, half_y_m: float) -> Complex:
    """(n,) closed outline x + jy, m, counter-clockwise."""
    angle = 2 * np.pi * np.arange(1440) / 1440
    return np.asarray(half_x_m * np.cos(angle) + 1j * half_y_m * np.sin(angle))


def box(half_x_m: float, half_y_m: float) -> Complex:
    """The same of a rectangle."""
    corners = np.array([1 - 1j, 1 + 1j, -1 + 1j, -1 - 1j, 1 - 1j])
    sides = np.interp(np.arange(1440) / 360, np.arange(5), corners)
    return np.asarray(half_x_m * sides.real + 1j * half_y_m * sides.imag)


def _along(outline: Complex, step_m: float) -> tuple[Complex, float]:
    """Evenly spaced places (n,) on a closed outline about as far apart as given, and their spacing, m."""
    closed = np.append(outline, outline[0])
    length = np.append(0.0, np.cumsum(np.abs(np.diff(closed))))
    count = max(round(length[-1] / step_m), 3)
    return np.interp((np.arange(count) + 0.5) / count * length[-1], length, closed), length[-1] / count


def wall(outline: Complex, thickness_m: float, permittivity: complex, cell_m: float = 1.0) -> Cells:
    """A wall about an outline, which is its middle, in as many layers as no cell is larger than given.

    A solid rod of radius r is a wall of thickness r about a circle of radius r / 2.
    """
    layers = int(np.ceil(thickness_m / cell_m - 1e-9))
    side = thickness_m / layers
    tangent = np.roll(outline, -1) - np.roll(outline, 1)
    normal = -1j * tangent / np.abs(tangent)
    cells = NOTHING
    for offset in (np.arange(layers) + 0.5) * side - thickness_m / 2:
        centre, step = _along(outline + offset * normal, side)
        cells += Cells.of(centre, np.sqrt(step * side / np.pi), permittivity)
    return cells


def metal(outline: Complex) -> Cells:
    """A metal surface: wires about 2.5 mm apart."""
    centre, step = _along(outline, 2.5e-3)
    return Cells.of(centre, step / (2 * np.pi), METAL)


def _self_term(k: float, cells: Cells) -> Complex:
    """(N,) field at each cell that excites it with q = 1, less what the others radiate to it."""
    x, wires = k * cells.radius_m, np.isinf(cells.permittivity.real)
    contrast = np.where(wires, 1.0, cells.permittivity - 1)
    within = 1 + contrast * 0.5j * (np.pi * x * (j1(x) - 1j * y1(x)) - 2j)
    return np.where(wires, -(j0(x) - 1j * y0(x)) / j0(x), within / (-0.5j * np.pi * x * contrast * j1(x)))


def _hankel(x: Floats) -> NDArray[np.complex64]:
    out = np.empty(x.shape, dtype=np.complex64)
    out.real, out.imag = j0(x), -y0(x)
    return out


def echo(cells: Cells, frequency_hz: Floats, antennas_m: Complex) -> Complex:
    """Monostatic S (F, P) for line antennas at x + jy (P,), m: E = S H0(kR)^2, R from the antenna to z = 0.

    Far away and for a cylinder about the origin it is that of `tagid.simulate.multipole`, and the
    scattering length of a height h is j h S / pi. A point at another distance d has H0(kd)^2 / H0(kR)^2: the
    phase of a real antenna, and R / d of its amplitude instead of (R / d)^2.
    """
    out = np.zeros((len(frequency_hz), len(antennas_m)), dtype=np.complex128)
    for i, (k, field, radiated) in enumerate(_excited(cells, frequency_hz, antennas_m)):
        incident = j0(k * np.abs(antennas_m)) - 1j * y0(k * np.abs(antennas_m))
        out[i] = (field * radiated).sum(axis=0) / incident**2
    return out


def lit(cells: Cells, frequency_hz: Floats, antennas_m: Complex, places_m: Complex) -> Complex:
    """(F, K, P) field of line antennas at x + jy (P,), m, at places (K,), over that without the cells."""
    out = np.zeros((len(frequency_hz), len(places_m), len(antennas_m)), dtype=np.complex128)
    for i, (k, _, radiated) in enumerate(_excited(cells, frequency_hz, antennas_m)):
        arriving = _hankel(k * np.abs(places_m[:, None] - cells.centre_m)) @ radiated
        out[i] = 1 + arriving / _hankel(k * np.abs(places_m[:, None] - antennas_m))
    return out


def _excited(
    cells: Cells, frequency_hz: Floats, antennas_m: Complex
) -> Iterator[tuple[float, NDArray[np.complex64], NDArray[np.complex64]]]:
    """Wavenumber, field of the antennas at the cells, and amplitudes that the cells radiate, (N, P)."""
    apart = np.abs(cells.centre_m[:, None] - cells.centre_m)
    np.fill_diagonal(apart, 1.0)
    away = np.abs(cells.centre_m[:, None] - antennas_m)
    for k in 2 * np.pi * frequency_hz / SPEED_OF_LIGHT:
        matrix = -_hankel(k * apart)
        np.fill_diagonal(matrix, _self_term(k, cells))
        field = _hankel(k * away)
        yield float(k), field, np.linalg.solve(matrix, field)
