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
_ROTATION_STEP_RAD = np.deg2rad(4.0)


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
    pair = best_pairing(small.positions, large.positions, centre_tolerance_m)
    turn = float(np.rad2deg(pair.rotation_rad if small is a else -pair.rotation_rad) % 360)
    if a.size == b.size:
        return LayoutDistance(pair.rms_m, pair.worst_m, turn)
    return LayoutDistance(np.inf, np.inf, turn, pair.worst_m)


@dataclass(frozen=True, eq=False)
class Pairing:
    """How one set of points is brought nearest to another.

    Attributes:
        rms_m, worst_m: distances left, m.
        rotation_rad, shift_m: R(rotation) p + shift lies near its partner.
        partner: (K,) index of each point's partner in the other set.
    """

    rms_m: float
    worst_m: float
    rotation_rad: float
    shift_m: NDArray[np.float64]
    partner: NDArray[np.intp]


def best_pairing(
    small: NDArray[np.float64], large: NDArray[np.float64], tolerance_m: float = np.inf
) -> Pairing:
    """Turn, shift up to the tolerance and pairing that bring points (K, 2) nearest to (L, 2), L >= K.

    Every start of a grid of turns is brought to its own minimum by pairing and turning alternately.
    """
    from scipy.optimize import linear_sum_assignment

    best: Pairing | None = None
    for rotation in np.arange(0, 2 * np.pi, _ROTATION_STEP_RAD):
        angle, shift = float(rotation), np.zeros(2)
        for _ in range(4):
            turned = small @ rotation_matrix(angle).T
            gap = np.linalg.norm(turned[:, None] + shift - large[None], axis=2)
            columns = np.asarray(linear_sum_assignment(gap**2)[1])
            partner = large[columns]
            angle, shift = _best_place(small, partner, tolerance_m)
        turned = small @ rotation_matrix(angle).T
        error = np.linalg.norm(turned + shift - partner, axis=1)
        rms = float(np.sqrt(np.mean(error**2)))
        if best is None or rms < best.rms_m:
            best = Pairing(rms, float(error.max()), angle, shift, columns)
    assert best is not None
    return best


def _best_place(
    points: NDArray[np.float64], partner: NDArray[np.float64], tolerance_m: float
) -> tuple[float, NDArray[np.float64]]:
    """Turn and shift that bring points nearest to their partners (Kabsch 1976), the shift within it."""
    p, q = points.mean(axis=0), partner.mean(axis=0)
    angle = _best_angle(points - p, partner - q)
    shift: NDArray[np.float64] = q - rotation_matrix(angle) @ p
    if np.linalg.norm(shift) <= tolerance_m:
        return angle, shift
    for _ in range(6):
        shift = shift * min(1.0, tolerance_m / max(float(np.linalg.norm(shift)), 1e-12))
        angle = _best_angle(points, partner - shift)
        shift = q - rotation_matrix(angle) @ p
    return angle, shift * min(1.0, tolerance_m / max(float(np.linalg.norm(shift)), 1e-12))


def _best_angle(points: NDArray[np.float64], partner: NDArray[np.float64]) -> float:
    """Turn about the origin that brings points nearest to their partners."""
    p = points[:, 0] + 1j * points[:, 1]
    q = partner[:, 0] + 1j * partner[:, 1]
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
