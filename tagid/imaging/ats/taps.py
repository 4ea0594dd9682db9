"""Features of pixels from those of the vertices about them, the transpose, and Adam's update.

A small C extension does them where a compiler was present at installation, numpy where not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tagid.loops import loop

Array = NDArray[np.float32]

BETA1, BETA2 = 0.9, 0.95
"""Decay of Adam's moments (Kingma and Ba, ICLR 2015); Müller et al. take 0.99 for the second."""
EPSILON = 0.1
"""Adam's, relative to the largest gradient of a tensor: with 0.01 and less rounding and noise move quiet
pixels as fast as bright ones, with 0.3 and more faint false points are not drawn to zero in time."""
SMALLEST = 1e-20
"""Keeps a tensor without gradient where it is."""

_compiled = loop("tagid.imaging.ats._field")


@dataclass(frozen=True, eq=False)
class Taps:
    """The four vertices about every pixel, on every level.

    Attributes:
        index: (n, levels, 4) int32 vertices, counted through all levels.
        weight: (n, levels, 4) float32 bilinear weights.
        vertices: of all levels together.
    """

    index: NDArray[np.int32]
    weight: Array
    vertices: int

    @classmethod
    def of(cls, pixels: int, cells: list[int], wanted: NDArray[np.integer] | None = None) -> Taps:
        """Taps of the pixel centres of a square grid of `pixels` a side, all or the `wanted` ones
        (row-major), on levels of `cells` a side, which have cells + 1 vertices.
        """
        every = _every_tap(pixels, tuple(cells))
        return every if wanted is None else cls(every.index[wanted], every.weight[wanted], every.vertices)

    def interpolate(self, table: Array, out: Array) -> None:
        """Features of the pixels, into `out` (n, levels * features), from those of all vertices, (vertices,
        features), float32.
        """
        if _compiled is None:
            near = self.weight[..., None] * table[self.index]
            out[:] = near.sum(axis=2).reshape(out.shape)
        else:
            _compiled.interpolate(self.index, self.weight, table, out, table.shape[1])

    def accumulate(self, slope: Array, out: Array) -> None:
        """The transpose of `interpolate`: from slope (n, levels * features) to out (vertices, features)."""
        if _compiled is None:
            at, parts = self.index.ravel(), slope.reshape(*self.index.shape[:2], -1)
            for feature, sums in enumerate(out.T):
                shares = self.weight * parts[..., feature, None]
                sums[:] = np.bincount(at, shares.ravel(), self.vertices)
        else:
            _compiled.accumulate(self.index, self.weight, slope, out, out.shape[1])


@lru_cache(maxsize=2)
def _every_tap(pixels: int, cells: tuple[int, ...]) -> Taps:
    """Taps of all pixels; all fits of an image share them."""
    y, x = np.divmod(np.arange(pixels * pixels), pixels)
    index = np.empty((len(x), len(cells), 4), dtype=np.int32)
    weight = np.empty((len(x), len(cells), 4), dtype=np.float32)
    first = 0
    for level, count in enumerate(cells):
        at = (np.arange(pixels) + 0.5) / pixels * count
        corner = np.minimum(at.astype(np.int32), count - 1)
        part = (at - corner).astype(np.float32)
        low = first + corner[y] * (count + 1) + corner[x]
        across, up = part[x], part[y]
        for tap, offset in enumerate((0, 1, count + 1, count + 2)):
            index[:, level, tap] = low + offset
            weight[:, level, tap] = (across if tap % 2 else 1 - across) * (up if tap > 1 else 1 - up)
        first += (count + 1) ** 2
    index.flags.writeable = weight.flags.writeable = False
    return Taps(index, weight, first)


@dataclass(eq=False)
class Adam:
    """Adam's state for tensors that follow each other in one array (Kingma and Ba, ICLR 2015).

    Its epsilon is relative to the largest gradient of each tensor, as in the graph.

    Attributes:
        sizes: (tensors,) int64 parameters of every tensor.
        first, second: (parameters,) float32 moments.
    """

    sizes: NDArray[np.int64]
    first: Array
    second: Array

    @classmethod
    def of(cls, sizes: list[int]) -> Adam:
        """Before the first step."""
        zeros = np.zeros((2, sum(sizes)), dtype=np.float32)
        return cls(np.array(sizes, dtype=np.int64), zeros[0], zeros[1])

    def update(
        self, parameters: Array, gradient: Array, rates: Array, correction: float, epsilon: float
    ) -> None:
        """One step, in place; `gradient` (parameters,) is scratch afterwards.

        `rates`, (tensors,) float32, hold the first moment's bias correction, `correction` is the second's,
        and `epsilon` is relative to the largest gradient of a tensor.
        """
        if _compiled is not None:
            numbers = (BETA1, BETA2, float(correction), float(epsilon), SMALLEST)
            _compiled.adam(parameters, gradient, self.first, self.second, self.sizes, rates, *numbers)
            return
        m, v = self.first, self.second
        m *= np.float32(BETA1)
        m += np.float32(1 - BETA1) * gradient
        v *= np.float32(BETA2)
        v += np.float32(1 - BETA2) * gradient * gradient
        size = np.sqrt(v * np.float32(correction))
        starts = np.concatenate([[0], np.cumsum(self.sizes)[:-1]])
        largest = np.maximum.reduceat(size, starts)
        added = (np.float32(epsilon) * largest + np.float32(SMALLEST)).astype(np.float32)
        parameters -= np.repeat(rates, self.sizes) * m / (size + np.repeat(added, self.sizes))


CHECK_AT = (0.1, 0.25, 0.45, 0.65)
"""Parts of the steps after which the pixels are chosen again."""

_FIRST_SHARE = 0.1
"""Backprojection over its maximum from which a pixel takes part in the first steps."""

_FAINT = 0.02
"""Part of the brightest pixel under which a pixel that the data do not ask for is dropped."""

_ASKING = 0.5
"""Part of the largest correlation with the residual from which a pixel joins: what is fainter may be a
sidelobe of what the fit has not explained yet, and is looked at again in the next check."""

_MOST_SHARE = 0.9
"""With more than this share of the pixels chosen, all are: a smaller step would save nothing."""


def first_support(
    strength: NDArray[np.floating], first: NDArray[np.floating], weight: float
) -> NDArray[np.bool_]:
    """(pixels, pixels) whether the first steps work on a pixel: where backprojection is bright, and in the
    first image; others are zero. `strength` is |A^H y|, `first` the magnitude of that image, both (pixels,
    pixels), and `weight` that of the sparsity prior beside 1/2 ||A sigma - y||^2.
    """
    bright = strength > max(weight, _FIRST_SHARE * float(strength.max()))
    return _with_neighbours(bright | (first > _FAINT * float(first.max())))


def next_support(
    magnitude: NDArray[np.floating], strength: NDArray[np.floating], weight: float
) -> NDArray[np.bool_]:
    """Pixels after a check: the bright ones, those that the residual asks for, and their neighbours.
    `magnitude` is |sigma|, zero outside the present support, `strength` |A^H (y - A sigma)|; the rest as
    `first_support`.
    """
    bright = magnitude > _FAINT * float(magnitude.max())
    return _with_neighbours(bright | (strength > max(weight, _ASKING * float(strength.max()))))


def _with_neighbours(wanted: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Also the eight about every pixel; all, where these are none or nearly all."""
    wide = np.pad(wanted, 1)
    rows = wide[:-2] | wide[1:-1] | wide[2:]
    mask = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
    return mask if mask.any() and mask.mean() <= _MOST_SHARE else np.ones_like(mask)
