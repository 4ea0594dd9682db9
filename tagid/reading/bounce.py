"""What passes from one reflector of a tag to another: echoes that are late by the path between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.reading.spectra import Spectra
from tagid.types import Complex, Floats

BOUNCE, BOUNCE_M = 0.1, 0.06
"""Echo by way of a second reflector over the direct one, both ways, at so much between the two, m.

Twice the scattering amplitude over the distance: 0.08 of octahedra of 20 mm, 0.5 of 40 mm at 4 GHz.
"""
TOUCH_M = 1e-3
"""Keeps the bounce between two points finite in one place, m."""


def bounced(
    spectra: Spectra,
    positions: Complex,
    heights: Floats,
    range_m: Floats,
    toward: Complex,
    up: Floats,
    seen: NDArray[np.bool_],
) -> tuple[Complex, Complex]:
    """(F, V) echo by way of a second reflector, and how it changes with x, y and z of each, (3, F, K, V).

    Single scattering of a wave at each of two small bodies (L. L. Foldy, *Phys. Rev.* 67, 1945).
    """
    half = -0.5j * spectra.kappa[:, None, None]
    waves = (spectra.distance_m / range_m) * np.exp(half * (range_m - spectra.distance_m)) * seen
    apart = np.stack(
        [
            np.subtract.outer(coordinate, coordinate)
            for coordinate in (positions.real, positions.imag, heights)
        ]
    )
    far = np.sqrt((apart**2).sum(axis=0) + TOUCH_M**2)
    pair = BOUNCE_M / far * np.exp(half * far) * ~np.eye(len(positions), dtype=bool)
    back = pair @ waves
    drawn = pair * (half - 1 / far) * apart[:, None] / far
    moved = waves * back * (half - 1 / range_m)
    slopes = np.stack([moved * toward.real, moved * toward.imag, moved * up]) + waves * (drawn @ waves)
    return 0.5 * (waves * back).sum(axis=1), slopes
