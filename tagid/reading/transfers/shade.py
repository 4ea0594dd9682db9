"""An opaque body hides a reflector from behind: patterns that are one before an edge and nothing beyond it.

Where the edge lies, and how soft it is, is not known: the patterns are the principal ones of all such edges,
with the share of their energy as prior power (Karhunen and Loeve's expansion).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.reading.transfers.transfer import Transfer, aspects, principal
from tagid.reading.transfers.wall import RADIUS_SD_M

EDGES_DEG = (50, 65, 80, 90, 100, 115, 130)
SOFT_DEG = (2, 10, 25)
TERMS = 5


def _edges() -> NDArray[np.complex128]:
    away = np.rad2deg(np.abs(np.angle(np.exp(1j * aspects()))))
    edges = [1 / (1 + np.exp((away - edge) / (soft / 2))) for edge in EDGES_DEG for soft in SOFT_DEG]
    return np.asarray(edges, dtype=np.complex128)


def _table(kappa: NDArray[np.float64], radius_m: float) -> NDArray[np.complex128]:
    return np.repeat(principal(_edges()[:, None], TERMS), len(kappa), axis=1)


SHADE = Transfer("shade", "a body that hides them from behind", True, (1.0,) * TERMS, _table, RADIUS_SD_M)
