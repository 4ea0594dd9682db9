"""Range profiles read at the distance of every point, and the exact transpose, as fast as the machine can.

Backprojection, the forward operator and the tag reader are all these two sums; a small C extension does them
where a compiler was present at installation, numpy with the same arithmetic where not.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.geometry import Aperture
from tagid.imaging.memory import require_memory
from tagid.loops import loop
from tagid.types import Samples

_compiled = loop("tagid.imaging._kernel")

MAX_THREADS = 8
MAX_BINS = 1 << 24
"""Range bins of one row: single precision counts no further."""

_PAIRS_PER_THREAD = 100_000
"""Pairs of view and point that repay the start of another thread (50 us)."""

_BYTES_PER_PAIR = 8
"""Index and single-precision weight of the fallback."""

_MOST_STORED = 1 << 25
"""Pairs of view and point whose places are kept in double precision; more are computed again each time."""


FAR = 2.0**20
"""Steps to an antenna from which on a distance is computed in double precision, by numpy: in single precision
it is rounded to an eighth of a step there, and the phases of a flight at 10 km to stripes."""


def is_compiled() -> bool:
    """True if the C extension runs; False where numpy stands in for it."""
    return _compiled is not None


@dataclass(frozen=True, eq=False)
class RangeGeometry:
    """Where points lie on the range grid of each view, in units of its step.

    Attributes:
        antenna: (views, 3) antenna positions, float32, or float64 where one is `FAR`.
        second: (views, 3) positions of the receiver where it is another antenna, else (0, 3).
        x, y: (points,) float32.
        z: (points,) float32 heights, or (0,) where all lie in the plane z = 0.
        start: range of the first bin.
    """

    antenna: NDArray[np.floating]
    second: NDArray[np.floating]
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
        """Geometry of an aperture and of points (points, 2) in the plane z = 0 or (points, 3), in m, on rows
        of `bins` bins that begin at the one-way range range_m[0], range_m[1] apart, m. Raises UsageError for
        a number of bins that a row cannot have, 2 to 2^24.
        """
        if not 2 <= bins <= MAX_BINS:
            raise UsageError(
                f"the points need {bins} fine range bins, 2 to {MAX_BINS} are possible",
                "Check the antenna positions (metres, in the object's frame) and the extent of the image.",
            )
        first, step = range_m
        farthest = max(float(np.abs(antenna).max()) for antenna in aperture.antennas)
        exact: type[np.floating] = np.float64 if farthest > FAR * step else np.float32
        antennas = [np.ascontiguousarray(antenna / step, dtype=exact) for antenna in aperture.antennas]
        second = antennas[1] if len(antennas) > 1 else np.zeros((0, 3), dtype=exact)
        place = [np.ascontiguousarray(axis / step, dtype=np.float32) for axis in np.asarray(points_m).T]
        z = place[2] if len(place) > 2 else np.zeros(0, dtype=np.float32)
        return cls(antennas[0], second, place[0], place[1], z, first / step, bins)

    @property
    def views(self) -> int:
        return len(self.antenna)

    @property
    def _in_single(self) -> bool:
        """Whether single precision, which the C extension counts in, is enough."""
        return self.antenna.dtype == np.float32

    @property
    def points(self) -> int:
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

    def gather(self, rows: NDArray[np.complexfloating]) -> Samples:
        """(points,) complex64 sum_v of row v at the distance of every point, by linear interpolation between
        bins.

        Beyond its ends a row (bins,) is continued by its first and last value.
        """
        z = np.ascontiguousarray(rows, dtype=np.complex64).reshape(self.views, self.bins)
        out = np.zeros(self.points, dtype=np.complex64)
        if _compiled is not None and self._in_single:
            place = self.antenna, self.second, self.x, self.y, self.z
            _compiled.gather(*place, z, out, self.bins, self.start, self._threads(self.points))
        else:
            for view, (bin_, part) in enumerate(self._places()):
                left = z[view].take(bin_)
                out += left + part * (z[view].take(bin_ + 1) - left)
        return out

    def scatter(self, values: NDArray[np.complexfloating]) -> Samples:
        """The exact transpose of `gather`: (points,) complex -> (views, bins) complex64."""
        x = np.ascontiguousarray(values, dtype=np.complex64).reshape(self.points)
        out = np.zeros((self.views, self.bins), dtype=np.complex64)
        if _compiled is not None and self._in_single:
            place = self.antenna, self.second, self.x, self.y, self.z
            _compiled.scatter(*place, x, out, self.bins, self.start, self._threads(self.views))
            return out
        for row, (bin_, part) in zip(out, self._places(), strict=True):
            for weight, first in ((1 - part, 0), (part, 1)):
                for side, target in ((x.real, row.real), (x.imag, row.imag)):
                    target[first : first + self.bins - 1] += np.bincount(bin_, weight * side, self.bins - 1)
        return out

    def _threads(self, parts: int) -> int:
        worth = min(self.views * self.points // _PAIRS_PER_THREAD + 1, parts)
        return max(1, min(cores(), worth)) if worth > 1 else 1

    def _places(self) -> Iterable[tuple[NDArray[np.int32], NDArray[np.float32]]]:
        """Bin (points,) before every point, and its place between that and the next, for each view."""
        if not self._in_single and self.views * self.points > _MOST_STORED:
            return (self._place(view) for view in range(self.views))
        return self._stored

    @cached_property
    def _stored(self) -> list[tuple[NDArray[np.int32], NDArray[np.float32]]]:
        require_memory(
            self.views * self.points * _BYTES_PER_PAIR,
            f"{self.views} views of {self.points} points",
            "Use fewer pixels or fewer views, or install a C compiler and tagid again: "
            "its compiled kernel stores nothing.",
        )
        return [self._place(view) for view in range(self.views)]

    def _place(self, view: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        t = self._ranges(self.antenna[view])
        if len(self.second):
            t = np.float32(0.5) * (t + self._ranges(self.second[view]))
        # In double precision until the common part of all ranges is off.
        t = np.asarray(t - t.dtype.type(self.start), dtype=np.float32)
        np.clip(t, np.float32(0), np.float32(self.bins - 1), out=t)
        whole = np.minimum(t, np.float32(self.bins - 2)).astype(np.int32)
        return whole, t - whole.astype(np.float32)

    def _ranges(self, antenna: NDArray[np.floating]) -> NDArray[np.floating]:
        """(points,) distance from one antenna position (3,)."""
        ax, ay, az = antenna
        up = (self.z - az) ** 2 if len(self.z) else az * az
        return np.asarray(np.sqrt((self.x - ax) ** 2 + (self.y - ay) ** 2 + up), dtype=antenna.dtype)


def cores() -> int:
    """Processors that this process may use, at most `MAX_THREADS`."""
    try:
        available = len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        available = os.cpu_count() or 1
    return min(available, MAX_THREADS)
