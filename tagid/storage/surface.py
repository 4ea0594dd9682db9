"""The surface of constant magnitude in a volume, as triangles, by marching tetrahedra.

A. Doi and A. Koide, "An efficient method of triangulating equi-valued surfaces by using tetrahedral cells",
IEICE Transactions E74 (1991): every cube of eight voxels is cut into six tetrahedra about one diagonal, and
each of them holds no, one or two triangles. The surface has no holes, because neighbouring cubes share the
cut of their face.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_CORNERS = np.array([[z, y, x] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
_TETRAHEDRA = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])
"""Corners of the six tetrahedra about the diagonal from corner 0 to corner 7, all of positive orientation."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A closed or bounded surface.

    Attributes:
        points: (n, 3) float64 vertices x, y, z.
        triangles: (m, 3) int32 numbers of vertices, counter-clockwise seen from the side of smaller values.
    """

    points: NDArray[np.float64]
    triangles: NDArray[np.int32]


def isosurface(values: NDArray[np.floating], level: float, axes: tuple[NDArray[np.floating], ...]) -> Surface:
    """The surface at which linearly interpolated values equal a level.

    Args:
        values: (levels, rows, columns), z, y, x.
        level: of the surface.
        axes: coordinates of the values along z, y and x.
    """
    shape = np.array(values.shape)
    above = values > level
    corner = [above[tuple(slice(o, n - 1 + o) for o, n in zip(at, shape, strict=True))] for at in _CORNERS]
    count = np.sum(corner, axis=0)
    cubes = np.stack(np.nonzero((count > 0) & (count < 8)), axis=1)
    numbers = np.ravel_multi_index(tuple(np.moveaxis(cubes[:, None] + _CORNERS, 2, 0)), values.shape)
    ends = numbers[:, _TETRAHEDRA].reshape(-1, 4)
    inside = above.ravel()[ends]
    edges = np.concatenate([_one(ends, inside), _one(ends, ~inside)[:, ::-1], _two(ends, inside)])
    if not len(edges):
        return Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    pairs, triangles = np.unique(np.sort(edges.reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    flat = values.ravel().astype(np.float64)
    first, second = flat[pairs[:, 0]], flat[pairs[:, 1]]
    part = (level - first) / (second - first)
    places = [
        np.asarray(axis)[index]
        for axis, index in zip(axes, np.unravel_index(pairs, values.shape), strict=True)
    ]
    ends_at = np.stack(places[::-1], axis=-1)
    points = ends_at[:, 0] + part[:, None] * (ends_at[:, 1] - ends_at[:, 0])
    return Surface(points, triangles.reshape(-1, 3).astype(np.int32))


def _one(ends: NDArray[np.intp], inside: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(n, 3, 2) edges of the triangles of tetrahedra with one corner inside."""
    some = ends[inside.sum(axis=1) == 1]
    which = np.argmax(inside[inside.sum(axis=1) == 1], axis=1)
    # The other corners in the order in which they turn about the first one, for each place of that.
    others = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])[which]
    own = np.take_along_axis(some, which[:, None], axis=1)
    rest = np.take_along_axis(some, others, axis=1)
    return np.stack([np.broadcast_to(own, rest.shape), rest], axis=-1)


def _two(ends: NDArray[np.intp], inside: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(2 n, 3, 2) edges of the two triangles each of tetrahedra with two corners inside."""
    chosen = inside.sum(axis=1) == 2
    some, order = ends[chosen], np.argsort(~inside[chosen], axis=1, kind="stable")
    a, b, c, d = np.take_along_axis(some, order, axis=1).T
    # A permutation of odd parity turns the tetrahedron inside out.
    odd = np.array([np.linalg.det(np.eye(4)[row]) < 0 for row in order], dtype=bool)
    c, d = np.where(odd, d, c), np.where(odd, c, d)
    ac, ad, bd, bc = (np.stack(pair, axis=-1) for pair in ((a, c), (a, d), (b, d), (b, c)))
    return np.concatenate([np.stack([ac, ad, bd], axis=1), np.stack([ac, bd, bc], axis=1)])
