"""Arrangements from which the fit on a body begins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.reflectors_fit import Batch

FREE, OTHER = "<free>", "<other>"
"""Roles of arrangements that are not a layout's: with free angles, and with those of the ring."""


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
