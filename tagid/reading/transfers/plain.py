"""Reflectors in free space, alike from all sides or not, and beside a body that the waves pass."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.reading.transfers.transfer import ANGLES, MIDDLE_M, Transfer, aspects, principal

BACKS, POWERS, TERMS = (0.2, 0.4, 0.6, 0.8, 1.0), (1, 2, 3), 3
"""Amplitudes from behind over those from in front, powers of (1 + cos) / 2 between, and patterns kept."""


def isotropic(kappa: NDArray[np.float64], radius_m: float) -> NDArray[np.complex128]:
    """One pattern, the same from all sides."""
    return np.ones((1, len(kappa), ANGLES), dtype=np.complex128)


def _facing(kappa: NDArray[np.float64], radius_m: float) -> NDArray[np.complex128]:
    lit = ((1 + np.cos(aspects())) / 2)[None, None]
    members = [back + (1 - back) * lit**power for back in BACKS for power in POWERS]
    every = principal(np.concatenate(members).astype(np.complex128), TERMS)
    if radius_m <= MIDDLE_M:
        every = np.broadcast_to(every[..., :1], every.shape)
    return np.repeat(every, len(kappa), axis=1)


BARE = Transfer("bare", "nothing that returns an echo", False, (1.0,), isotropic, open=True)
POINTS = Transfer("points", "a body that the waves pass", True, (1.0,), isotropic, open=True, clear=True)
FACING = Transfer("facing", "nothing that returns an echo", False, (1.0,) * TERMS, _facing, open=True)
"""Reflectors that return less from behind, with nothing beside them."""
