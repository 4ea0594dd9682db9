"""The antenna positions in the frame of the rotating object, and the image grid.

Operators take these frozen values. The sign convention of the rotation is defined only here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError, UsageError

SAME_HEIGHT_M = 1e-4
"""Antenna heights that differ by less are one."""


def views_of_heights(height_m: NDArray[np.float64]) -> list[NDArray[np.intp]]:
    """Views of each antenna height (views,), m, as `Aperture.height_groups`."""
    order = np.argsort(height_m, kind="stable")
    steps = np.flatnonzero(np.diff(height_m[order]) > SAME_HEIGHT_M) + 1
    groups = [np.sort(part) for part in np.split(order, steps)]
    return groups if min(map(len, groups)) > 1 else [np.arange(len(height_m))]


@dataclass(frozen=True, eq=False)
class Aperture:
    """Antenna positions in the object's frame, one per view.

    A radar with one antenna for both ways, or with two of them. The one-way range of a point p is
    d = (|p - t| + |p - r|) / 2 with the transmitter t and the receiver r, half of the way that the wave
    travels.

    Attributes:
        positions: (views, 3) float64, m: the antenna, or the middle between the two. The object's plane is
            z = 0, the rotation axis is the origin.
        angles: (views,) float64, rad, object angle counter-clockwise from above; None for free positions.
        axis_distance: horizontal distance from the axis to `positions`, m; None for free positions.
        height: antenna height above the object's plane, m.
        half_baseline: (views, 3) from `positions` to the transmitter, m; the receiver is as far on the other
            side. None for one antenna.
    """

    positions: NDArray[np.float64]
    angles: NDArray[np.float64] | None = None
    axis_distance: float | None = None
    height: float = 0.0
    half_baseline: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        if self.positions.ndim != 2 or self.positions.shape[1] != 3 or len(self.positions) == 0:
            raise DataError(f"antenna positions have shape {self.positions.shape}, expected (views, 3)")
        if not np.isfinite(self.positions).all():
            raise DataError("antenna positions are not finite")
        half = self.half_baseline
        if half is not None and (half.shape != self.positions.shape or not np.isfinite(half).all()):
            raise DataError(
                f"the baseline has shape {half.shape}, expected {self.positions.shape}, finite numbers"
            )

    @classmethod
    def turntable(
        cls,
        angles: NDArray[np.floating],
        axis_distance: float,
        height: float = 0.0,
        separation: float = 0.0,
    ) -> Aperture:
        """Aperture of a rotating object seen by a fixed radar at (axis_distance, 0, height).

        The object rotates by +angle (counter-clockwise from above), so in its own frame the antenna is at
        axis_distance * (cos(-angle), sin(-angle)).

        Args:
            angles: (views,) rad.
            axis_distance: m.
            height: m.
            separation: distance from the transmitting to the receiving antenna, m, which stand side by side
                at (axis_distance, +-separation / 2, height). 0: one antenna.

        >>> a = Aperture.turntable(np.array([0.0, np.pi / 2]), 1.0)
        >>> (np.round(a.positions, 6) + 0.0).tolist()
        [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
        """
        turn: NDArray[np.float64] = np.asarray(angles, dtype=np.float64)
        if not np.isfinite(axis_distance) or axis_distance <= 0:
            raise DataError(f"axis distance is {axis_distance} m, expected a positive number")
        positions = np.stack(
            [axis_distance * np.cos(-turn), axis_distance * np.sin(-turn), np.full(turn.shape, height)],
            axis=1,
        )
        if separation == 0:
            return cls(positions, turn, float(axis_distance), float(height))
        aside = np.stack([-np.sin(-turn), np.cos(-turn), np.zeros(turn.shape)], axis=1)
        return cls(positions, turn, float(axis_distance), float(height), separation / 2 * aside)

    @classmethod
    def two_antennas(cls, transmitters: NDArray[np.floating], receivers: NDArray[np.floating]) -> Aperture:
        """Free positions (views, 3) of a transmitting and a receiving antenna, m."""
        transmit, receive = (np.asarray(p, dtype=np.float64) for p in (transmitters, receivers))
        if transmit.shape != receive.shape:
            raise DataError(f"transmitters have shape {transmit.shape}, receivers {receive.shape}")
        return cls((transmit + receive) / 2, half_baseline=(transmit - receive) / 2)

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.positions)

    @property
    def separation(self) -> float:
        """Mean distance between the two antennas, m; 0 for one."""
        if self.half_baseline is None:
            return 0.0
        return float(2 * np.linalg.norm(self.half_baseline, axis=1).mean())

    @property
    def antennas(self) -> tuple[NDArray[np.float64], ...]:
        """(views, 3) positions of the transmitter and of the receiver, m; of the one antenna that is both."""
        if self.half_baseline is None:
            return (self.positions,)
        return self.positions + self.half_baseline, self.positions - self.half_baseline

    def distances(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """(views, points) one-way range of points (points, 2) in the plane z = 0 or (points, 3), m."""
        there = np.asarray(points, dtype=np.float64)
        if there.shape[1] == 2:
            there = np.column_stack([there, np.zeros(len(there))])
        ways = [np.linalg.norm(antenna[:, None] - there[None], axis=2) for antenna in self.antennas]
        return np.asarray(sum(ways) / len(ways), dtype=np.float64)

    def span(
        self, radius: float, heights: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(views,) least and greatest one-way range that an upright cylinder about the origin can have, m.

        Args:
            radius: of the cylinder, m.
            heights: z of its bottom and of its top, m.
        """
        near, far = [], []
        for antenna in self.antennas:
            across = np.hypot(antenna[:, 0], antenna[:, 1])
            below, above = antenna[:, 2] - heights[0], antenna[:, 2] - heights[1]
            least = np.where(below * above <= 0, 0.0, np.minimum(np.abs(below), np.abs(above)))
            near.append(np.hypot(np.maximum(across - radius, 0), least))
            far.append(np.hypot(across + radius, np.maximum(np.abs(below), np.abs(above))))
        return np.mean(near, axis=0), np.mean(far, axis=0)

    def height_groups(self) -> list[NDArray[np.intp]]:
        """Views of each antenna height, lowest first; all views as one group if a height has only one.

        >>> two = Aperture(np.array([[1.0, 0, 0], [1, 0, 1], [0, 1, 1], [0, 1, 0]]))
        >>> [views.tolist() for views in two.height_groups()]
        [[0, 3], [1, 2]]
        """
        return views_of_heights(self.positions[:, 2])

    def with_axis_distance(self, axis_distance: float) -> Aperture:
        """The same rotation seen from another distance. Raises DataError for free positions."""
        if self.angles is None:
            raise DataError("the axis distance of free antenna positions is not defined")
        return self.turned(self.angles, axis_distance)

    def turned(self, angles: NDArray[np.floating], axis_distance: float) -> Aperture:
        """The turntable of the same antennas under other angles (views,), rad, and another distance, m."""
        return Aperture.turntable(angles, axis_distance, self.height, self.separation)

    def select(self, views: NDArray[np.integer] | slice) -> Aperture:
        """The aperture of selected views."""
        angles = None if self.angles is None else self.angles[views]
        half = None if self.half_baseline is None else self.half_baseline[views]
        return Aperture(self.positions[views], angles, self.axis_distance, self.height, half)


MOST_PIXELS = 4096
"""Pixels per side of an image at most."""


@dataclass(frozen=True)
class ImageGrid:
    """A square image centred on the rotation axis.

    Attributes:
        extent: side of the square, m.
        pixels: pixels per side; pixel centres are at ((i + 0.5) / pixels - 0.5) * extent.
    """

    extent: float = 0.5
    pixels: int = 128

    def __post_init__(self) -> None:
        if not (np.isfinite(self.extent) and self.extent > 0):
            raise UsageError(f"image extent is {self.extent} m", "Give a positive side in metres.")
        if not 2 <= self.pixels <= MOST_PIXELS:
            raise UsageError(f"image has {self.pixels} pixels per side", f"Give 2 to {MOST_PIXELS} pixels.")

    @property
    def step(self) -> float:
        """Pixel pitch, m."""
        return self.extent / self.pixels

    @property
    def axis(self) -> NDArray[np.float64]:
        """(pixels,) pixel centres along x or y, m."""
        return ((np.arange(self.pixels) + 0.5) / self.pixels - 0.5) * self.extent

    @property
    def points(self) -> NDArray[np.float64]:
        """(pixels * pixels, 2) pixel centres (x, y), m, in row-major (y, x) order."""
        x, y = np.meshgrid(self.axis, self.axis)
        return np.stack([x.ravel(), y.ravel()], axis=1)


@dataclass(frozen=True)
class VolumeGrid:
    """Voxels: squares as of an `ImageGrid`, stacked between two heights.

    Attributes:
        square: pixels of a level.
        bottom, top: heights of the lower face of the lowest level and of the upper face of the highest, m.
        levels: number of levels; their centres are at bottom + (i + 0.5) (top - bottom) / levels.
    """

    square: ImageGrid
    bottom: float
    top: float
    levels: int

    def __post_init__(self) -> None:
        if not (np.isfinite([self.bottom, self.top]).all() and self.bottom < self.top):
            raise UsageError(
                f"the volume reaches from {self.bottom} m to {self.top} m", "Give LOW,HIGH in metres."
            )
        if not 1 <= self.levels <= 4096:
            raise UsageError(f"the volume has {self.levels} levels", "Give 1 to 4096.")

    @property
    def rise(self) -> float:
        """Height of a voxel, m."""
        return (self.top - self.bottom) / self.levels

    @property
    def heights(self) -> NDArray[np.float64]:
        """(levels,) centres along z, m."""
        return np.asarray(self.bottom + (np.arange(self.levels) + 0.5) * self.rise, dtype=np.float64)

    @property
    def voxels(self) -> int:
        """Number of voxels."""
        return self.levels * self.square.pixels**2

    def points(self, levels: slice = slice(None)) -> NDArray[np.float64]:
        """(n, 3) voxel centres (x, y, z) of some levels, m, in row-major (z, y, x) order."""
        plane, heights = self.square.points, self.heights[levels]
        return np.column_stack([np.tile(plane, (len(heights), 1)), np.repeat(heights, len(plane))])
