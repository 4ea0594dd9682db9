"""Small scatterers on an object: octahedral reflectors, and upright rods that model handles and seams.

Amplitudes are scattering lengths b in metres, E_scattered = b exp(-jkR) / R for a unit incident field; the
radar cross-section is 4 pi |b|^2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np

from tagid.errors import DataError
from tagid.simulate.beside import DIRECT_M, Beside
from tagid.simulate.multipole import Layer, solve
from tagid.simulate.scattering import Returns
from tagid.simulate.taps import CENTRE_HZ, AspectTaps, wavenumber
from tagid.types import Complex, Floats

_SIZE_IN_WAVES = np.array(
    [1.174, 1.375, 1.576, 1.777, 1.978, 2.180, 2.347, 2.750, 3.152, 3.555, 3.957, 4.359]
)
_LENGTH_PER_SIZE = np.array(
    [0.0637, 0.0884, 0.1175, 0.1510, 0.1884, 0.2285, 0.2717, 0.3448, 0.3846, 0.3878, 0.3684, 0.3392]
)
_PHASE_RAD = np.array(
    [-0.062, -0.075, -0.099, -0.132, -0.178, -0.238, -0.326, -0.497, -0.669, -0.800, -0.878, -0.912]
)
"""b / D of an octahedron of three crossing metal plates, tip to tip D, against k D, vertical polarisation and
vertical axis. From method-of-moments solutions of D = 20 and 40 mm (shared/fullwave: free20_one, free40_one,
2.8 to 5.2 GHz at 1 m): metal scatterers scale with the wavelength, so both lie on one curve."""


class Scatterer(Protocol):
    """A small scatterer with the same echo at every azimuth; implementations are frozen and hashable."""

    def scattering_length(self, frequency_hz: Floats) -> Complex:
        """b (m) at frequencies of any shape, phase reference at its centre."""

    def __hash__(self) -> int: ...


@dataclass(frozen=True)
class Octahedron:
    """An octahedral reflector: three crossing diamond-shaped metal plates.

    Solved RCS at 3.1 / 4.0 / 4.9 GHz (shared/fullwave/README.md): 20 mm -45.1 / -40.5 / -36.8 dBsm, 40 mm
    -26.9 / -25.1 / -25.9 dBsm, equal at all azimuths to 0.2 dB. Below the table b follows Rayleigh's law,
    b ~ k^2 D^3; above it b / D stays at its last value.

    Attributes:
        size_m: tip to tip, m; 5 to 60 mm.
    """

    size_m: float

    def __post_init__(self) -> None:
        if not 0.005 <= self.size_m <= 0.060:
            raise DataError(f"an octahedron of {self.size_m * 1e3:g} mm is outside 5 to 60 mm")

    def scattering_length(self, frequency_hz: Floats) -> Complex:
        """b (m), phase reference at the centre."""
        size = wavenumber(frequency_hz) * self.size_m
        small = np.minimum(size / _SIZE_IN_WAVES[0], 1.0)
        per_size = np.exp(np.interp(np.log(size), np.log(_SIZE_IN_WAVES), np.log(_LENGTH_PER_SIZE)))
        phase = np.interp(size, _SIZE_IN_WAVES, _PHASE_RAD)
        # Radiation rotates the phase of a small dipole by an angle that decreases as (k D)^3.
        return np.asarray(self.size_m * per_size * small**2 * np.exp(1j * phase * small**3))


@dataclass(frozen=True)
class Rod:
    """An upright round rod, much longer than thick: the exact cylinder series times its length.

    b = j h S / pi (a slice of the infinite cylinder's current). A flat strip of width w scatters as a round
    wire of radius w / 4 (Balanis, Antenna Theory, 3rd ed., 2005, table 9.3).

    Attributes:
        layers: layers of its cross-section.
        height_m: length, m.
    """

    layers: tuple[Layer, ...]
    height_m: float

    @classmethod
    def metal_strip(cls, width_m: float, height_m: float) -> Rod:
        """A flat metal strip."""
        return cls((Layer(width_m / 4, complex(np.inf)),), height_m)

    def scattering_length(self, frequency_hz: Floats) -> Complex:
        """b (m), phase reference on the rod's axis."""
        solved = solve(wavenumber(frequency_hz), self.layers)
        return 1j * self.height_m / np.pi * solved.backscatter()


@lru_cache(maxsize=512)
def _taps_beside(scatterer: Scatterer, body: Beside | None) -> AspectTaps:
    """Echo of a scatterer next to a body, over the antenna's direction."""

    def response(frequency_hz: Floats, angle_rad: Floats) -> Complex:
        length = scatterer.scattering_length(frequency_hz)[:, None]
        effect = np.ones((1, len(angle_rad))) if body is None else body.effect(frequency_hz, angle_rad)
        return np.asarray(length * effect)

    if body is None:
        return AspectTaps.fit(response, (-DIRECT_M, DIRECT_M), symmetric=True)
    return AspectTaps.fit(response, body.reach_m, body.symmetric)


@dataclass(frozen=True, eq=False)
class Mounted:
    """Identical small scatterers on an object, with the effect of its body on the wave in both directions.

    Next to a body the echo includes the double bounce between scatterer and wall, whose phase changes with
    the aspect, and the body's shadow (`beside`).

    Attributes:
        scatterer: the scatterer at each position.
        positions: (n, 3) m, in the object's frame.
        amplitudes: (n,) complex128 relative strengths; 1 is the unscaled scatterer.
        bodies: one entry per position: the body next to it; None for none.
        axis_m: (x, y) of the body's axis, m.
        unit_m: scattering length that is rendered as amplitude 1, m.
    """

    scatterer: Scatterer
    positions: Floats
    amplitudes: Complex
    bodies: tuple[Beside | None, ...]
    axis_m: tuple[float, float] = (0.0, 0.0)
    unit_m: float = 1.0

    def single(self, index: int) -> Mounted:
        """Only one of the scatterers, including the effect of its body."""
        part = slice(index, index + 1)
        positions, amplitudes, bodies = self.positions[part], self.amplitudes[part], self.bodies[part]
        return replace(self, positions=positions, amplitudes=amplitudes, bodies=bodies)

    def returns(self, antennas: Floats) -> Returns:
        """Taps along the line from the antenna through each scatterer."""
        axis = np.asarray(self.axis_m)
        seen = antennas[:, :2] - axis
        points, amplitudes = [np.zeros((len(antennas), 0, 3))], [np.zeros((len(antennas), 0), complex)]
        for position, strength, body in zip(self.positions, self.amplitudes, self.bodies, strict=True):
            out = position[:2] - axis
            taps = _taps_beside(self.scatterer, body)
            angle = np.arctan2(seen[:, 1], seen[:, 0]) - np.arctan2(out[1], out[0])
            away = position - antennas
            away = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
            points.append(position + taps.offset_m[None, :, None] * away[:, None])
            amplitudes.append(strength / self.unit_m * taps.at(angle))
        return Returns(np.concatenate(points, axis=1), np.concatenate(amplitudes, axis=1))


def unit_of(scatterer: Scatterer) -> float:
    """|b| of a scatterer in free space at 4 GHz, m: the amplitude 1 of a scene of physical bodies."""
    return float(np.abs(scatterer.scattering_length(np.array([CENTRE_HZ]))[0]))
