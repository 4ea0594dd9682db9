"""Reflectors in free space, and beside a body that the waves pass."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.reading.transfers.transfer import ANGLES, Transfer


def isotropic(kappa: NDArray[np.float64], radius_m: float) -> NDArray[np.complex128]:
    """One pattern, the same from all sides."""
    return np.ones((1, len(kappa), ANGLES), dtype=np.complex128)


BARE = Transfer("bare", "nothing that returns an echo", False, (1.0,), isotropic)
POINTS = Transfer("points", "a body that the waves pass", True, (1.0,), isotropic)
