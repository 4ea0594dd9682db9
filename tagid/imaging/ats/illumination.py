"""How strongly a view sees a place: spreading with range and the antenna's beam.

A reflectivity belongs to the place, these belong to the radar; without them a scene seen from near and from
far would have to be two scenes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_NEAREST = 0.05
"""Points nearer than this part of the middle distance get no more light: 5 cm at 1 m."""


def illumination(
    points: NDArray[np.float64], positions: NDArray[np.float64], spreading: float, beam_width_rad: float
) -> NDArray[np.float32]:
    """(R0 / R)^spreading 2^-(2 theta / width)^2 for every view and point, 1 at the origin.

    Args:
        points: (points, 2) m, in the plane z = 0.
        positions: (views, 3) antenna positions, m; the beam looks at the origin.
        spreading: exponent of the amplitude: 2 for a point reflector (radar equation), 0 for none.
        beam_width_rad: full -3 dB width of the one-way power pattern, whose value is the two-way amplitude,
            rad; 0 for all round.

    Returns:
        (views, points) float32.
    """
    there = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    out = np.empty((len(positions), len(points)), dtype=np.float32)
    for row, antenna in zip(out, positions, strict=True):
        line = there - antenna
        middle = max(float(np.linalg.norm(antenna)), 1e-9)
        distance = np.maximum(np.linalg.norm(line, axis=1), _NEAREST * middle)
        row[:] = (middle / distance) ** spreading
        if beam_width_rad > 0:
            cosine = np.clip(-(line @ antenna) / (distance * middle), -1, 1)
            row *= 2.0 ** -((2 * np.arccos(cosine) / beam_width_rad) ** 2)
    return out
