"""Rotation-invariant distance of layouts, which decides whether two can be distinguished.

A family of tags is rated by its minimum distance, as AprilTag families are by their Hamming distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from math import perm

import numpy as np
from numpy.typing import NDArray

from tagid.tags.layouts.layout import Layout, rotation_matrix

CONFUSABLE_M = 12e-3
"""Layouts closer than this (worst reflector) are confusable: about one null radius of the point response,
2.405 / 2k = 14.5 mm at 3.95 GHz, less wobble and fit."""
CENTRE_TOLERANCE_M = 14e-3
"""The reader searches the object's centre within +- this, so such shifts do not distinguish layouts."""
MAX_PAIRINGS = 5040
_ROTATION_STEP_RAD = np.deg2rad(4.0)
_ARC_STEPS = 16
_SECANTS = 12
_BLOCK = 1 << 18


@dataclass(frozen=True)
class LayoutDistance:
    """Distance of two layouts under the best rotation, shift within the centre tolerance, and assignment.

    Attributes:
        rms_m: root mean square over reflectors, m; infinite if the numbers of reflectors differ.
        worst_m: largest over reflectors, m; infinite if the numbers of reflectors differ.
        rotation_deg: rotation of the first onto the second.
        nested_m: if the numbers differ, the worst distance of the smaller layout's reflectors from their
            counterparts in the larger: near zero means that one is a subset of the other. Else infinite.
    """

    rms_m: float
    worst_m: float
    rotation_deg: float
    nested_m: float = np.inf

    @property
    def nested(self) -> bool:
        """Whether one layout is a subset of the other."""
        return self.nested_m < CONFUSABLE_M


def height_weight(antenna_heights_m: Sequence[float], axis_distance_m: float) -> float:
    """Displacement in the plane that changes the echoes as much as a height difference of 1 m does.

    From an antenna at the height h and the distance D, a height difference s changes the range by -s h / D.
    What is equal at all antenna heights is lost in the phase of the echo: s std(h) / D is left in the mean
    (RMS). A displacement s in the plane changes it by s / sqrt(2) in the mean over a turn. 0 for one antenna
    height.

    >>> round(height_weight([0.0, 0.2, 0.4], 1.0), 3)
    0.231
    """
    return float(np.sqrt(2) * np.std(antenna_heights_m) / axis_distance_m)


def in_space(layout: Layout, height_weight: float) -> NDArray[np.float64]:
    """(K, 2) positions of a layout, or (K, 3) with its weighted heights if the weight is positive, m."""
    if height_weight <= 0:
        return layout.positions
    return np.column_stack([layout.positions, height_weight * np.asarray(layout.heights)])


def rotational_distance(
    a: Layout, b: Layout, centre_tolerance_m: float = CENTRE_TOLERANCE_M, height_weight: float = 0.0
) -> LayoutDistance:
    """Smallest distance of two layouts over rotations, shifts up to the tolerance, m, and pairings.

    Mirror images are distinct: an object is never seen from below. Heights are compared after the best common
    shift, because the height of the object's plane is not known exactly; with a `height_weight` of 0 they do
    not distinguish layouts.

    >>> from tagid.tags.layouts.layout import builtin_layouts
    >>> b = builtin_layouts()
    >>> round(rotational_distance(b["helmet-120"], b["helmet-120"]).worst_m, 6)
    0.0
    """
    small, large = (a, b) if a.size <= b.size else (b, a)
    pair = best_pairing(in_space(small, height_weight), in_space(large, height_weight), centre_tolerance_m)
    turn = float(np.rad2deg(pair.rotation_rad if small is a else -pair.rotation_rad) % 360)
    if a.size == b.size:
        return LayoutDistance(pair.rms_m, pair.worst_m, turn)
    return LayoutDistance(np.inf, np.inf, turn, pair.worst_m)


@dataclass(frozen=True, eq=False)
class Pairing:
    """The best alignment of one point set to another.

    Attributes:
        rms_m, worst_m: residual distances, m.
        rotation_rad, shift_m: R(rotation) p + shift is close to its partner.
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
    """Rotation, shift (up to the tolerance) and pairing that best align points (K, 2) with (L, 2), L >= K.

    For few points every pairing is tried; otherwise each start rotation of a grid is refined by alternating
    pairing and alignment. Of points (K, 3) the third coordinate is compared after the best common shift.
    """
    if perm(len(large), len(small)) > MAX_PAIRINGS:
        return _nearest_pairing(small, large, tolerance_m)
    partners = np.array(list(permutations(range(len(large)), len(small))), dtype=np.intp)
    rms, angle, shift = best_places(small[None, :, :2], large[partners][..., :2], tolerance_m)
    risen = _risen(small[None], large[partners])
    rms = np.sqrt(rms**2 + np.mean(risen**2, axis=-1))
    i = int(np.argmin(rms))
    turned = small[:, :2] @ rotation_matrix(float(angle[i])).T + shift[i]
    apart = np.column_stack([turned - large[partners[i], :2], risen[i]])
    worst = float(np.linalg.norm(apart, axis=1).max())
    return Pairing(float(rms[i]), worst, float(angle[i]), shift[i], partners[i])


def _risen(points: NDArray[np.float64], partners: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., K) differences of the third coordinates after the best common shift; 0 of points in the plane."""
    if points.shape[-1] == 2:
        return np.zeros(np.broadcast_shapes(points.shape, partners.shape)[:-1])
    apart = points[..., 2] - partners[..., 2]
    return np.asarray(apart - apart.mean(axis=-1, keepdims=True))


def best_places(
    points: NDArray[np.float64], partners: NDArray[np.float64], tolerance_m: float = np.inf
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Rotations (...), rad, and shifts (..., 2), within the tolerance, m, that best align points with their
    partners, (..., K, 2), broadcast against each other; before them the residual RMS distances (...), m.

    The unlimited optimum is Kabsch's (1976); if its shift is too long, see `_held_turn`.
    """
    p = points[..., 0] + 1j * points[..., 1]
    q = partners[..., 0] + 1j * partners[..., 1]
    p, q = np.broadcast_arrays(p, q)
    shape = p.shape[:-1]
    p, q = p.reshape(-1, p.shape[-1]), q.reshape(-1, p.shape[-1])
    p_mean, q_mean = p.mean(axis=-1), q.mean(axis=-1)
    centred = np.sum(p.conj() * q, axis=-1) - p.shape[-1] * p_mean.conj() * q_mean
    turn = np.exp(1j * np.angle(centred))
    shift = q_mean - turn * p_mean
    far = np.abs(shift) > tolerance_m
    if far.any():
        turn[far] = np.exp(1j * _held_turn(centred[far] / p.shape[-1], p_mean[far], q_mean[far], tolerance_m))
        free = q_mean[far] - turn[far] * p_mean[far]
        shift[far] = free * np.minimum(1, tolerance_m / np.maximum(np.abs(free), 1e-30))
    error = turn[..., None] * p + shift[..., None] - q
    rms = np.sqrt(np.mean(np.abs(error) ** 2, axis=-1))
    xy = np.stack([shift.real, shift.imag], axis=-1)
    return rms.reshape(shape), np.angle(turn).reshape(shape), xy.reshape(*shape, 2)


def _misfit(
    angle: NDArray[np.float64],
    cross: NDArray[np.complex128],
    centroid: NDArray[np.complex128],
    other_centroid: NDArray[np.complex128],
    tolerance_m: float,
) -> NDArray[np.float64]:
    """Residual mean square distance at an angle, up to a constant, with a limited shift, m^2.

    The centred points contribute const - 2 Re(exp(-i angle) cross), the means what the shift cannot absorb.
    """
    turn = np.exp(1j * angle)
    beyond = np.maximum(np.abs(other_centroid - turn * centroid) - tolerance_m, 0)
    return np.asarray(beyond**2 - 2 * (turn.conj() * cross).real)


def _held_turn(
    cross: NDArray[np.complex128],
    centroid: NDArray[np.complex128],
    other_centroid: NDArray[np.complex128],
    tolerance_m: float,
) -> NDArray[np.float64]:
    """Rotations (n,), rad, that minimise `_misfit`.

    One term grows with the distance from the angle that fits the shapes, the other with that from the angle
    that fits the means. The minimum is on the shorter arc between the two; it is bracketed on a grid and
    refined by the secant method on the slope. `cross` (n,) is the mean of conj(p) q of the centred points,
    m^2; the centroids (n,) are means of the points and of their partners, m.
    """
    begin = np.angle(cross)
    arc = np.angle(other_centroid * centroid.conj() * np.exp(-1j * begin))

    def slope_at(part: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivative of `_misfit` with respect to the part of the arc, m^2."""
        turn = np.exp(1j * (begin + part * arc))
        gap = other_centroid - turn * centroid
        length = np.maximum(np.abs(gap), 1e-30)
        beyond = np.maximum(length - tolerance_m, 0)
        pull = (gap.conj() * turn * centroid).imag / length
        return np.asarray((2 * beyond * pull - 2 * (turn.conj() * cross).imag) * arc)

    grid = np.linspace(0, 1, _ARC_STEPS + 1)[:, None]
    best = np.argmin(_misfit(begin + grid * arc, cross, centroid, other_centroid, tolerance_m), axis=0)
    low, high = (np.clip(best + step, 0, _ARC_STEPS) / _ARC_STEPS for step in (-1, 1))
    fall, rise = slope_at(low), slope_at(high)
    for _ in range(_SECANTS):
        # Illinois: a secant method that halves the slope of a retained end, so that both ends converge.
        middle = low + (high - low) * np.clip(fall / np.minimum(fall - rise, -1e-300), 0.0, 1.0)
        middle = np.where((fall < 0) & (rise > 0), middle, np.where(fall >= 0, low, high))
        slope = slope_at(middle)
        up = slope > 0
        low, high = np.where(up, low, middle), np.where(up, middle, high)
        fall, rise = np.where(up, fall / 2, slope), np.where(up, slope, rise / 2)
    return np.asarray(begin + middle * arc)


def all_distances(
    points: NDArray[np.float64], centre_tolerance_m: float = CENTRE_TOLERANCE_M, *, mirrored: bool = False
) -> NDArray[np.float64]:
    """(n, n) rotational distances (RMS over reflectors, m) of layouts (n, K, 2), K! pairings each.

    Same result as `rotational_distance` of every pair, vectorised: the unlimited shift bounds every pairing,
    so the limited shift is computed only where it could still be the smallest. Of layouts (n, K, 3) the
    weighted heights are compared after a common shift. If `mirrored`, every layout is compared with the
    mirror image of every other.
    """
    z = points[..., 0] + 1j * points[..., 1]
    images = z.conj() if mirrored else z
    n, k = z.shape
    mean = z.mean(axis=1)
    centred = z - mean[:, None]
    image_mean = images.mean(axis=1)
    image = images - image_mean[:, None]
    energy = np.mean(np.abs(centred) ** 2, axis=1)
    orders = list(permutations(range(k)))
    out = np.zeros((n, n))
    rows = max(1, _BLOCK // (n * len(orders)))
    for at in range(0, n, rows):
        a = slice(at, min(at + rows, n))
        cross = np.stack([centred[a].conj() @ image[at:, list(order)].T for order in orders]) / k
        centroid, other_centroid = mean[a, None], image_mean[None, at:]
        both = energy[a, None] + energy[None, at:] + _height_differences(points, a, orders)
        size = np.abs(cross)
        least = both - 2 * size
        shifted = np.abs(other_centroid - centroid * (cross / np.maximum(size, 1e-300)))
        by_shape = least + np.maximum(shifted - centre_tolerance_m, 0) ** 2
        toward = np.exp(1j * np.angle(other_centroid * centroid.conj()))
        by_mean = both - 2 * (toward.conj() * cross).real
        by_mean += np.maximum(np.abs(np.abs(other_centroid) - np.abs(centroid)) - centre_tolerance_m, 0) ** 2
        square = np.minimum(by_shape, by_mean).min(axis=0)
        open_ = (least < square - 1e-15) & (by_shape > least + 1e-15)
        which, i, j = np.nonzero(open_)
        held = _held_turn(cross[which, i, j], mean[a][i], image_mean[at:][j], centre_tolerance_m)
        value = both[which, i, j] + _misfit(
            held, cross[which, i, j], mean[a][i], image_mean[at:][j], centre_tolerance_m
        )
        np.minimum.at(square, (i, j), value)
        out[a, at:] = np.sqrt(np.maximum(square, 0))
    out = np.triu(out, 1)
    return out + out.T


def _height_differences(
    points: NDArray[np.float64], rows: slice, orders: Sequence[tuple[int, ...]]
) -> NDArray[np.float64]:
    """(orders, a, n - first) mean square differences of the heights of layouts `rows` from those that
    follow."""
    later = points[rows.start :]
    if points.shape[-1] == 2:
        return np.zeros((len(orders), len(points[rows]), len(later)))
    heights = points[rows, None, :, 2]
    return np.stack(
        [((d := heights - later[None, :, list(o), 2]) ** 2).mean(-1) - d.mean(-1) ** 2 for o in orders]
    )


def _nearest_pairing(small: NDArray[np.float64], large: NDArray[np.float64], tolerance_m: float) -> Pairing:
    best: Pairing | None = None
    for rotation in np.arange(0, 2 * np.pi, _ROTATION_STEP_RAD):
        angle, shift, rise = float(rotation), np.zeros(2), 0.0
        for _ in range(4):
            turned = small[:, :2] @ rotation_matrix(angle).T
            square = np.sum((turned[:, None] + shift - large[None, :, :2]) ** 2, axis=2)
            if small.shape[1] == 3:
                square += (small[:, None, 2] - large[None, :, 2] - rise) ** 2
            columns = least_assignment(square)
            rms, angles, shifts = best_places(small[:, :2], large[columns, :2], tolerance_m)
            if small.shape[1] == 3:
                rise = float(np.mean(small[:, 2] - large[columns, 2]))
            angle, shift = float(angles), shifts
        risen = _risen(small, large[columns])
        whole = float(np.sqrt(float(rms) ** 2 + np.mean(risen**2)))
        if best is None or whole < best.rms_m:
            turned = small[:, :2] @ rotation_matrix(angle).T
            apart = np.column_stack([turned + shift - large[columns, :2], risen])
            best = Pairing(whole, float(np.linalg.norm(apart, axis=1).max()), angle, shift, columns)
    assert best is not None
    return best


def least_assignment(cost: NDArray[np.floating]) -> NDArray[np.intp]:
    """(rows,) column of each row of costs (rows, columns), such that no column is taken twice and the sum is
    least.

    Shortest augmenting paths with potentials (R. Jonker, A. Volgenant, Computing 38, 1987); no more rows than
    columns.
    """
    rows, columns = cost.shape
    by_row, by_column = np.zeros(rows), np.zeros(columns)
    owner = np.full(columns, -1)
    for row in range(rows):
        reach = np.full(columns, np.inf)
        before = np.full(columns, -1)
        done = np.zeros(columns, dtype=bool)
        here, last, length = row, -1, 0.0
        while True:
            step = length + cost[here] - by_row[here] - by_column
            nearer = ~done & (step < reach)
            reach[nearer], before[nearer] = step[nearer], last
            last = int(np.argmin(np.where(done, np.inf, reach)))
            length = float(reach[last])
            done[last] = True
            if owner[last] < 0:
                break
            here = int(owner[last])
        # Potentials keep the reduced costs of all pairs non-negative, and those of assigned pairs zero.
        by_row[row] += length
        for column in np.flatnonzero(done):
            if owner[column] >= 0:
                by_row[owner[column]] += length - reach[column]
            by_column[column] -= length - reach[column]
        while last >= 0:
            previous = int(before[last])
            owner[last] = row if previous < 0 else owner[previous]
            last = previous
    assigned = np.empty(rows, dtype=np.intp)
    taken = np.flatnonzero(owner >= 0)
    assigned[owner[taken]] = taken
    return assigned
