"""Multi-resolution hash encoding of pixel coordinates (Müller et al., "Instant NGP", SIGGRAPH 2022).

For fixed points the interpolation weights never change, so their encoding is one sparse matrix that is built
once; a step then costs one product forward and one with the transpose for the gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse

_HASH_PRIME = 2_654_435_761
"""Second prime of the spatial hash (Müller et al., eq. 4; the first one is 1)."""

_TABLE_INIT = 1e-2
"""Features start uniform in +-1e-2, small beside the network's weights, so that a fit starts near zero."""


@dataclass(frozen=True)
class EncodingSettings:
    """Size of the encoding.

    Attributes:
        levels: number of resolutions, growing geometrically from `coarsest` to `finest`.
        features: features a level.
        coarsest, finest: cells along a side of the unit square.
        log2_entries: a level with more vertices than 2**log2_entries is hashed into that many entries.
    """

    levels: int = 8
    features: int = 2
    coarsest: int = 8
    finest: int = 96
    log2_entries: int = 14

    @property
    def width(self) -> int:
        """Features of a point over all levels."""
        return self.levels * self.features

    def resolutions(self) -> list[int]:
        """Cells a side of every level (floor of a geometric series, Müller et al., eq. 2)."""
        if self.levels == 1:
            return [self.coarsest]
        series = np.geomspace(self.coarsest, max(self.finest, self.coarsest), self.levels)
        return [int(cells) for cells in np.floor(series + 1e-9)]


def vertex_entry(
    vertices: NDArray[np.int64], resolution: int, settings: EncodingSettings
) -> NDArray[np.int64]:
    """Table entry of grid vertices within their level.

    Args:
        vertices: (n, 2) integer vertex coordinates, 0..resolution (the level has resolution + 1 vertices a
            side).
        resolution: cells a side.
        settings: decides whether the level is dense (row by row) or hashed (exclusive or of multiples).

    Returns:
        (n,) entry index.
    """
    side = resolution + 1
    if side * side <= 2**settings.log2_entries:
        return np.asarray(vertices[:, 0] * side + vertices[:, 1])
    hashed = vertices[:, 0].astype(np.uint64) ^ (vertices[:, 1].astype(np.uint64) * np.uint64(_HASH_PRIME))
    return np.asarray(hashed % np.uint64(2**settings.log2_entries)).astype(np.int64)


def level_sizes(settings: EncodingSettings) -> list[int]:
    """Table entries of every level: its vertices where they fit, 2**log2_entries otherwise."""
    return [min((cells + 1) ** 2, 2**settings.log2_entries) for cells in settings.resolutions()]


def encoding_matrix(points: NDArray[np.floating], settings: EncodingSettings) -> sparse.csr_array[np.float32]:
    """Bilinear interpolation on every level as one matrix.

    Args:
        points: (P, 2) coordinates in the unit square [0, 1]^2.
        settings: the levels.

    Returns:
        (P * levels, entries) CSR float32; row p * levels + l holds the four corner weights of point p on
        level l.
    """
    count, levels = len(points), settings.levels
    entries = np.empty((count, levels, 4), dtype=np.int64)
    weights = np.empty((count, levels, 4), dtype=np.float32)
    offset = 0
    for level, (cells, size) in enumerate(zip(settings.resolutions(), level_sizes(settings), strict=True)):
        position = np.clip(points, 0.0, 1.0) * cells
        corner = np.minimum(position.astype(np.int64), cells - 1)
        part = position - corner
        for i, (dx, dy) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
            entries[:, level, i] = offset + vertex_entry(corner + np.array([dx, dy]), cells, settings)
            weights[:, level, i] = np.prod(np.abs(np.array([1 - dx, 1 - dy]) - part), axis=1)
        offset += size
    starts = np.arange(0, 4 * count * levels + 1, 4, dtype=np.int32)
    parts = (weights.ravel(), entries.astype(np.int32).ravel(), starts)
    return sparse.csr_array(parts, shape=(count * levels, offset))


class _SparseProduct(torch.autograd.Function):  # type: ignore[misc]
    """y = S x with dL/dx = S^T dL/dy; scipy's product repeats bit for bit, a scatter-add need not."""

    @staticmethod
    def forward(ctx: Any, x: Any, matrix: Any, transposed: Any) -> Any:
        ctx.transposed = transposed
        return torch.from_numpy(matrix @ x.detach().numpy())

    @staticmethod
    def backward(ctx: Any, grad: Any) -> Any:
        return torch.from_numpy(ctx.transposed @ grad.contiguous().numpy()), None, None


def interpolate(table: Any, matrix: Any, transposed: Any, settings: EncodingSettings) -> Any:
    """(P, levels * features) features of the points of an `encoding_matrix`, differentiable by the table."""
    return _SparseProduct.apply(table, matrix, transposed).view(-1, settings.width)


def draw_table(settings: EncodingSettings, generator: torch.Generator) -> Any:
    """(entries, features) float32 parameter, all levels one after the other, drawn from `generator`."""
    drawn = torch.rand(sum(level_sizes(settings)), settings.features, generator=generator)
    return torch.nn.Parameter((drawn * 2 - 1) * _TABLE_INIT)
