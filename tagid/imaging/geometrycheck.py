"""Whether the scans fit the geometry that is given with them: errors that an image in focus does not show.

Where views are dense an image under wrong angles, another axis distance or another wavelength predicts
held-out views, too (`tagid.imaging.heldout`). What such an error changes is where scans repeat, whether the
ends of a turn continue in each other, and how much of the scans a few points explain. Angles of the opposite
direction change nothing: they are those of the mirror image. A wavelength 5 % off changes what points leave
by less than a hundredth of the scans' energy, no more than a pulse that is not quite as assumed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tagid.geometry import ImageGrid
from tagid.imaging.autofocus import far_axis
from tagid.imaging.pointmodel import ENOUGH_VIEWS, GROUPS, PointSearch, needed_evidence, t_value
from tagid.imaging.preprocess import thinned
from tagid.imaging.types import BasebandScans
from tagid.types import Floats

_LEAST_VIEWS = 24
_WHOLE = 1.05
"""Steps of the angle by which a whole turn may miss or exceed 360 degrees."""
_HALF = (np.deg2rad(90), np.deg2rad(300))
"""Parts of a turn, rad, whose ends are no neighbours."""
_REPEATED = 0.9
"""Correlation of the halves of a turn, noise subtracted, of two turns. Objects that look much the same from
opposite sides reach it, too: points then explain the turn better than two."""
_WORSE = -0.75
"""t value from which on they do not."""
_DENSE = 0.6
"""Median difference of neighbouring scans, over their energy, up to which they tell whether a turn closes."""
_WORST, _POOR, _USUAL = 0.02, 0.05, 0.1
"""Share of the neighbours that differ as much as the ends of a turn: at most the first where it does not
close, the second where points fit half a turn better, too; more than the third where they are neighbours."""
_APART = 0.2
"""Difference of the ends of a turn, over their energy, that does not close, at least."""
_CLEAR = 1.0
"""Energy of two scans over that of their noise from which on their difference counts."""
_SURE = needed_evidence(GROUPS)
"""t value from which on points fit better under other angles."""


def _better(scans: BasebandScans, grid: ImageGrid, factor: float) -> float:
    """How much better points explain scans with their angles times a factor: t value over the sectors."""
    some = thinned(scans, ENOUGH_VIEWS)
    aperture = some.aperture
    assert aperture.angles is not None and aperture.axis_distance is not None
    search = PointSearch(some, grid)
    turned = aperture.turned(aperture.angles * factor, aperture.axis_distance)
    return float(t_value(search.explain(aperture).left - search.explain(turned).left))


class _Neighbours(NamedTuple):
    """How much neighbouring scans differ.

    Attributes:
        median: difference of neighbours over their energy, noise subtracted.
        ends: that of the last scan and the first.
        worse: share of them that differ as much as the last scan and the first.
    """

    median: float
    ends: float
    worse: float


def _neighbours(scans: BasebandScans) -> _Neighbours | None:
    """None where noise hides it."""
    samples = scans.samples.astype(np.complex128)
    following = np.roll(samples, -1, axis=0)
    noise = 2 * scans.noise_std**2 * samples.shape[1]
    energy = _energy(samples) + _energy(following) - noise
    apart = (_energy(samples - following) - noise) / np.maximum(energy, 1e-300)
    clear = energy > _CLEAR * noise
    *between, ends = clear
    if not ends or not np.any(between):
        return None
    known = apart[:-1][between]
    return _Neighbours(float(np.median(known)), float(apart[-1]), float((known >= apart[-1]).mean()))


def _energy(samples: NDArray[np.complex128]) -> Floats:
    return np.asarray((np.abs(samples) ** 2).sum(axis=1))


def turn_warning(scans: BasebandScans, grid: ImageGrid) -> str | None:
    """A warning where the scans of a turn do not fit their angles, else None.

    Args:
        scans: of a turntable, without matched filter, in the order of their angles.
        grid: the square of interest.
    """
    angles = scans.aperture.angles
    if angles is None or len(angles) < _LEAST_VIEWS or not np.any(scans.samples):
        return None
    angles = np.unwrap(angles)
    span, step = float(np.ptp(angles)), float(np.median(np.abs(np.diff(angles))))
    if abs(span + step - 2 * np.pi) <= _WHOLE * step:
        return _whole_turn(scans, grid, angles)
    return _part(scans, grid, span, step) if _HALF[0] <= span <= _HALF[1] else None


def _whole_turn(scans: BasebandScans, grid: ImageGrid, angles: Floats) -> str | None:
    """A warning where scans of a whole turn, by their angles, are those of two or of half of one."""
    alike = _halves_alike(scans, angles)
    if alike > _REPEATED and _better(scans, grid, 2) > _WORSE:
        return (
            "the scans of one half of the turn repeat those of the other (correlation "
            f"{min(alike, 1):.2f}). If the object made two turns, store twice angles_rad, or give twice "
            "the speed (`motion.url`); one that looks the same from opposite sides repeats, too"
        )
    near = _neighbours(scans)
    if near is None or near.worse > _POOR or near.ends < _APART:
        return None
    if not (near.worse <= _WORST and near.median < _DENSE) and _better(scans, grid, 0.5) < _SURE:
        return None
    return (
        "the turn does not close: its last scan and its first differ more than "
        f"{100 * (1 - near.worse):.0f} % of neighbours. Did the object make one turn, and keep its "
        "place? If it made half of one, store half of angles_rad, or give half the speed (`motion.url`)"
    )


def _part(scans: BasebandScans, grid: ImageGrid, span: float, step: float) -> str | None:
    """A warning where scans of a part of a turn, by their angles, rad, are those of a whole one."""
    near, factor = _neighbours(scans), 2 * np.pi / (span + step)
    ends_meet = near is not None and near.worse > _USUAL and near.median < _DENSE
    if not ends_meet and _better(scans, grid, factor) < _SURE:
        return None
    return (
        f"the first scan and the last are as alike as neighbours, though {np.rad2deg(span):.0f} degrees "
        f"apart. If the object made a whole turn, store angles_rad times {factor:.3g}, or give so many times "
        "the speed (`motion.url`)"
    )


def _halves_alike(scans: BasebandScans, angles: Floats) -> float:
    """Correlation of the scans of half a turn with those of the opposite directions, noise subtracted."""
    turned = np.abs(angles - angles[0])
    first = np.flatnonzero(turned < np.pi)
    opposite = np.round(np.interp(turned[first] + np.pi, turned, np.arange(len(turned)))).astype(np.intp)
    one, other = (scans.samples[chosen].astype(np.complex128) for chosen in (first, opposite))
    noise = 2 * scans.noise_std**2 * one.size
    energy = float(_energy(one).sum() + _energy(other).sum()) - noise
    return 2 * float((one.conj() * other).real.sum()) / energy if energy > _CLEAR * noise else 0.0


def axis_warning(scans: BasebandScans, grid: ImageGrid) -> str | None:
    """A warning where the scans of a turntable fit another axis distance, else None.

    Arguments as of `turn_warning`; `FAR_WAVELENGTHS` of range are kept beyond the grid.
    """
    there, given = far_axis(scans, grid), scans.aperture.axis_distance
    if there is None or given is None:
        return None
    off = there - given
    higher = f", or the antenna {np.sqrt(off * (there + given)):.1f} m higher than given" if off > 0 else ""
    return (
        f"the axis seems to be {there:.2f} m from the antenna, not {given:.3f} m{higher}: a few points "
        f"explain the scans better. Measure again, or search farther with `focus_m={1.15 * abs(off):.2g}`"
    )
