"""Reflectors before a filled plastic vessel: powder, rice, oil or granulate, by the exact fields.

A filling of low loss is a lens: a reflector behind it is seen late, and stronger than one in front.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

from tagid.fields.shells import Shell
from tagid.reading.transfers.transfer import Transfer
from tagid.reading.transfers.wall import RADIUS_SD_M, beside, gaps

FILLINGS = (2.0, 2.3, 2.6, 3.0, 3.5)
"""Relative permittivities: oil and powder 2 to 3, rice and granulate more."""
WALL_M, PERMITTIVITY = 2e-3, 2.5
"""Of the vessel."""
TERMS = 4


def shells(polarisation: str) -> Callable[[float], list[Shell]]:
    """Vessels that may carry reflectors, as a function of their distance from the axis, m."""

    def every(radius_m: float) -> list[Shell]:
        return [
            Shell(float(radius_m - gap), WALL_M, PERMITTIVITY, False, polarisation, filling)
            for gap, filling in product(gaps(radius_m), FILLINGS)
        ]

    return every


RODS = tuple(
    Transfer(f"rod, {p}", "a filled vessel", True, (1.0,) * TERMS, beside(shells(p), TERMS), RADIUS_SD_M)
    for p in ("V", "H")
)
