"""Types that every room uses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]
Samples = NDArray[np.complex64]
Progress = Callable[[float, float, str], None]
"""Called with what is done, the total, and a remark."""
