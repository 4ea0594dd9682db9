"""Arrangements of alike reflectors around a body, compared by the angles between neighbours.

Where a ring's rotation is free, an arrangement is its cyclic list of angular gaps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tagid.tags.layouts.layout import MIN_SPACING_M, Layout

AXIS_M = 0.01
"""A reflector nearer than this to the body's axis looks the same from all sides, as the body does."""
MERGED_M = 0.02
"""Reflectors nearer than this along the ring are seen as one: the point response's null is at 14.5 mm."""
LEAST_APART_M = 0.75 * MIN_SPACING_M
"""Alike reflectors of no object stand nearer than MIN_SPACING_M, which before a wall may seem this much."""
MERGED_LEAST_DEG, MERGED_MOST_DEG = 15.0, 36.0


def resolution_deg(radius_m: float) -> float:
    """Angle on a ring of that apparent radius under which two reflectors are seen as one, degrees."""
    return float(np.clip(np.rad2deg(MERGED_M / max(radius_m, 1e-3)), MERGED_LEAST_DEG, MERGED_MOST_DEG))


def gaps_deg(angles: NDArray[np.floating] | Sequence[float]) -> NDArray[np.float64]:
    """(K,) angles between neighbours on the ring, degrees, in counter-clockwise order.

    >>> gaps_deg([0.0, np.pi / 2]).tolist()
    [90.0, 270.0]
    """
    a = np.sort(np.rad2deg(np.asarray(angles, dtype=np.float64)) % 360)
    return np.diff(np.append(a, a[0] + 360))


def merged(gaps: NDArray[np.floating], resolution: float) -> NDArray[np.float64]:
    """Gaps with neighbours nearer than the resolution (degrees) joined at their middle."""
    return merging(gaps, resolution)[-1]


def merging(gaps: NDArray[np.floating], resolution: float) -> list[NDArray[np.float64]]:
    """Gaps while the nearest neighbours are joined at their middle, one pair after the other: first as given,
    last with none nearer than the resolution (degrees).

    >>> [g.tolist() for g in merging(np.array([18.0, 22.0, 320.0]), 36)]
    [[18.0, 22.0, 320.0], [31.0, 329.0], [360.0]]
    """
    g = [float(v) for v in gaps]
    found = [np.array(g)]
    while len(g) > 1 and min(g) < resolution:
        i = int(np.argmin(g))
        half = g[i] / 2
        g[i - 1] += half
        g[(i + 1) % len(g)] += half
        del g[i]
        found.append(np.array(g))
    return found


def difference_deg(one: NDArray[np.floating], other: NDArray[np.floating]) -> float:
    """Largest difference of two gap lists over all rotations, degrees; 180 for unlike counts.

    Mirror images differ, as layouts do.

    >>> difference_deg(np.array([90.0, 270.0]), np.array([265.0, 95.0]))
    5.0
    """
    if len(one) != len(other):
        return 180.0
    start = np.arange(len(other))
    return float(np.abs(one - other[start - start[:, None]]).max(axis=1).min())


def apart_deg(angles: NDArray[np.floating], wanted: NDArray[np.floating], resolution: float) -> float:
    """Difference of reflectors' angles (K,), rad, from a layout's gaps, at the best stage of their joining.

    A layout may itself have neighbours nearer than the resolution: every stage is compared.
    """
    return min(difference_deg(gaps, wanted) for gaps in merging(gaps_deg(angles), resolution))


def can_stand(angles: NDArray[np.floating], radius_m: float) -> bool:
    """Whether alike reflectors can stand at angles (K,), rad, on a ring: none in another's place."""
    chord = 2 * radius_m * np.sin(np.minimum(np.deg2rad(gaps_deg(angles)), np.pi) / 2)
    return bool(len(angles) < 2 or chord.min() >= LEAST_APART_M)


def farthest(one: NDArray[np.complex128], other: NDArray[np.complex128]) -> float:
    """Largest distance of a place x + jy of either set from the nearest of the other (Hausdorff distance)."""
    apart = np.abs(one[:, None] - other)
    return float(max(apart.min(axis=0).max(), apart.min(axis=1).max()))


def turn_to(angles: NDArray[np.floating], layout: NDArray[np.floating]) -> list[float]:
    """Turns (rad) that bring a layout's angles (K,) nearest to as many measured ones, one per pairing."""
    measured, own = np.sort(np.mod(angles, 2 * np.pi)), np.sort(np.mod(layout, 2 * np.pi))
    return [float(np.angle(np.exp(1j * (np.roll(measured, k) - own)).mean())) for k in range(len(own))]


def kind_of(angles: Sequence[float]) -> tuple[int, ...]:
    """Key of an arrangement: its gaps in steps of 15 degrees, in the rotation that sorts first."""
    gaps = [int(gap) for gap in np.round(gaps_deg(angles) / 15)]
    return min(tuple(gaps[k:] + gaps[:k]) for k in range(len(gaps)))


def turned_on(angles: NDArray[np.float64], count: int) -> NDArray[np.intp]:
    """(count, K) indices of angles on a ring of `count`, in every turn of the ring's step."""
    index = np.rint(angles[None] / (2 * np.pi / count) + np.arange(count)[:, None])
    return np.asarray(index.astype(np.intp) % count)


def off_axis(
    layout: Layout,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Radii (K,), angles (K,) and heights (K,) of the reflectors that lie off the axis."""
    place = layout.positions[:, 0] + 1j * layout.positions[:, 1]
    off = np.abs(place) > AXIS_M
    heights = np.asarray(layout.heights, dtype=np.float64)[off]
    return np.abs(place[off]), np.angle(place[off]), heights


def layout_gaps_deg(layout: Layout) -> NDArray[np.float64]:
    """(K,) `gaps_deg` of a layout's reflectors off the axis; empty where all are on it."""
    angles = off_axis(layout)[1]
    return gaps_deg(angles) if len(angles) else np.zeros(0)
