"""The antenna positions in the frame of the rotating object, and the image grid.

Operators take these frozen values. The sign convention of the rotation is defined only here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError, UsageError


@dataclass(frozen=True, eq=False)
class Aperture:
    """Antenna positions in the object's frame, one per view.

    Attributes:
        positions: (views, 3) float64, m. The object's plane is z = 0, the rotation axis is the origin.
        angles: (views,) float64, rad, object angle counter-clockwise from above; None for free positions.
        axis_distance: horizontal distance from the axis to the antenna, m; None for free positions.
        height: antenna height above the object's plane, m.
    """

    positions: NDArray[np.float64]
    angles: NDArray[np.float64] | None = None
    axis_distance: float | None = None
    height: float = 0.0

    def __post_init__(self) -> None:
        if self.positions.ndim != 2 or self.positions.shape[1] != 3 or len(self.positions) == 0:
            raise DataError(f"antenna positions have shape {self.positions.shape}, expected (views, 3)")
        if not np.isfinite(self.positions).all():
            raise DataError("antenna positions are not finite")

    @classmethod
    def turntable(cls, angles: NDArray[np.floating], axis_distance: float, height: float = 0.0) -> Aperture:
        """Aperture of a rotating object seen by a fixed radar at (axis_distance, 0, height).

        The object rotates by +angle (counter-clockwise from above), so in its own frame the antenna is at
        axis_distance * (cos(-angle), sin(-angle)).

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
        return cls(positions, turn, float(axis_distance), float(height))

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.positions)

    def with_axis_distance(self, axis_distance: float) -> Aperture:
        """The same rotation seen from another distance. Raises DataError for free positions."""
        if self.angles is None:
            raise DataError("the axis distance of free antenna positions is not defined")
        return Aperture.turntable(self.angles, axis_distance, self.height)

    def select(self, views: NDArray[np.integer] | slice) -> Aperture:
        """The aperture of selected views."""
        angles = None if self.angles is None else self.angles[views]
        return Aperture(self.positions[views], angles, self.axis_distance, self.height)


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
        if not 2 <= self.pixels <= 4096:
            raise UsageError(f"image has {self.pixels} pixels per side", "Give 2 to 4096 pixels.")

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
