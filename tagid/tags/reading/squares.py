"""Least squares of the scans on sets of points, by the compiled loops or by numpy, which do the same."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.tags.reading.aspect import Aspect
from tagid.tags.reading.compiled import MOST_POINTS, Explained
from tagid.tags.reading.field import MatchedField


def least_squares(
    b: NDArray[np.complex128], gram: NDArray[np.complex128]
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Amplitudes (..., K) = G^-1 b and explained energy (...) = b^H G^-1 b; G is loaded by 1e-2 of itself."""
    k = b.shape[-1]
    size = np.maximum(np.abs(np.trace(gram, axis1=-2, axis2=-1)) / k, 1e-30)  # one that nobody sees is 0
    load = 1e-2 * size[..., None, None] * np.eye(k)
    amplitudes = np.linalg.solve(gram + load, b[..., None])[..., 0]
    explained = np.real(np.sum(b.conj() * amplitudes, axis=-1))
    return np.asarray(amplitudes, dtype=np.complex128), np.maximum(
        np.asarray(explained, dtype=np.float64), 0.0
    )


def explained_by(
    field: MatchedField,
    aspect: Aspect,
    points: NDArray[np.float64],
    facing: NDArray[np.float64],
    offset_m: NDArray[np.float64] | float,
    sets: NDArray[np.intp],
) -> Explained:
    """What sets of points explain.

    Args:
        field: matched field of the scans.
        aspect: pattern of the points.
        points: (N, 2) in the plane, or (N, 3), m.
        facing: (N, 2) outward unit vectors, (0, 0) for points without a side.
        offset_m: measured distances are this much longer than the aperture says, of all points or (N,), m.
        sets: (H, K) indices of points.
    """
    heights = points[:, 2] if points.shape[1] == 3 else np.zeros(len(points))
    offsets = np.broadcast_to(np.asarray(offset_m, dtype=np.float64), len(points))
    if field.tables is not None and sets.shape[1] <= MOST_POINTS:
        places = np.column_stack([points[:, :2], heights])
        return field.tables.explained(places, facing, offsets, aspect.numbers, sets)
    distances = field.distances(points[:, :2], heights) + offsets[:, None]
    templates = field.templates(distances, aspect.weight(field.antenna, points, facing))
    b = field.correlate(templates)[sets]
    if sets.size == len(points):  # each in one set
        gram = field.gram(templates[sets])
    else:
        gram = field.gram(templates)[sets[:, :, None], sets[:, None]]
    return Explained(*least_squares(b, gram), gram)


def separate_sets(groups: int, size: int) -> NDArray[np.intp]:
    """(groups, size) indices of points of which each belongs to one set."""
    return np.arange(groups * size).reshape(groups, size)


def whole_grams(
    field: MatchedField,
    aspect: Aspect,
    points: NDArray[np.float64],
    heights: NDArray[np.float64],
    facing: NDArray[np.float64],
) -> NDArray[np.complex128]:
    """(A, K, K) inner products of templates, with what is constant over the views, of points (A, K, 2).

    Args:
        field, aspect: see `explained_by`.
        points: (A, K, 2) m.
        heights: (K,) m.
        facing: (A, K, 2).
    """
    a, k = points.shape[:2]
    if field.tables is not None and k <= MOST_POINTS:
        places = np.concatenate([points, np.broadcast_to(heights[:, None], (a, k, 1))], axis=2)
        sets, none = separate_sets(a, k), np.zeros(a * k)
        flat = places.reshape(-1, 3), facing.reshape(-1, 2), none
        return field.tables.explained(*flat, aspect.numbers, sets, whole=True).gram
    weight = aspect.weight(field.antenna, points, facing)
    return field.full_gram(field.distances(points, heights), weight)
