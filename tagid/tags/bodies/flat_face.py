"""Whether neighbours on flat faces explain the echo where a layout's reflectors were found.

Reflectors side by side on one face of a box shine in one direction, that of the face, not each along its own
radius. The wave from two of them is that of one times the pattern of the pair, which a common pattern of
three terms holds; the pattern of one reflector over that of a pair, which has zeros, no common pattern holds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.body_reading import Placed
from tagid.tags.bodies.reflectors_fit import COMMON, FACING, OPEN, Batch, Fitter, Pattern, joined

HALF_GAPS_M = (0.012, 0.015, 0.018, 0.022)
"""Half the distance between neighbours: nearer ones are seen as one reflector (`arrangement.MERGED_M`), and
those further apart have patterns that no few terms hold."""
REACH_M = 8e-3
"""The ring's radius moves so far from that at which the face is as far from the axis as the layout was."""
ROUNDS = 5


def least_on_faces(fitter: Fitter, best: Placed) -> float:
    """Least energy left by two neighbours on a flat face in place of every reflector of a layout.

    Patterns have three terms. Neighbours lie on either side of the layout's reflectors, equally far apart.

    Args:
        fitter: of the spectra and the body.
        best: the layout where it was found.
    """
    rows = [_row(best, half, pattern) for half in HALF_GAPS_M for pattern in (FACING, OPEN)]
    return float(fitter.fitted(joined(rows), ROUNDS)[1].min())


def _row(best: Placed, half_gap_m: float, pattern: Pattern) -> Batch:
    """Neighbours so far apart, moving and turning as a whole."""
    face = float(best.radii.mean())
    aside, radius = np.arctan(half_gap_m / face), float(np.hypot(face, half_gap_m))
    k = 2 * len(best.angles)
    at = np.zeros((1, COMMON + k))
    at[0, :COMMON] = best.batch.at[0, :COMMON]
    at[0, 2] = 0.0
    at[0, COMMON:] = np.concatenate([best.angles - aside, best.angles + aside])
    one, each = np.ones(1), np.ones((1, k))
    return Batch(
        at,
        radius * each,
        0 * each,
        each,
        np.repeat([aside, -aside], k // 2)[None],
        one * pattern.tilt,
        one * pattern.terms,
        _moves(k)[None],
        -REACH_M * one,
        REACH_M * one,
        0 * one,
    )


def _moves(count: int) -> NDArray[np.float64]:
    """(7, 6 + count) radius, centre, the body's pose, and the turn of all reflectors."""
    unit = np.eye(COMMON + count)
    return np.append(unit[[2, 0, 1, 3, 4, 5]], unit[COMMON:].sum(axis=0, keepdims=True), axis=0)
