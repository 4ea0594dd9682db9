"""Whether a whole turn closes: its last scan continues in its first.

It needs no image, and no knowledge of the scene: only views so dense that neighbours resemble each other.
Angles of a part of a turn, or of more than one, that are given as a turn leave a gap there, and so does an
object that moved.
"""

from __future__ import annotations

import numpy as np

from tagid.imaging.types import BasebandScans
from tagid.types import Floats

_LEAST_VIEWS = 24
_LEAST_ALIKE = 0.6
"""Median correlation of neighbouring scans from which on they tell whether a turn closes."""
_APART = 0.1
"""How much less alike than all neighbours the ends of a turn are that does not close."""
_WHOLE = 0.5
"""Steps of the angle by which a whole turn may miss or exceed 360 degrees."""


def closure_warning(scans: BasebandScans) -> str | None:
    """A warning where the ends of a whole turn are no neighbours; else None.

    Args:
        scans: without matched filter, in the order of their angles.
    """
    if scans.aperture.angles is None or scans.aperture.views < _LEAST_VIEWS:
        return None
    angles = np.unwrap(scans.aperture.angles)
    step = float(np.median(np.abs(np.diff(angles))))
    if abs(float(np.ptp(angles)) + step - 2 * np.pi) > _WHOLE * step:
        return None
    *between, ends = _alike(scans)
    if np.median(between) < _LEAST_ALIKE or ends >= min(between) - _APART:
        return None
    return (
        f"the turn does not close: its last scan and its first are less alike ({ends:.2f}) than any "
        f"neighbours ({min(between):.2f} to {max(between):.2f}). Did the object make one turn, and keep its "
        "place? If it made half of one, store half of angles_rad, or give half the speed (`motion.url`)"
    )


def _alike(scans: BasebandScans) -> Floats:
    """(views,) correlation of every scan with the next, the first following the last."""
    one, other = scans.samples, np.roll(scans.samples, -1, axis=0)
    product = (one.conj() * other).real.sum(axis=1, dtype=np.float64)
    energy = (np.abs(one) ** 2).sum(axis=1, dtype=np.float64)
    return np.asarray(product / np.sqrt(np.maximum(energy * np.roll(energy, -1), 1e-300)))
