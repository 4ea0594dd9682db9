"""The matched field on a coarse grid, where the search for every layout begins.

It is formed once for each pattern and read at thousands of places: its cost does not grow with the registry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tagid.tags.reading.aspect import Aspect, outward
from tagid.tags.reading.compiled import CoarseTables
from tagid.tags.reading.field import CoarseParts, MatchedField

Array = TypeVar("Array", bound=NDArray[Any])

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
    """

    half: int
    inside: NDArray[np.bool_]

    @classmethod
    @lru_cache(maxsize=4)
    def of(cls, radius_m: float) -> CoarseDisc:
        """The disc of a radius, m, with what bilinear reading at its rim needs; those used last are kept."""
        half = int(np.ceil(radius_m / IMAGE_STEP_M)) + 1
        axis = np.arange(-half, half + 1) * IMAGE_STEP_M
        x, y = np.meshgrid(axis, axis)
        return cls(half, x**2 + y**2 <= (radius_m + 2 * IMAGE_STEP_M) ** 2)

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """(points, 2) places of the pixels inside, m."""
        row, column = np.nonzero(self.inside)
        places = np.stack([column - self.half, row - self.half], axis=-1)
        return _kept(np.asarray(places * IMAGE_STEP_M, dtype=np.float64))

    @cached_property
    def facing(self) -> NDArray[np.float64]:
        """(points, 2) outward unit vectors from the turntable's axis."""
        return _kept(outward(self.points, np.zeros(2), COARSE_NO_SIDE_M))

    @cached_property
    def pixel(self) -> NDArray[np.int32]:
        """(points,) number of the pixel of every point."""
        return _kept(np.flatnonzero(self.inside).astype(np.int32))


@dataclass(frozen=True, eq=False)
class CoarseValues:
    """What a coarse image holds.

    Attributes:
        static: (points, rank) mean over the views of the templates of the disc's points.
        images: (offsets, points) b of the disc's points at every range offset.
    """

    static: NDArray[np.complexfloating]
    images: NDArray[np.complexfloating]

    @classmethod
    def of(cls, tables: CoarseTables, disc: CoarseDisc) -> CoarseValues:
        """The values that compiled loops have formed."""
        static, images = (
            part.reshape(-1, *part.shape[2:])[disc.pixel, :, :count]
            for part, count in ((tables.static, tables.rank), (tables.images, tables.offsets))
        )
        return cls(static[:, 0] + 1j * static[:, 1], (images[:, 0] + 1j * images[:, 1]).T)


class CoarseImage:
    """Complex image of b on a disc, read by bilinear interpolation.

    Args:
        disc: the pixels.
        aspect: pattern of the points.
        views: number of views.
        made: the values, or the tables that compiled loops have formed.
    """

    def __init__(
        self, disc: CoarseDisc, aspect: Aspect, views: int, made: CoarseValues | CoarseTables
    ) -> None:
        self.half = disc.half
        self.aspect = aspect
        self.views = views
        self._disc = disc
        self._made = made

    @classmethod
    def of(
        cls, field: MatchedField, radius_m: float, aspect: Aspect, offsets_m: Sequence[float]
    ) -> CoarseImage:
        """The image of a matched field on the disc of a radius, m, for range offsets, m."""
        return cls.of_each(field, radius_m, (aspect,), offsets_m)[0]

    @classmethod
    def of_each(
        cls,
        field: MatchedField,
        radius_m: float,
        aspects: Sequence[Aspect],
        offsets_m: Sequence[float],
        height_m: float = 0.0,
    ) -> list[CoarseImage]:
        """The images at a height, m, for several patterns, which share the distances."""
        disc = CoarseDisc.of(radius_m)
        points = disc.points
        if field.tables is not None and not field.several_heights:
            places = np.column_stack([points, np.full(len(points), height_m)])
            patterns = [one.numbers for one in aspects]
            made = field.tables.coarse(places, disc.facing, disc.pixel, len(disc.inside), patterns, offsets_m)
            return [cls(disc, one, field.views, own) for one, own in zip(aspects, made, strict=True)]
        parts: list[list[CoarseParts]] = []
        size = max(1, _BLOCK // field.views)
        for at in range(0, len(points), size):
            some, facing = points[at : at + size], disc.facing[at : at + size]
            weights = [aspect.weight(field.antenna, some, facing) for aspect in aspects]
            parts.append(field.coarse_parts(field.distances(some, height_m), weights, offsets_m))
        return [
            cls(
                disc,
                aspect,
                field.views,
                CoarseValues(
                    np.concatenate([part.static for part in own]),
                    np.concatenate([part.images for part in own], axis=1),
                ),
            )
            for aspect, own in zip(aspects, zip(*parts, strict=True), strict=True)
        ]

    @cached_property
    def _values(self) -> CoarseValues:
        return self._made if isinstance(self._made, CoarseValues) else CoarseValues.of(self._made, self._disc)

    @cached_property
    def static(self) -> NDArray[np.complex64]:
        """(side, side, rank) mean over the views of the templates of the pixels."""
        inside, static = self._disc.inside, self._values.static
        out = np.zeros((*inside.shape, static.shape[-1]), dtype=np.complex64)
        out[inside] = static
        return out

    @cached_property
    def images(self) -> NDArray[np.complex64]:
        """(offsets, side, side) b of the pixels."""
        inside, images = self._disc.inside, self._values.images
        out = np.zeros((len(images), *inside.shape), dtype=np.complex64)
        out[:, inside] = images
        return out

    @cached_property
    def tables(self) -> CoarseTables:
        """The image for the compiled loops."""
        if isinstance(self._made, CoarseTables):
            return self._made
        return CoarseTables.of(self._disc.inside, self._made.static, self._made.images)

    def static_at(self, points: NDArray[np.float64]) -> NDArray[np.complex64]:
        """(..., rank) static part of the templates at points (..., 2), to the nearest pixel."""
        index = np.rint(points / IMAGE_STEP_M).astype(np.int32) + self.half
        index = np.clip(index, 0, 2 * self.half)
        return self.static[index[..., 1], index[..., 0]]

    def read(self, points: NDArray[np.float64]) -> NDArray[np.complex64]:
        """(offsets, ...) b at points (..., 2)."""
        position = (points / IMAGE_STEP_M + self.half).astype(np.float32)
        index = np.clip(position.astype(np.int32), 0, 2 * self.half - 1)
        part = position - index
        width = 2 * self.half + 1
        base = index[..., 1] * width + index[..., 0]
        flat = self.images.reshape(len(self.images), -1)
        fx, fy = part[..., 0], part[..., 1]
        low = flat[:, base] * (1 - fx) + flat[:, base + 1] * fx
        high = flat[:, base + width] * (1 - fx) + flat[:, base + width + 1] * fx
        return np.asarray(low * (1 - fy) + high * fy)


def static_overlap(rows: Sequence[CoarseImage], points: NDArray[np.float64]) -> NDArray[np.complex64]:
    """(..., K, K) part of the Gram matrix of points (..., K, 2) that is constant over the views.

    Args:
        rows: the image at the height of each of the K points.
        points: m.
    """
    if all(image is rows[0] for image in rows):
        static = rows[0].static_at(points)
    else:
        static = np.stack([image.static_at(points[..., k, :]) for k, image in enumerate(rows)], axis=-2)
    overlap: NDArray[np.complex64] = np.matmul(static.conj(), np.swapaxes(static, -1, -2))
    return overlap * rows[0].views


def _kept(values: Array) -> Array:
    """Values that many images share."""
    values.flags.writeable = False
    return values
