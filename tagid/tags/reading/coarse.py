"""The matched field on a coarse grid, from which the search for every layout starts.

The grid is computed once per pattern and interpolated at thousands of places, so its cost does not grow with
the registry.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tagid.tags.reading.aspect import Aspect, outward
from tagid.tags.reading.field import MatchedField

IMAGE_STEP_M = 3e-3
"""Pixel of the coarse image. Its finest fringe is lambda_min / 2 = 31 mm; the bilinear interpolation error is
< 5 %."""
COARSE_NO_SIDE_M = 0.015
"""As `NO_SIDE_M`, for the coarse image: it takes outward sides relative to the turntable's axis, which is up
to 14 mm from the object's."""


class CoarseImage:
    """Complex image of b on a square, with bilinear interpolation."""

    def __init__(self, field: MatchedField, radius_m: float, aspect: Aspect, offsets_m: Sequence[float]):
        half = int(np.ceil(radius_m / IMAGE_STEP_M)) + 1
        self.half = half
        self.axis = np.arange(-half, half + 1) * IMAGE_STEP_M
        x, y = np.meshgrid(self.axis, self.axis)
        inside = x**2 + y**2 <= (radius_m + 2 * IMAGE_STEP_M) ** 2
        points = np.stack([x[inside], y[inside]], axis=-1)
        distances = field.distances(points)
        weight = aspect.weight(field, points, outward(points, np.zeros(2), COARSE_NO_SIDE_M))
        self.field = field
        self.aspect = aspect
        static = field.static_part(distances, weight)
        self.static = np.zeros((*inside.shape, static.shape[-1]), dtype=np.complex64)
        self.static[inside] = static
        self.images = np.zeros((len(offsets_m), *inside.shape), dtype=np.complex64)
        self.images[:, inside] = field.correlate_offsets(distances, offsets_m, weight)

    def static_overlap(self, points: NDArray[np.float64]) -> NDArray[np.complex64]:
        """(..., K, K) part of the Gram matrix that is constant over the views, at the nearest pixels."""
        index = np.rint(points / IMAGE_STEP_M).astype(np.int32) + self.half
        index = np.clip(index, 0, 2 * self.half)
        static = self.static[index[..., 1], index[..., 0]]
        overlap: NDArray[np.complex64] = np.matmul(static.conj(), np.swapaxes(static, -1, -2))
        return overlap * self.field.views

    def read(self, points: NDArray[np.float64]) -> NDArray[np.complex64]:
        """(offsets, ...) interpolated b at points (..., 2), m."""
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
