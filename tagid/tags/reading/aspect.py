"""From which sides a reflector is seen: transparent objects show it to all, opaque ones to its outward side.

The coarse search tries two of these patterns for every layout, because a template that expects an echo from
behind a helmet leaves a third of the scans unexplained and looks as if a reflector were missing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NO_SIDE_M = 0.01
"""A reflector nearer than this to the object's axis has no outward side: it stands on top, or in a glass."""


@dataclass(frozen=True)
class Aspect:
    """Amplitude of a reflector over the angle psi between its outward side and the antenna, seen from above.

    w(psi) = floor + (1 - floor) ramp((cos psi - cos_edge) / (2 softness) + 1/2), the ramp held to 0..1.

    Attributes:
        cos_edge: cosine of the angle at which the amplitude is half way down.
        softness: half the width of the edge, in cos psi; 1 about psi = 90 deg is the raised cosine.
        floor: 0..1, what the far side shows; 1 is transparent.
    """

    cos_edge: float = 0.0
    softness: float = 1.0
    floor: float = 0.0

    def weight(
        self, antenna: NDArray[np.float64], points: NDArray[np.float64], facing: NDArray[np.float64]
    ) -> NDArray[np.float32] | None:
        """(..., views) amplitudes of points (..., 2), outward unit vectors (..., 2); None where all are 1.

        The antenna stands at `antenna` (views, 3), m. A facing of (0, 0) stands for no outward side.
        """
        if self.floor >= 1.0:
            return None
        x = antenna[:, 0] - points[..., 0, None]
        y = antenna[:, 1] - points[..., 1, None]
        cosine = (facing[..., 0, None] * x + facing[..., 1, None] * y) / np.sqrt(x * x + y * y)
        ramp = np.minimum(np.maximum((cosine - self.cos_edge) / (2 * self.softness) + 0.5, 0.0), 1.0)
        seen = self.floor + (1 - self.floor) * ramp
        sided = (facing != 0).any(axis=-1)[..., None]
        return np.asarray(np.where(sided, seen, 1.0), dtype=np.float32)


TRANSPARENT = Aspect(floor=1.0)
ROUND = Aspect()
"""The raised cosine, which most patterns resemble."""
PATTERNS = (
    TRANSPARENT,
    Aspect(floor=0.4),
    ROUND,
    Aspect(cos_edge=-0.4, softness=0.25),
    Aspect(cos_edge=0.0, softness=0.25),
    Aspect(cos_edge=0.4, softness=0.25),
)
"""Patterns that a layout may have: all sides, dimmed behind, none behind with a soft edge at 90 deg, and
none behind with a hard edge at 114, 90 and 66 deg (proud of the wall, flush with it, and sunk into it)."""


def outward(
    points: NDArray[np.float64], centre: NDArray[np.floating], no_side_m: float = NO_SIDE_M
) -> NDArray[np.float64]:
    """(..., 2) horizontal unit vectors from the centre to points (..., 2), zero within `no_side_m`."""
    away = points - np.asarray(centre)
    gap = np.sqrt(away[..., :1] ** 2 + away[..., 1:] ** 2)
    return np.asarray(np.where(gap < no_side_m, 0.0, away / np.maximum(gap, 1e-12)))
