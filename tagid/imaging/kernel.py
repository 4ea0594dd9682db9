"""Range profiles read at the distance of every point, and the exact transpose, as fast as the machine can.

Backprojection, the forward operator and the tag reader are all these two sums; a small C extension does them
where a compiler was present at installation, numpy and scipy with the same arithmetic where not.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.geometry import Aperture
from tagid.imaging.memory import require_memory

if TYPE_CHECKING:
    from scipy import sparse

_compiled: Any
try:
    from tagid.imaging import _kernel as _compiled  # type: ignore[attr-defined, no-redef]
except ImportError:  # no compiler at installation
    _compiled = None
if getattr(_compiled, "ARGUMENTS", 0) != 2:  # built before the present source
    _compiled = None

MAX_THREADS = 8
MAX_BINS = 1 << 24
"""Range bins of one row: single precision counts no further."""

VIEWS_PER_BLOCK = 16
"""Views in one sparse block of the fallback: their rows (some 1000 bins each) stay in a core's cache."""

_PAIRS_PER_THREAD = 100_000
"""Pairs of view and point that repay the start of another thread (50 us)."""

_BYTES_PER_PAIR = 16
"""Two single-precision weights and two indices of the fallback's stored matrix."""


def is_compiled() -> bool:
    """True if the C extension runs; False where numpy and scipy stand in for it."""
    return _compiled is not None


@dataclass(frozen=True, eq=False)
class RangeGeometry:
    """Where points lie on the range grid of each view, in units of its step.

    Attributes:
        antenna: (views, 3) float32 antenna positions.
        second: (views, 3) float32 positions of the receiver where it is another antenna, else (0, 3).
        x, y: (points,) float32.
        z: (points,) float32 heights, or (0,) where all lie in the plane z = 0.
        start: range of the first bin.
        bins: bins of a row.
    """

    antenna: NDArray[np.float32]
    second: NDArray[np.float32]
    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]
    start: float
    bins: int

    @classmethod
    def of(
        cls,
        aperture: Aperture,
        points_m: NDArray[np.floating],
        range_m: tuple[float, float],
        bins: int,
    ) -> RangeGeometry:
        """Geometry of an aperture and of points (points, 2) in the plane z = 0 or (points, 3), in m.

        Args:
            aperture, points_m: see above.
            range_m: one-way range of the first bin, and between bins, m.
            bins: bins of a row, 2 to 2^24.

        Raises:
            UsageError: a number of bins that a row cannot have.
        """
        if not 2 <= bins <= MAX_BINS:
            raise UsageError(
                f"the points need {bins} fine range bins, 2 to {MAX_BINS} are possible",
                "Check the antenna positions (metres, in the object's frame) and the extent of the image.",
            )
        first, step = range_m
        antennas = [np.ascontiguousarray(each / step, dtype=np.float32) for each in aperture.antennas]
        second = antennas[1] if len(antennas) > 1 else np.zeros((0, 3), dtype=np.float32)
        place = [np.ascontiguousarray(axis / step, dtype=np.float32) for axis in np.asarray(points_m).T]
        z = place[2] if len(place) > 2 else np.zeros(0, dtype=np.float32)
        return cls(antennas[0], second, place[0], place[1], z, first / step, bins)

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.antenna)

    @property
    def points(self) -> int:
        """Number of points."""
        return len(self.x)

    def select(self, views: NDArray[np.integer] | slice) -> RangeGeometry:
        """The geometry of some views only, in the order given."""
        antenna = np.ascontiguousarray(self.antenna[views])
        second = np.ascontiguousarray(self.second[views]) if len(self.second) else self.second
        return replace(self, antenna=antenna, second=second)

    def among(self, points: NDArray[np.bool_]) -> RangeGeometry:
        """The geometry of some points only, (points,) bool."""
        z = self.z[points] if len(self.z) else self.z
        return replace(self, x=self.x[points], y=self.y[points], z=z)

    def gather(self, rows: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """out[p] = sum_v of row v at the distance of point p, by linear interpolation between bins.

        Args:
            rows: (views, bins) complex. Beyond its ends a row is continued by its first and last value.

        Returns:
            (points,) complex64.
        """
        z = np.ascontiguousarray(rows, dtype=np.complex64).reshape(self.views, self.bins)
        out = np.zeros(self.points, dtype=np.complex64)
        if _compiled is not None:
            place = (self.antenna, self.second, self.x, self.y, self.z)
            _compiled.gather(*place, z, out, self.bins, self.start, self._threads(self.points))
            return out
        parts = _as_pairs(z).reshape(self.views, self.bins, 2)
        total = np.zeros((self.points, 2), dtype=np.float32)
        for at, block in self._blocks():
            views = block.shape[0] // self.bins
            total += block.T @ parts[at : at + views].reshape(-1, 2)
        return np.ascontiguousarray(total).view(np.complex64).ravel()

    def scatter(self, values: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """The exact transpose of `gather`: (points,) complex -> (views, bins) complex64."""
        x = np.ascontiguousarray(values, dtype=np.complex64).reshape(self.points)
        out = np.empty((self.views, self.bins), dtype=np.complex64)
        if _compiled is not None:
            place = (self.antenna, self.second, self.x, self.y, self.z)
            _compiled.scatter(*place, x, out, self.bins, self.start, self._threads(self.views))
            return out
        for at, block in self._blocks():
            rows = np.ascontiguousarray(block @ _as_pairs(x)).view(np.complex64)
            out[at : at + block.shape[0] // self.bins] = rows.reshape(-1, self.bins)
        return out

    def matrix(self) -> sparse.csc_array[np.float32]:
        """`scatter` as a sparse matrix, CSC float32 (views * bins, points) with two entries a view and point.

        Raises:
            UsageError: it would not fit in memory.
        """
        from scipy import sparse

        return sparse.csc_array(sparse.vstack([block for _, block in self._blocks()], format="csc"))

    def _threads(self, parts: int) -> int:
        worth = self.views * self.points // _PAIRS_PER_THREAD + 1
        return max(1, min(cores(), worth, parts))

    def _blocks(self) -> list[tuple[int, sparse.csc_array[np.float32]]]:
        """First view and matrix of every block of the fallback."""
        return self._stored

    @cached_property
    def _stored(self) -> list[tuple[int, sparse.csc_array[np.float32]]]:
        require_memory(
            self.views * self.points * _BYTES_PER_PAIR,
            f"{self.views} views of {self.points} points",
            "Use fewer pixels or fewer views, or install a C compiler and tagid again: "
            "its compiled kernel stores nothing.",
        )
        starts = range(0, self.views, VIEWS_PER_BLOCK)
        return [(at, self._block(slice(at, at + VIEWS_PER_BLOCK))) for at in starts]

    def _block(self, some: slice) -> sparse.csc_array[np.float32]:
        """Matrix of some views; by columns, so that nothing needs sorting."""
        from scipy import sparse

        antenna, second = self.antenna[some], self.second[some]
        views, points = len(antenna), self.points
        index = np.empty((points, views, 2), dtype=np.int32)
        weight = np.empty((points, views, 2), dtype=np.float32)
        for v in range(views):
            t = self._ranges(antenna[v])
            if len(second):
                t = np.float32(0.5) * (t + self._ranges(second[v]))
            t -= np.float32(self.start)
            np.clip(t, np.float32(0), np.float32(self.bins - 1), out=t)
            whole = np.minimum(t, np.float32(self.bins - 2)).astype(np.int32)
            index[:, v, 0] = whole + v * self.bins
            weight[:, v, 1] = t - whole.astype(np.float32)
        np.add(index[..., 0], 1, out=index[..., 1])
        np.subtract(np.float32(1), weight[..., 1], out=weight[..., 0])
        starts = np.arange(0, index.size + 1, 2 * views, dtype=np.int32)
        parts: Any = (weight.ravel(), index.ravel(), starts)
        return sparse.csc_array(parts, shape=(views * self.bins, points))

    def _ranges(self, antenna: NDArray[np.float32]) -> NDArray[np.float32]:
        """(points,) distance from one antenna position (3,)."""
        ax, ay, az = antenna
        up = (self.z - az) ** 2 if len(self.z) else az * az
        return np.asarray(np.sqrt((self.x - ax) ** 2 + (self.y - ay) ** 2 + up), dtype=np.float32)


def cores() -> int:
    """Processors that this process may use, at most `MAX_THREADS`."""
    try:
        available = len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        available = os.cpu_count() or 1
    return min(available, MAX_THREADS)


def _as_pairs(values: NDArray[np.complex64]) -> NDArray[np.float32]:
    """Complex values as (n, 2) real ones, without a copy."""
    return values.reshape(-1, 1).view(np.float32)
