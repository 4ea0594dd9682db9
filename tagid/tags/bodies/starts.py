"""Arrangements from which the fit on a body begins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.reflectors_fit import Batch

FREE, OTHER = "<free>", "<other>"
"""Roles of arrangements that are not a layout's: with free angles, and with those of the ring."""

HALVED_DEG = (12.0, 18.0, 24.0, 30.0)
"""Half the angle between neighbours that are tried in place of one reflector."""


@dataclass(frozen=True)
class Start:
    """An arrangement found on a ring: energy left of the coarse spectra, and where.

    Attributes:
        left: energy.
        centre: x + jy of the ring, m. radius_m: of the ring.
        angles: of the reflectors, rad.
    """

    left: float
    centre: complex
    radius_m: float
    angles: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Ringed:
    """Nominal radii (K,) and heights (K,) of reflectors about their centre, m."""

    radii: NDArray[np.float64]
    heights: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Row:
    """A start to be fitted.

    Attributes:
        role: FREE, OTHER or the name of a layout.
        key: of rows that only differ in the pattern or the start, one is kept.
        batch: one row.
    """

    role: str
    key: tuple[object, ...]
    batch: Batch


def halved(centre: complex, radius_m: float, angles: NDArray[np.float64]) -> list[Start]:
    """Neighbours in place of one or both reflectors of a pair, whose middle is where the reflector was.

    The search keeps the best arrangement of every kind at the ring's angles. In one of eight recordings of
    such neighbours on a full-wave can it kept others, and the pair led by 3.5.

    Args:
        centre: of the ring, x + jy, m.
        radius_m: of the pair, m.
        angles: (2,) of its reflectors, rad.
    """
    found = []
    for half in np.deg2rad(HALVED_DEG):
        first, second = ((angles[i] - half, angles[i] + half) for i in (0, 1))
        for places in ((*first, *second), (*first, angles[1]), (angles[0], *second)):
            found.append(Start(0.0, centre, radius_m / float(np.cos(half)), tuple(float(a) for a in places)))
    return found
