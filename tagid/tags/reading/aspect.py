"""Aspect patterns: the sides from which a reflector is visible.

A transparent object shows its reflectors on all sides, an opaque one on their outward side only. The reader
tries a few patterns for every layout: a template that expects an echo from behind a helmet leaves a third of
the scans unexplained, and a reflector would seem to be missing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.tags.reading.field import MatchedField

NO_SIDE_M = 0.01
"""A reflector closer than this to the object's axis has no outward side: it is on top, or inside a glass."""


@dataclass(frozen=True)
class Aspect:
    """Amplitude of a reflector against the horizontal angle psi between its outward side and the antenna.

    w(psi) = floor + (1 - floor) ramp((cos psi - cos_edge) / (2 softness) + 1/2), with the ramp clipped to
    0..1.

    Attributes:
        cos_edge: cosine of the angle at which the amplitude has dropped half way.
        softness: half the width of the edge, in cos psi; 1, centred at psi = 90 deg, is the raised cosine.
        floor: 0..1, amplitude on the far side; 1 is transparent.
    """

    cos_edge: float = 0.0
    softness: float = 1.0
    floor: float = 0.0

    @property
    def uniform(self) -> bool:
        """Whether the amplitude is the same on every side."""
        return self.floor >= 1.0

    def weight(
        self, field: MatchedField, points: NDArray[np.float64], facing: NDArray[np.float64]
    ) -> NDArray[np.float32] | None:
        """(..., views) amplitudes of points (..., 2) with outward unit vectors (..., 2); None if uniform.

        A facing of (0, 0) means that the point has no outward side.
        """
        if self.uniform:
            return None
        x = field.antenna[:, 0] - points[..., 0, None]
        y = field.antenna[:, 1] - points[..., 1, None]
        cosine = (facing[..., 0, None] * x + facing[..., 1, None] * y) / np.sqrt(x * x + y * y)
        ramp = np.clip((cosine - self.cos_edge) / (2 * self.softness) + 0.5, 0.0, 1.0)
        seen = self.floor + (1 - self.floor) * ramp
        sided = (facing != 0).any(axis=-1)[..., None]
        return np.asarray(np.where(sided, seen, 1.0), dtype=np.float32)


TRANSPARENT = Aspect(floor=1.0)
ROUND = Aspect()
"""The raised cosine. Most patterns resemble it, so the search starts with it."""
PATTERNS = (
    TRANSPARENT,
    Aspect(floor=0.4),
    ROUND,
    Aspect(cos_edge=-0.4, softness=0.25),
    Aspect(cos_edge=0.0, softness=0.25),
    Aspect(cos_edge=0.4, softness=0.25),
)
"""Patterns tried at the best place: uniform, dimmed behind, dark behind with a soft edge at 90 deg, and dark
behind with a hard edge at 114, 90 and 66 deg (reflector raised above the wall, flush with it, and
recessed)."""


def outward(
    points: NDArray[np.float64], centre: NDArray[np.floating], no_side_m: float = NO_SIDE_M
) -> NDArray[np.float64]:
    """(..., 2) unit vectors from the centre to points (..., 2); zero for points closer than `no_side_m`."""
    away = points - np.asarray(centre)
    gap = np.linalg.norm(away, axis=-1, keepdims=True)
    return np.asarray(np.where(gap < no_side_m, 0.0, away / np.maximum(gap, 1e-12)))


@dataclass(frozen=True, eq=False)
class Appearance:
    """How free points on an object are seen: one pattern for all, each point facing away from the centre.

    Attributes:
        aspect: the pattern.
        centre_m: (2,) position of the object's axis, m.
        offset_m: excess of measured distances over those of the aperture, m.
    """

    aspect: Aspect
    centre_m: NDArray[np.float64]
    offset_m: float = 0.0

    def templates(self, field: MatchedField, points: NDArray[np.float64]) -> NDArray[np.complex64]:
        """(..., views * rank) templates of points (..., 2), m."""
        weight = self.aspect.weight(field, points, outward(points, self.centre_m))
        return field.templates(field.distances(points) + self.offset_m, weight)
