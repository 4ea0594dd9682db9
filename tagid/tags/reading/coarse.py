"""The matched field on a coarse grid, where the search for every layout begins.

It is formed once for each pattern and read at thousands of places: its cost does not grow with the registry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from tagid.tags.reading.aspect import Aspect, outward
from tagid.tags.reading.compiled import CoarseTables
from tagid.tags.reading.field import MatchedField, read

IMAGE_STEP_M = 3e-3
"""Pixel of the coarse image; its finest fringe is lambda_min / 2 = 31 mm: bilinear reading errs by < 5 %."""
_BLOCK = 1 << 16
"""Pairs of point and view that are formed at a time: half a megabyte of distances."""
COARSE_NO_SIDE_M = 0.015
"""On the coarse image sides are told from the turntable's axis, which is up to 14 mm off the object's."""


@dataclass(frozen=True, eq=False)
class CoarseDisc:
    """The pixels of a coarse image within a radius.

    Attributes:
        half: pixels from the middle to the edge; the image has 2 half + 1 a side.
        inside: (side, side) which pixels are formed.
        points: (points, 2) places of the pixels inside, m.
        facing: (points, 2) outward unit vectors from the turntable's axis.
    """

    half: int
    inside: NDArray[np.bool_]
    points: NDArray[np.float64]
    facing: NDArray[np.float64]

    @classmethod
    @lru_cache(maxsize=4)
    def of(cls, radius_m: float) -> CoarseDisc:
        """The disc of a radius, m, with what bilinear reading at its rim needs; those used last are kept."""
        half = int(np.ceil(radius_m / IMAGE_STEP_M)) + 1
        axis = np.arange(-half, half + 1) * IMAGE_STEP_M
        x, y = np.meshgrid(axis, axis)
        inside = x**2 + y**2 <= (radius_m + 2 * IMAGE_STEP_M) ** 2
        points = np.stack([x[inside], y[inside]], axis=-1)
        facing = outward(points, np.zeros(2), COARSE_NO_SIDE_M)
        points.flags.writeable = facing.flags.writeable = False
        return cls(half, inside, points, facing)


@dataclass(frozen=True, eq=False)
class CoarseValues:
    """What a coarse image holds.

    Attributes:
        static: (points, rank) mean over the views of the templates of the disc's points.
        images: (offsets, points) b of the disc's points at every range offset.
    """

    static: NDArray[np.complexfloating]
    images: NDArray[np.complexfloating]


@dataclass(frozen=True, eq=False)
class CoarseImage:
    """Complex image of b on a disc, read by bilinear interpolation.

    Attributes:
        disc: the pixels.
        aspect: pattern of the points.
        views: number of views.
        values: what it holds.
    """

    disc: CoarseDisc
    aspect: Aspect
    views: int
    values: CoarseValues

    @classmethod
    def of(
        cls, field: MatchedField, radius_m: float, aspect: Aspect, offsets_m: Sequence[float]
    ) -> CoarseImage:
        """The image of a matched field of one antenna height, on the disc of a radius, for range offsets, m.

        No template is formed, and the phase of an offset is common to all views.
        """
        disc, ranges, table = CoarseDisc.of(radius_m), field.ranges, field.table(field.data)
        static = np.empty((len(disc.points), ranges.profiles.shape[1]), dtype=np.complex64)
        images = np.empty((len(offsets_m), len(static)), dtype=np.complex128)
        size = max(1, _BLOCK // field.views)
        for at in range(0, len(static), size):
            here = slice(at, at + size)
            distances = field.distances(disc.points[here])
            weight = aspect.weight(field.antenna, disc.points[here], disc.facing[here])
            turn = ranges.phase(distances, weight)
            profiles = ranges.profiles.take(ranges.index(distances), axis=0, mode="clip")
            static[here] = np.matmul(turn[:, None], profiles)[:, 0] / field.views
            for i, offset in enumerate(offsets_m):
                images[i, here] = np.vecdot(turn, read(table, ranges.index(distances + offset)))
        images *= np.exp(2j * ranges.wavenumber * np.asarray(offsets_m))[:, None]
        return cls(disc, aspect, field.views, CoarseValues(static, images))

    @cached_property
    def tables(self) -> CoarseTables | None:
        """The image for the compiled loops; None where they were not compiled."""
        return CoarseTables.of(self.disc.inside, self.values.static, self.values.images)

    @cached_property
    def _static(self) -> NDArray[np.complex64]:
        """(side, side, rank) mean over the views of the templates of the pixels."""
        inside, static = self.disc.inside, self.values.static
        out = np.zeros((*inside.shape, static.shape[-1]), dtype=np.complex64)
        out[inside] = static
        return out

    @cached_property
    def _images(self) -> NDArray[np.complex64]:
        """(offsets, side * side) b of the pixels."""
        inside, images = self.disc.inside, self.values.images
        out = np.zeros((len(images), inside.size), dtype=np.complex64)
        out[:, inside.ravel()] = images
        return out

    def read(self, points: NDArray[np.float64]) -> NDArray[np.complex64]:
        """(offsets, ...) b at points (..., 2)."""
        half = self.disc.half
        position = (points / IMAGE_STEP_M + half).astype(np.float32)
        index = np.clip(position.astype(np.int32), 0, 2 * half - 1)
        part = position - index
        width = 2 * half + 1
        base = index[..., 1] * width + index[..., 0]
        flat = self._images
        fx, fy = part[..., 0], part[..., 1]
        low = flat[:, base] * (1 - fx) + flat[:, base + 1] * fx
        high = flat[:, base + width] * (1 - fx) + flat[:, base + width + 1] * fx
        return np.asarray(low * (1 - fy) + high * fy)

    def static_overlap(self, points: NDArray[np.float64]) -> NDArray[np.complex64]:
        """(..., K, K) part of the Gram matrix of points (..., K, 2), m, that is constant over the views.

        To the nearest pixel.
        """
        index = np.rint(points / IMAGE_STEP_M).astype(np.int32) + self.disc.half
        index = np.clip(index, 0, 2 * self.disc.half)
        static = self._static[index[..., 1], index[..., 0]]
        overlap: NDArray[np.complex64] = np.matmul(static.conj(), np.swapaxes(static, -1, -2))
        return overlap * self.views
