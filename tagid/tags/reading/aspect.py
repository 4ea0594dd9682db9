"""From which sides a reflector is seen: transparent objects show it to all, opaque ones to its outward side.

The reader tries a few of these patterns for every layout, because a template that expects an echo from behind
a helmet leaves a third of the scans unexplained and looks as if a reflector were missing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.tags.reading.field import FixedPoints, MatchedField

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

    @property
    def numbers(self) -> tuple[float, float, float]:
        """The three numbers, in the order that the compiled loops take."""
        return self.cos_edge, self.softness, self.floor

    @property
    def uniform(self) -> bool:
        """Whether every side is alike."""
        return self.floor >= 1.0

    def weight(
        self, antenna: NDArray[np.float64], points: NDArray[np.float64], facing: NDArray[np.float64]
    ) -> NDArray[np.float32] | None:
        """(..., views) amplitudes of points (..., 2 or 3), outward unit vectors (..., 2); None where uniform.

        The antenna stands at `antenna` (views, 3), m. A facing of (0, 0) stands for no outward side.
        """
        if self.uniform:
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
"""The raised cosine: what most patterns resemble, so the search begins with it."""
PATTERNS = (
    TRANSPARENT,
    Aspect(floor=0.4),
    ROUND,
    Aspect(cos_edge=-0.4, softness=0.25),
    Aspect(cos_edge=0.0, softness=0.25),
    Aspect(cos_edge=0.4, softness=0.25),
)
"""Patterns tried at the best place: all sides, dimmed behind, none behind with a soft edge at 90 deg, and
none behind with a hard edge at 114, 90 and 66 deg (proud of the wall, flush with it, and sunk into it)."""


def outward(
    points: NDArray[np.float64], centre: NDArray[np.floating], no_side_m: float = NO_SIDE_M
) -> NDArray[np.float64]:
    """(..., 2) horizontal unit vectors from the centre to points (..., 2 or 3), zero within `no_side_m`."""
    away = points[..., :2] - np.asarray(centre)
    gap = np.sqrt(away[..., :1] ** 2 + away[..., 1:] ** 2)
    return np.asarray(np.where(gap < no_side_m, 0.0, away / np.maximum(gap, 1e-12)))


@dataclass(frozen=True, eq=False)
class Appearance:
    """How free points about an object's centre look: one pattern, each facing away from the centre.

    Attributes:
        aspect: the pattern.
        centre_m: (2,) the object's axis, m.
        offset_m: measured distances are this much longer than the aperture says.
    """

    aspect: Aspect
    centre_m: NDArray[np.float64]
    offset_m: float = 0.0

    def templates(self, field: MatchedField, points: NDArray[np.float64]) -> NDArray[np.complex64]:
        """(..., views * rank) templates of points (..., 2) in the plane or (..., 3), m."""
        weight = self.aspect.weight(field.antenna, points, outward(points, self.centre_m))
        return field.templates(self._distances(field, points), weight)

    def fixed(self, field: MatchedField, points: NDArray[np.float64]) -> FixedPoints:
        """The templates of many points (N, 2 or 3), m, in a form that needs little memory."""
        facing = outward(points, self.centre_m)
        if field.tables is not None:
            heights = points[:, 2] if points.shape[1] == 3 else np.zeros(len(points))
            places = np.column_stack([points[:, :2], heights])
            looked = field.tables.looked(places, facing, self.offset_m, self.aspect.numbers)
            return FixedPoints(field, looked)
        weight = self.aspect.weight(field.antenna, points, facing)
        return field.fixed(self._distances(field, points), weight)

    def _distances(self, field: MatchedField, points: NDArray[np.float64]) -> NDArray[np.float64]:
        heights = points[..., 2] if points.shape[-1] == 3 else 0.0
        return field.distances(points[..., :2], heights) + self.offset_m
