"""The two sides of a path: what lies on one side of a straight path shows on the other side, too.

A path that bends a little shows an echo's mirror image nearly as bright, in focus at another delay: a bend of
a centimetre over three metres passes for a quarter of a metre of delay.
"""

from __future__ import annotations

import numpy as np

from tagid.types import Floats

STRAIGHT_WAVELENGTHS = 0.02635
"""A path is straight where it lies within this of a line, rms: 2 mm for a P440, a phase of a third of a
radian."""
DISTINCT_WAVELENGTHS = 0.25
"""Farther than this from a line, rms (19 mm for a P440), a path focuses no mirror image at any delay."""
_LEVEL_WAVELENGTHS = 1e-3
"""A path within this of a line has two sides that nothing tells apart."""


def off_line_m(positions: Floats) -> float:
    """How far positions (views, 3), m, lie from one line, horizontally, rms in m; infinite without a line.

    Heights do not count: from a path in one upright plane both sides of it look the same.
    """
    centred = positions[:, :2] - positions[:, :2].mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(positions))
    return float(spread[1]) if len(positions) > 2 and spread[0] > 0 else float("inf")


def is_straight(positions: Floats, wavelength_m: float) -> bool:
    """True if the positions (views, 3), m, lie above one line to within a fortieth of a wavelength, rms."""
    return off_line_m(positions) < STRAIGHT_WAVELENGTHS * wavelength_m


def side_towards(positions: Floats, towards: tuple[float, float]) -> Floats:
    """Unit normal (2,) of the path on the side of a point (x, y), m; of a point on the path, left of it."""
    centred = positions[:, :2] - positions[:, :2].mean(axis=0)
    along = np.linalg.svd(centred, full_matrices=False)[2][0]
    across = np.array([-along[1], along[0]]) * np.sign(along[0] or 1.0)
    aside = float((np.array(towards) - positions[:, :2].mean(axis=0)) @ across)
    return np.asarray(across if aside >= 0 else -across, dtype=np.float64)


def sides_to_search(
    positions: Floats, wavelength_m: float, towards: tuple[float, float], compare: bool
) -> list[Floats | None]:
    """Sides of a path (views, 3), m, on which its echoes are searched, as unit normals (2,); None is all
    directions.

    That of the point `towards` is first; the other is searched, too, if `compare` and the path may tell them
    apart.
    """
    off = off_line_m(positions)
    if off >= DISTINCT_WAVELENGTHS * wavelength_m:
        return [None]
    near = side_towards(positions, towards)
    return [near, -near] if compare and off >= _LEVEL_WAVELENGTHS * wavelength_m else [near]
