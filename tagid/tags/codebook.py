"""How far apart layouts are when any turn may lie between them: what decides whether two can be told apart.

A family of tags is judged by its smallest distance, as AprilTag families are by their Hamming distance.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.tags.layout import Layout, rotation_matrix

CONFUSABLE_M = 12e-3
"""Nearer than this (worst reflector) two layouts are confusable: about one null radius of the point response,
2.405 / 2k = 14.5 mm at 3.95 GHz, less wobble and fit."""
CENTRE_TOLERANCE_M = 14e-3
"""The reader looks for an object's centre within +- this, so a shift of this size tells no layouts apart."""
_ROTATION_STEP_RAD = np.deg2rad(1.0)


@dataclass(frozen=True)
class LayoutDistance:
    """Distance of two layouts under the best rotation, shift within the centre's tolerance, and assignment.

    Attributes:
        rms_m: root mean square over reflectors, m; infinite where their numbers differ.
        worst_m: largest over reflectors, m; infinite where their numbers differ.
        rotation_deg: turn of the first that brings it onto the second.
        nested_m: where the numbers differ, the worst distance of the smaller one's reflectors from their
            counterparts in the larger: near zero means that one is a part of the other. Else infinite.
    """

    rms_m: float
    worst_m: float
    rotation_deg: float
    nested_m: float = np.inf

    @property
    def nested(self) -> bool:
        """Whether one layout is a part of the other."""
        return self.nested_m < CONFUSABLE_M


def rotational_distance(
    a: Layout, b: Layout, centre_tolerance_m: float = CENTRE_TOLERANCE_M
) -> LayoutDistance:
    """Smallest distance of two layouts over turns, shifts of up to the tolerance, and pairings.

    Mirror images count as different: an object is never seen from below.

    >>> from tagid.tags.layout import builtin_layouts
    >>> b = builtin_layouts()
    >>> round(rotational_distance(b["helmet-120"], b["helmet-120"]).worst_m, 6)
    0.0
    """
    small, large = (a, b) if a.size <= b.size else (b, a)
    rms, worst, rotation = _best_pairing(small.positions, large.positions, centre_tolerance_m)
    turn = float(np.rad2deg(rotation if small is a else -rotation) % 360)
    if a.size == b.size:
        return LayoutDistance(rms, worst, turn)
    return LayoutDistance(np.inf, np.inf, turn, worst)


def _best_pairing(
    small: NDArray[np.float64], large: NDArray[np.float64], tolerance_m: float
) -> tuple[float, float, float]:
    """(rms, worst, rotation) of the turn, shift and pairing with the smallest RMS distance."""
    from scipy.optimize import linear_sum_assignment

    best = (np.inf, np.inf, 0.0)
    for rotation in np.arange(0, 2 * np.pi, _ROTATION_STEP_RAD):
        shift = np.zeros(2)
        angle = float(rotation)
        for _ in range(3):
            turned = small @ rotation_matrix(angle).T
            gap = np.linalg.norm(turned[:, None] + shift - large[None], axis=2)
            columns = linear_sum_assignment(gap**2)[1]
            partner = large[columns]
            if len(small) == len(large):
                angle = _best_angle(small, partner, shift)
                turned = small @ rotation_matrix(angle).T
            shift = (partner - turned).mean(axis=0)
            length = float(np.linalg.norm(shift))
            shift *= min(1.0, tolerance_m / max(length, 1e-12))
        error = np.linalg.norm(turned + shift - partner, axis=1)
        rms = float(np.sqrt(np.mean(error**2)))
        if rms < best[0]:
            best = (rms, float(error.max()), angle)
    return best


def _best_angle(
    points: NDArray[np.float64], partner: NDArray[np.float64], shift: NDArray[np.float64]
) -> float:
    """Turn about the origin that brings points nearest to partner - shift (Kabsch 1976)."""
    p = points[:, 0] + 1j * points[:, 1]
    q = (partner - shift)[:, 0] + 1j * (partner - shift)[:, 1]
    return float(np.angle(np.sum(p.conj() * q)))


def confusable(
    layout: Layout, others: Iterable[Layout], tolerance_m: float = CONFUSABLE_M
) -> dict[str, LayoutDistance]:
    """Those of the others, by name, whose worst reflector lies within the tolerance of the layout's."""
    near = {}
    for other in others:
        distance = rotational_distance(layout, other)
        if distance.worst_m < tolerance_m:
            near[other.name] = distance
    return near
