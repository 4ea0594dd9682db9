"""Simple reflecting bodies: points, cylinders and boxes whose amplitudes are given as numbers.

Every body implements one function: which points reflect with which amplitude, given antenna positions. So
scenes mix bodies freely, and the renderer uses only points. Physical bodies are in `bodies`.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError
from tagid.types import Floats


@dataclass(frozen=True, eq=False)
class Returns:
    """Reflecting points for each view.

    Attributes:
        points: (views, k, 3) float64, m, in the frame of the body.
        amplitudes: (views, k) complex128; 1 is a unit reflector.
    """

    points: NDArray[np.float64]
    amplitudes: NDArray[np.complex128]


class Body(Protocol):
    """Anything that reflects, in its own frame."""

    def returns(self, antennas: Floats) -> Returns:
        """Reflecting points for antenna positions (views, 3) in m, in the body's frame."""


@dataclass(frozen=True, eq=False)
class Points:
    """Point reflectors, isotropic or with a facing direction.

    With a facing, the amplitude decreases with the angle psi between facing and antenna, both seen from
    above, as floor + (1 - floor) 2^-(2 psi / width)^2: halfway at half the width, floor on the far side.

    Attributes:
        positions: (n, 2) or (n, 3), m.
        amplitudes: (n,) real or complex.
        facing_rad: (n,) direction of the brightest side, rad; None or NaN for isotropic.
        aspect_width_rad: full width of the bright side, rad.
        aspect_floor: 0..1, relative amplitude on the far side.
    """

    positions: NDArray[np.floating]
    amplitudes: NDArray[np.number]
    facing_rad: NDArray[np.float64] | None = None
    aspect_width_rad: float = np.deg2rad(150.0)
    aspect_floor: float = 0.3

    def __post_init__(self) -> None:
        p = np.array(self.positions, dtype=np.float64)
        if p.ndim != 2 or p.shape[1] not in (2, 3) or not np.isfinite(p).all():
            raise DataError(f"reflector positions have shape {p.shape}, expected (n, 2) or (n, 3), finite")
        a = np.array(self.amplitudes, dtype=np.complex128)
        if a.shape != (len(p),) or not np.isfinite(a).all():
            raise DataError(f"reflector amplitudes have shape {a.shape}, expected ({len(p)},), finite")
        if self.facing_rad is not None and np.shape(self.facing_rad) != (len(p),):
            raise DataError(f"facing has shape {np.shape(self.facing_rad)}, expected ({len(p)},)")
        if not (self.aspect_width_rad > 0 and 0 <= self.aspect_floor <= 1):
            raise DataError("aspect width is not positive, or aspect floor is not in 0..1")
        if p.shape[1] == 2:
            p = np.concatenate([p, np.zeros((len(p), 1))], axis=1)
        object.__setattr__(self, "positions", p)
        object.__setattr__(self, "amplitudes", a)

    def single(self, index: int) -> Points:
        """One of the points, in the same class as the points."""
        point = copy(self)
        part = slice(index, index + 1)
        object.__setattr__(point, "positions", self.positions[part])
        object.__setattr__(point, "amplitudes", self.amplitudes[part])
        if self.facing_rad is not None:
            object.__setattr__(point, "facing_rad", self.facing_rad[part])
        return point

    def returns(self, antennas: Floats) -> Returns:
        """All points in every view; aspect changes the amplitude only."""
        views, n = len(antennas), len(self.positions)
        amplitudes = np.broadcast_to(self.amplitudes, (views, n)).astype(np.complex128)
        if self.facing_rad is not None:
            x, y = (antennas[:, None, i] - self.positions[None, :, i] for i in (0, 1))
            psi = (np.arctan2(y, x) - self.facing_rad + np.pi) % (2 * np.pi) - np.pi
            factor = self.aspect_floor + (1 - self.aspect_floor) * 2.0 ** -(
                (2 * psi / self.aspect_width_rad) ** 2
            )
            amplitudes *= np.where(np.isnan(self.facing_rad), 1.0, factor)
        points = np.broadcast_to(self.positions, (views, n, 3)).astype(np.float64)
        return Returns(points, amplitudes)


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder as a single specular return of constant amplitude from its nearest surface point.

    Creeping waves and back walls are not modelled; see `bodies.RoundBody`.

    Attributes:
        radius_m: m.
        amplitude: amplitude of the specular return.
        centre_m: (x, y) of its axis, m.
        height_m: full height, m; from above, the rim returns.
    """

    radius_m: float
    amplitude: float = 1.0
    centre_m: tuple[float, float] = (0.0, 0.0)
    height_m: float = 0.2

    def __post_init__(self) -> None:
        if not (np.isfinite(self.radius_m) and self.radius_m > 0 and self.height_m > 0):
            raise DataError(f"cylinder of radius {self.radius_m} m and height {self.height_m} m")

    def returns(self, antennas: Floats) -> Returns:
        """One point per view, on the line from the cylinder's axis to the antenna, at its height."""
        offset = antennas[:, :2] - np.asarray(self.centre_m)
        direction = offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-12)
        xy = np.asarray(self.centre_m) + self.radius_m * direction
        z = np.clip(antennas[:, 2:], -self.height_m / 2, self.height_m / 2)
        amplitudes = np.full((len(antennas), 1), self.amplitude, dtype=np.complex128)
        return Returns(np.concatenate([xy, z], axis=1)[:, None], amplitudes)


@dataclass(frozen=True)
class Box:
    """An upright metal box: a flash from a face at normal incidence, and weak returns from its four edges.

    A face returns from its point nearest the antenna. The amplitude falls as a Gaussian of the angle between
    the face's normal and the line of sight from that point, which is zero while the foot of the perpendicular
    lies on the face. A vertical edge is visible if one of its two faces is.

    Attributes:
        width_m, depth_m: sides along x and y before rotation, m.
        face_amplitude, edge_amplitude: amplitudes of a flash and of one edge.
        flash_width_rad: standard deviation of the flash, rad.
        centre_m: (x, y), m.
        rotation_rad: rotation about its centre, rad.
    """

    width_m: float
    depth_m: float
    face_amplitude: float = 3.0
    edge_amplitude: float = 0.5
    flash_width_rad: float = np.deg2rad(3.0)
    centre_m: tuple[float, float] = (0.0, 0.0)
    rotation_rad: float = 0.0

    def __post_init__(self) -> None:
        if not (self.width_m > 0 and self.depth_m > 0 and self.flash_width_rad > 0):
            raise DataError(f"box of {self.width_m} x {self.depth_m} m, flash {self.flash_width_rad} rad")

    def returns(self, antennas: Floats) -> Returns:
        """Eight points per view: four faces, then four edges; hidden ones have amplitude zero."""
        c, s = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        to_world = np.array([[c, -s], [s, c]])
        a = (antennas[:, :2] - np.asarray(self.centre_m)) @ to_world
        half = np.array([self.width_m / 2, self.depth_m / 2])
        normals = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
        # Nearest point of a face: the antenna clipped to the box, but fixed on the face along its normal.
        foot = np.clip(a[:, None], -half, half) * (normals == 0) + normals * half
        sight = a[:, None] - foot
        distance = np.linalg.norm(sight, axis=2)
        cosine = np.einsum("vfi,fi->vf", sight, normals) / np.maximum(distance, 1e-12)
        seen = cosine > 0
        off_normal = np.arccos(np.clip(cosine, -1, 1))
        face = self.face_amplitude * np.exp(-0.5 * (off_normal / self.flash_width_rad) ** 2) * seen
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half
        # Edge i is between faces i and i + 1.
        edge = self.edge_amplitude * (seen | np.roll(seen, -1, axis=1))
        xy = np.concatenate([foot, np.broadcast_to(corners, (len(a), 4, 2))], axis=1) @ to_world.T
        xy = xy + np.asarray(self.centre_m)
        points = np.concatenate([xy, np.zeros((len(a), 8, 1))], axis=2)
        return Returns(points, np.concatenate([face, edge], axis=1).astype(np.complex128))
