"""Arrays read between their samples, linearly along two axes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def bilinear(
    values: NDArray[np.floating], row: NDArray[np.floating], column: NDArray[np.floating]
) -> NDArray[Any]:
    """(..., *row.shape) values (..., rows, columns) at fractional rows and columns of a shape; 0 outside."""
    last = values.shape[-2] - 1, values.shape[-1] - 1
    y, x = np.clip(row, 0, last[0]), np.clip(column, 0, last[1])
    top = np.minimum(y.astype(np.intp), max(last[0] - 1, 0))
    left = np.minimum(x.astype(np.intp), max(last[1] - 1, 0))
    low, right = np.minimum(top + 1, last[0]), np.minimum(left + 1, last[1])
    down, over = (y - top).astype(values.dtype), (x - left).astype(values.dtype)
    upper = values[..., top, left] * (1 - over) + values[..., top, right] * over
    lower = values[..., low, left] * (1 - over) + values[..., low, right] * over
    value = upper * (1 - down) + lower * down
    return np.where((y == row) & (x == column), value, 0)
