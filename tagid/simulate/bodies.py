"""Bodies that carry a tag: cans and cups, helmet shells, cartons; physical models with their own echo.

All have their axis at `centre_m` of the object's frame and rotate and shift with the object. Amplitudes are
scattering lengths in metres divided by `unit_m` (see `scatterers`). Not modelled: horizontal polarisation,
and multiple reflection between body and reflector.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError
from tagid.fields.thin_shell import BoxShell, EllipticShell, ShellField
from tagid.simulate.beside import Beside, BesideRound, BesideShell
from tagid.simulate.multipole import Layer, ring_m, solve
from tagid.simulate.scattering import Returns
from tagid.simulate.taps import CENTRE_HZ, AspectTaps, fit_taps, tap_offsets, wavenumber
from tagid.types import Complex, Floats


def _direction(antennas: Floats, centre_m: tuple[float, float]) -> tuple[Floats, Floats, Floats]:
    """Horizontal distance (views,), m, azimuth (views,), rad, and unit vector (views, 2) to the antenna."""
    out = antennas[:, :2] - np.asarray(centre_m)
    distance = np.maximum(np.linalg.norm(out, axis=1), 1e-9)
    return distance, np.arctan2(out[:, 1], out[:, 0]), out / distance[:, None]


def _along_sight(
    antennas: Floats, centre_m: tuple[float, float], unit: Floats, depth_m: Floats
) -> NDArray[np.float64]:
    """(views, T, 3) points at height zero, depth_m (views, T) behind the axis as seen from the antenna."""
    xy = np.asarray(centre_m) - depth_m[..., None] * unit[:, None]
    return np.concatenate([xy, np.zeros((*depth_m.shape, 1))], axis=2)


def height_factor(distance_m: Floats, antenna_z_m: Floats, low_m: float, high_m: float) -> Complex:
    """(views,) echo of an upright wall from low_m to high_m, relative to one in phase over its whole height.

    (1 / h) integral exp(-jk [(z - z_a)^2 - z_a^2] / R) dz at 4 GHz, phase reference at height zero, for
    antennas at the horizontal distances and heights (views,), m: the curvature of the wave, and the wall's
    vertical beam when the antenna stands above or below it.
    """
    nodes, weights = np.polynomial.legendre.leggauss(24)
    z = (low_m + high_m) / 2 + nodes * (high_m - low_m) / 2
    excess = (z[None] ** 2 - 2 * z[None] * antenna_z_m[:, None]) / distance_m[:, None]
    k = wavenumber(np.array(CENTRE_HZ))
    return np.asarray(np.exp(-1j * k * excess) @ (weights / 2), dtype=np.complex128)


@dataclass(frozen=True)
class RoundBody:
    """A can, cup or bottle: concentric layers of finite height, by the exact series of the cylinder.

    b = j h S / pi. A can of 35 mm radius and 100 mm height is within 1.2 dB of its method-of-moments
    solution, -16.5 / -14.1 / -13.1 dBsm at 3.1 / 4.0 / 4.9 GHz (shared/fullwave/README.md). Real walls are
    not exactly round: the echo of an oval one shifts by oval_m cos 2 phi.

    Attributes:
        layers: from the innermost outwards.
        height_m: height of the wall, centred at the tag's height, m.
        centre_m: (x, y) of its axis, m.
        oval_m: amplitude of the deviation from a circle, m; oval_rad: direction of its longer axis, rad.
        unit_m: scattering length that is rendered as amplitude 1, m.
    """

    layers: tuple[Layer, ...]
    height_m: float
    centre_m: tuple[float, float] = (0.0, 0.0)
    oval_m: float = 0.0
    oval_rad: float = 0.0
    unit_m: float = 1.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.height_m) and 0 < self.height_m <= 1):
            raise DataError(f"a round body has a height of {self.height_m} m, expected up to 1 m")
        if not 0 <= self.oval_m <= 0.2 * self.layers[-1].radius_m:
            raise DataError(f"a round body is out of round by {self.oval_m} m")

    def scattering_length(self, frequency_hz: Floats) -> Complex:
        """b (m) at frequencies (F,), phase reference on the axis."""
        solved = solve(wavenumber(frequency_hz), self.layers)
        return 1j * self.height_m / np.pi * solved.backscatter()

    def returns(self, antennas: Floats) -> Returns:
        """The response as taps along the line from the antenna through the axis."""
        distance, azimuth, unit = _direction(antennas, self.centre_m)
        offset, amplitude = _round_taps(self.layers)
        shift = -self.oval_m * np.cos(2 * (azimuth - self.oval_rad))
        points = _along_sight(antennas, self.centre_m, unit, offset[None] + shift[:, None])
        half = self.height_m / 2
        factor = self.height_m / self.unit_m * height_factor(distance, antennas[:, 2], -half, half)
        return Returns(points, factor[:, None] * amplitude[None])

    def around(self, position_m: Floats) -> Beside:
        """The body next to a scatterer at (x, y), m; DataError inside its wall or metal."""
        radius = float(np.hypot(*(np.asarray(position_m)[:2] - self.centre_m)))
        core = self.layers[0]
        inside = radius < self.layers[-1].radius_m
        if inside and (core.metal or radius > core.radius_m):
            raise DataError(
                f"a reflector {radius * 1e3:.0f} mm from the axis is inside the wall of a body of "
                f"{self.layers[-1].radius_m * 1e3:.0f} mm radius",
                "Choose a smaller body, or a layout whose reflectors are outside it.",
            )
        # Rounded, so that equal radii share one table.
        return BesideRound(self.layers, round(radius, 7))


@lru_cache(maxsize=128)
def _round_taps(layers: tuple[Layer, ...]) -> tuple[Floats, Complex]:
    """Offsets (T,), m, and amplitudes (T,) of j S / pi: a round body of unit height."""
    a = layers[-1].radius_m
    offset = tap_offsets(-a - 0.1, a + ring_m(layers))
    return offset, fit_taps(RoundBody(layers, 1.0).scattering_length, offset)


def sheet(frequency_hz: Floats, thickness_m: float, permittivity: float) -> tuple[Complex, Complex]:
    """Reflection and transmission of a dielectric sheet at normal incidence, referred to its centre.

    Source: Balanis, Advanced Engineering Electromagnetics, 1989, section 5.5.
    """
    k = wavenumber(frequency_hz)
    n = np.sqrt(permittivity)
    r, turn = (1 - n) / (1 + n), np.exp(-1j * k * n * thickness_m)
    outside = np.exp(1j * k * thickness_m)
    below = 1 - r**2 * turn**2
    reflection = r * (1 - turn**2) / below * outside
    transmission = (1 - r**2) * turn / below * outside
    return np.asarray(reflection, dtype=np.complex128), np.asarray(transmission, dtype=np.complex128)


@dataclass(frozen=True)
class Shell:
    """A helmet: half a plastic ellipsoid, open below, with a straight skirt below the tag's height.

    Physical optics of its front and back walls: across the line of sight by stationary phase, up the wall by
    integration,

        b = -(jk / 2 pi) Gamma integral sqrt(pi rho s / (jk)) exp(2jk D s) dz   (front; back with -j and -D)

    with s(z) = sqrt(1 - z^2 / c^2) above the tag's height and 1 on the skirt, D the half width of the ellipse
    towards the antenna and rho its radius of curvature there; the back wall is seen through the front wall.

    Attributes:
        x_m, y_m: half axes of the rim, m; up_m: height of the dome above the tag, m.
        skirt_m: height of the skirt, m.
        thickness_m, permittivity: thickness, m, and relative permittivity of the plastic.
        centre_m: (x, y) of its axis, m.
        unit_m: scattering length that is rendered as amplitude 1, m.
    """

    x_m: float = 0.078
    y_m: float = 0.101
    up_m: float = 0.090
    skirt_m: float = 0.020
    thickness_m: float = 0.003
    permittivity: float = 2.8
    centre_m: tuple[float, float] = (0.0, 0.0)
    unit_m: float = 1.0

    def scattering_length(self, frequency_hz: Floats, azimuth_rad: Floats) -> Complex:
        """b (m), (F, A), for frequencies (F,) and antenna directions (A,), phase reference on the axis."""
        k = wavenumber(frequency_hz)
        nodes, weights = np.polynomial.legendre.leggauss(40)
        z = np.concatenate([(nodes + 1) * self.up_m / 2, (nodes - 1) * self.skirt_m / 2])
        dz = np.concatenate([weights * self.up_m, weights * self.skirt_m]) / 2
        s = np.sqrt(1 - np.clip(z / self.up_m, 0, 1) ** 2)
        c, q = np.cos(azimuth_rad), np.sin(azimuth_rad)
        width = np.sqrt((self.x_m * c) ** 2 + (self.y_m * q) ** 2)
        curvature = (self.x_m * self.y_m) ** 2 / width**3
        gamma, through = sheet(frequency_hz, self.thickness_m, self.permittivity)
        out = np.empty((len(k), len(width)), dtype=np.complex128)
        for i, (d, rho) in enumerate(zip(width, curvature, strict=True)):
            phase = np.exp(2j * d * np.outer(k, s))
            weight = dz * np.sqrt(np.pi * rho * s)
            front = phase @ weight / np.sqrt(1j * k)
            back = through**2 * (phase.conj() @ weight) / np.sqrt(-1j * k)
            out[:, i] = -1j * k / (2 * np.pi) * -gamma * (front + back)
        return out

    def returns(self, antennas: Floats) -> Returns:
        """The response as taps along the line from the antenna through the axis."""
        distance, azimuth, unit = _direction(antennas, self.centre_m)
        taps = _shell_taps(replace(self, centre_m=(0.0, 0.0), unit_m=1.0))
        depth = np.broadcast_to(taps.offset_m, (len(antennas), len(taps.offset_m)))
        points = _along_sight(antennas, self.centre_m, unit, depth)
        factor = height_factor(distance, antennas[:, 2], -self.skirt_m, self.skirt_m) / self.unit_m
        return Returns(points, factor[:, None] * taps.at(azimuth))

    def around(self, position_m: Floats) -> Beside | None:
        """The shell's cross section at the height of (x, y) or (x, y, z), m, as a thin sheet; none above the
        dome. DataError in its wall."""
        x, y = (float(value) for value in np.asarray(position_m)[:2] - self.centre_m)
        up = float(position_m[2]) / self.up_m if len(position_m) > 2 else 0.0
        narrowed = float(np.sqrt(max(1 - max(up, 0.0) ** 2, 0.0)))
        r, half = float(np.hypot(x, y)), self.thickness_m / 2
        wall = min(self.x_m, self.y_m) if r < half else r / float(np.hypot(x / self.x_m, y / self.y_m))
        wall *= narrowed
        if wall <= self.thickness_m:
            return None
        if abs(r - wall) < half:
            raise DataError(
                f"a reflector {r * 1e3:.0f} mm from the axis is in the helmet's wall",
                "Choose another size of the helmet.",
            )
        # Open below and closed above, it acts as half of an endless one (`tagid.fields.thin_shell`).
        sheet_m = (self.permittivity - 1) * self.thickness_m / 2
        across, along = (round(narrowed * axis, 7) for axis in (self.x_m, self.y_m))
        return BesideShell(EllipticShell(across, along, sheet_m), complex(round(x, 7), round(y, 7)))


@lru_cache(maxsize=64)
def _shell_taps(shell: Shell) -> AspectTaps:
    """Taps over a full turn."""
    widest = max(shell.x_m, shell.y_m)
    return AspectTaps.fit(shell.scattering_length, (-widest - 0.1, widest + 0.15), symmetric=False)


@dataclass(frozen=True)
class Carton:
    """A cardboard box around or behind the tag: four upright walls, as a thin sheet.

        b = k^2 (eps - 1) d h / (4 pi) integral E0 E ds (D e^jkD)^2

    with the field E of `tagid.fields.thin_shell` and the wave E0 = exp(-jkR) / R of an antenna at the
    distance D of the box: flashes are as wide as they are near the antenna, and the wave passes the walls, so
    that all four contribute from every side.

    Attributes:
        side_m, depth_m: outer length of its walls along x and y before it is rotated, m; height_m: their
            height, m, centred at the tag's height.
        thickness_m, permittivity: thickness, m, and permittivity of the board (corrugated: mostly air).
        rotation_rad: rotation of the box about its axis, rad.
        centre_m: (x, y) of its axis, m.
        unit_m: scattering length that is rendered as amplitude 1, m.
    """

    side_m: float
    depth_m: float
    height_m: float = 0.1
    thickness_m: float = 0.004
    permittivity: float = 1.7
    rotation_rad: float = 0.0
    centre_m: tuple[float, float] = (0.0, 0.0)
    unit_m: float = 1.0

    @property
    def walls(self) -> BoxShell:
        """In the middle of the board."""
        across, along = (round((size - self.thickness_m) / 2, 7) for size in (self.side_m, self.depth_m))
        return BoxShell(across, along, (self.permittivity - 1) * self.thickness_m)

    def returns(self, antennas: Floats) -> Returns:
        """The response as taps along the line from the antenna through the axis.

        The wave's curvature is that at the nearest tenth of a metre.
        """
        distance, azimuth, unit = _direction(antennas, self.centre_m)
        walls = self.walls
        taps = _box_taps(walls, max(round(float(distance.mean()), 1), round(2 * walls.radius_m, 2)))
        depth = np.broadcast_to(taps.offset_m, (len(antennas), len(taps.offset_m)))
        points = _along_sight(antennas, self.centre_m, unit, depth)
        half = self.height_m / 2
        factor = self.height_m / self.unit_m * height_factor(distance, antennas[:, 2], -half, half)
        return Returns(points, factor[:, None] * taps.at(2 * (azimuth - self.rotation_rad)))

    def around(self, position_m: Floats) -> Beside:
        """The walls next to (x, y), m; DataError in one of them."""
        place = complex(*(np.asarray(position_m)[:2] - self.centre_m)) * np.exp(-1j * self.rotation_rad)
        outside = float(self.walls.outside_m(np.array([place]))[0])
        if abs(outside) < self.thickness_m / 2:
            raise DataError(
                f"a reflector {abs(place) * 1e3:.0f} mm from the axis is in a wall of the box",
                "Choose another size of the box.",
            )
        return BesideShell(self.walls, complex(round(place.real, 7), round(place.imag, 7)))


@lru_cache(maxsize=64)
def _box_taps(walls: BoxShell, distance_m: float) -> AspectTaps:
    """Taps of walls 1 m high, symmetric about both axes: half a turn of twice the azimuth."""

    def response(frequency_hz: Floats, twice_rad: Floats) -> Complex:
        k = wavenumber(frequency_hz)
        antenna = distance_m * np.exp(0.5j * twice_rad)
        echo = ShellField.of(k, walls).echo(antenna) * np.exp(2j * k[:, None] * distance_m)
        return np.asarray(k[:, None] ** 2 * walls.sheet_m / (4 * np.pi) * distance_m**2 * echo)

    return AspectTaps.fit(response, (-walls.radius_m - 0.1, walls.radius_m + 0.15), symmetric=True)


Carrier = RoundBody | Shell | Carton
"""A body that reflectors can be mounted on."""
