"""An opaque body hides a reflector from behind: patterns that fall from an edge on to nothing beyond it.

Where the edge lies is the same at all frequencies: every transfer has its own range of edges, and the
principal patterns of all that lie in it, hard or soft, of reflectors that return less to the side or not.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from tagid.reading.transfers.transfer import Transfer, aspects, principal
from tagid.reading.transfers.wall import RADIUS_SD_M

EDGES_DEG = ((45, 60, 75), (75, 90, 105), (105, 120, 135))
SOFT_DEG = (2, 10, 25)
SIDES = (0.0, 0.4, 0.8)
"""What a reflector returns less to the side than (1 + cos) / 2 of what it does in front."""
TERMS = 3


def _table(edges_deg: Sequence[float], kappa: NDArray[np.float64], radius_m: float) -> NDArray[np.complex128]:
    lit = (1 + np.cos(aspects())) / 2
    away = np.rad2deg(np.abs(np.angle(np.exp(1j * aspects()))))
    members = [
        (1 - side + side * lit) / (1 + np.exp((away - edge) / (soft / 2)))
        for edge, soft, side in product(edges_deg, SOFT_DEG, SIDES)
    ]
    patterns = principal(np.asarray(members, dtype=np.complex128)[:, None], TERMS)
    return np.repeat(patterns, len(kappa), axis=1)


SHADES = tuple(
    Transfer(
        f"shade from {edges[1]}",
        "a body that hides them from behind",
        True,
        (1.0,) * TERMS,
        partial(_table, edges),
        RADIUS_SD_M,
    )
    for edges in EDGES_DEG
)
