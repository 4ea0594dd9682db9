"""The static potentials of a triangle in closed form, and quadrature rules on triangles."""

from __future__ import annotations

import numpy as np

from tagid.types import Floats

_A1, _B1 = 0.059715871789770, 0.470142064105115
_A2, _B2 = 0.797426985353087, 0.101286507323456

RULE_3 = (np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4]]) / 6, np.full(3, 1 / 3))
"""Barycentric points (3, 3) and weights (3,) of sum 1; exact for degree 2 (Dunavant, Int. J. Numer. Meth.
Eng. 21, 1129, 1985)."""

RULE_7 = (
    np.array(
        [
            [1 / 3, 1 / 3, 1 / 3],
            *([_A1, _B1, _B1], [_B1, _A1, _B1], [_B1, _B1, _A1]),
            *([_A2, _B2, _B2], [_B2, _A2, _B2], [_B2, _B2, _A2]),
        ]
    ),
    np.array([0.225, *[0.132394152788506] * 3, *[0.125939180544827] * 3]),
)
"""As `RULE_3` with 7 points; exact for degree 5 (Dunavant, 1985)."""


def static_potentials(points: Floats, corners: Floats) -> tuple[Floats, Floats]:
    """int dS' / R and int r' dS' / R over triangles, R = |r - r'|.

    The surface integral is converted to one along the edges (Wilton, Rao, Glisson, Schaubert, Al-Bundak,
    Butler, IEEE Trans. Antennas Propag. 32, 276, 1984, equations 5 and 6). It holds everywhere, also on the
    triangle itself.

    Args:
        points: (n, q, 3) observation points r, m.
        corners: (n, 3, 3) corners of the triangles, m.

    Returns:
        (n, q) in m, and (n, q, 3) in m^2.
    """
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = np.einsum("nqc,nc->nq", points - corners[:, None, 0], normal)
    foot = points - height[..., None] * normal[:, None]
    scalar = np.zeros(height.shape)
    in_plane = np.zeros(points.shape)
    for i in range(3):
        a, b = corners[:, i], corners[:, (i + 1) % 3]
        along = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
        outward = np.cross(along, normal)
        begin = np.einsum("nqc,nc->nq", a[:, None] - foot, along)
        end = np.einsum("nqc,nc->nq", b[:, None] - foot, along)
        offset = np.einsum("nqc,nc->nq", a[:, None] - foot, outward)
        square = offset**2 + height**2
        r_begin, r_end = np.sqrt(begin**2 + square), np.sqrt(end**2 + square)
        # Of two equivalent forms of the logarithm, use the one without cancellation.
        ahead = begin + end > 0
        top = np.where(ahead, r_end + end, r_begin - begin)
        bottom = np.where(ahead, r_begin + begin, r_end - end)
        # On the line of the edge the factor in front of the logarithm is zero.
        on_line = square < 1e-20
        log = np.log(np.where(on_line, 1.0, top) / np.where(on_line, 1.0, bottom))
        safe = np.where(on_line, 1.0, square)
        distance = np.abs(height)
        scalar += offset * log - distance * (
            np.arctan(offset * end / (safe + distance * r_end))
            - np.arctan(offset * begin / (safe + distance * r_begin))
        )
        line = 0.5 * (square * log + end * r_end - begin * r_begin)
        in_plane += line[..., None] * outward[:, None]
    return scalar, in_plane + scalar[..., None] * foot
