"""Colour tables for pictures and terminal previews.

They are computed from a few anchors, so that magnitude maps to lightness, without a plotting library.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

RGB = tuple[int, int, int]

WHITE: RGB = (255, 255, 255)
INK: RGB = (25, 25, 30)
GRID: RGB = (225, 226, 232)
BLUE: RGB = (28, 92, 170)
GREEN: RGB = (20, 140, 80)
ORANGE: RGB = (214, 96, 20)
BAND: RGB = (231, 240, 250)
BAND_INK: RGB = (165, 195, 230)
GAP: RGB = (205, 205, 210)

# Every eighth of matplotlib's viridis (S. van der Walt and N. Smith, 2015, CC0): lightness rises evenly.
_VIRIDIS: tuple[RGB, ...] = (
    (68, 1, 84),
    (71, 45, 123),
    (59, 82, 139),
    (44, 114, 142),
    (33, 145, 140),
    (40, 174, 128),
    (94, 201, 98),
    (173, 220, 48),
    (253, 231, 37),
)


def viridis(levels: int = 256) -> NDArray[np.uint8]:
    """(levels, 3) uint8 sRGB table from dark violet to yellow, its lightness rising throughout.

    >>> viridis(3).tolist()
    [[68, 1, 84], [33, 145, 140], [253, 231, 37]]
    """
    anchors = np.array(_VIRIDIS, dtype=np.float64)
    at = np.linspace(0, len(anchors) - 1, levels)
    channels = [np.interp(at, np.arange(len(anchors)), anchors[:, c]) for c in range(3)]
    return np.rint(np.stack(channels, axis=1)).astype(np.uint8)


def to_decibels(
    magnitude: NDArray[np.floating], dynamic_range_db: float, reference: float | None = None
) -> NDArray[np.float64]:
    """Magnitude (any shape) in dB below `reference` (the largest value if None), in [-dynamic_range_db, 0].

    An all-zero array, which has no reference value, is at the floor everywhere.
    """
    size = np.asarray(magnitude, dtype=np.float64)
    top = float(size.max(initial=0.0)) if reference is None else reference
    if not top > 0:
        return np.full(size.shape, -dynamic_range_db)
    floor = 10 ** (-dynamic_range_db / 20)
    return np.asarray(20 * np.log10(np.clip(size / top, floor, 1.0)))


def colourise(decibels: NDArray[np.floating], dynamic_range_db: float) -> NDArray[np.uint8]:
    """(..., 3) uint8 colours of decibels in [-dynamic_range_db, 0], values outside clipped."""
    table = viridis()
    level = (np.asarray(decibels) / dynamic_range_db + 1) * (len(table) - 1)
    return np.asarray(table[np.clip(np.rint(level), 0, len(table) - 1).astype(np.intp)])
