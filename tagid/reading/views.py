"""Resampling of many views to the fewest that the object's size needs.

Reading time is then independent of the number of views. A point at radius r produces angular frequencies up
to 2 k r in the scans; higher ones contain only noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tagid.geometry import Aperture
from tagid.imaging.preprocess import select_views
from tagid.imaging.types import BasebandScans

GUARD_ORDERS = 10
"""Bessel functions J_m(x) fall below 1 % within about ten orders above m = x, for x up to 50."""
WIDEST_GAP = 1.5
"""Steps of the even views that a gap may span: the fit raises the noise within it to twice that elsewhere."""
EVEN_RAD = 1e-6
"""Steps between even views differ by less."""
SECTOR = 1 / 1.4
"""Width of the sectors of a turn with gaps, in steps: a reflector at 0.06 m loses 0.15 dB at 4.8 GHz."""
SAME_DISTANCE_M = 1e-3
"""Positions whose distances from the axis differ by less lie on one circle."""
BAND_MARGIN = 1.25
"""Ratio of the highest frequency of the band to the carrier: 4.8 / 3.95 GHz, rounded up."""


def fold_views(scans: BasebandScans, radius_m: float) -> BasebandScans:
    """Full turns of many or uneven views, resampled to the fewest even views that represent a disc.

    The angular frequencies up to 2 k r and a guard are fitted to the views by least squares, which keeps
    white noise white. Antenna positions on circles at several heights are resampled circle by circle. Of
    turns with gaps, views within `SECTOR` of that step are averaged. Scans with few views, with even ones
    that are no more than needed, or from other positions are returned unchanged.

    Args:
        scans: (views, bins) scans of a turntable aperture.
        radius_m: radius of the disc around the axis that must be preserved, m.
    """
    if scans.aperture.angles is None:
        return _fold_heights(scans, radius_m)
    angles, distance = scans.aperture.angles, scans.aperture.axis_distance
    needed = int(np.ceil(2 * BAND_MARGIN * scans.wavenumber * radius_m)) + GUARD_ORDERS
    count = _fast(2 * needed + 1)
    if angles is None or distance is None or len(angles) < count:
        return scans
    turn = np.mod(angles, 2 * np.pi)
    gap = np.diff(np.sort(turn), append=turn.min() + 2 * np.pi)
    if gap.max() > WIDEST_GAP * 2 * np.pi / count or scans.angle_scale_sigma:
        # What is not known to be one turn has a seam that no filter may cross.
        return _averaged(scans, turn, 2 * needed + GUARD_ORDERS)
    if len(angles) < 1.5 * count and np.ptp(gap) < EVEN_RAD:
        return scans
    orders = np.arange(-((count - 1) // 2), (count + 1) // 2)
    new = np.arange(count) * 2 * np.pi / count
    waves = np.exp(1j * np.outer(turn, orders))
    fold = (np.exp(1j * np.outer(new, orders)) @ np.linalg.pinv(waves)).real
    return replace(
        scans,
        samples=(fold @ scans.samples).astype(np.complex64),
        aperture=scans.aperture.turned(new, distance),
        noise_std=scans.noise_std * float(np.sqrt(np.mean(np.sum(fold**2, axis=1)))),
        independent_samples=scans.independent_samples * count / len(turn),
    )


def _fast(least: int) -> int:
    """The smallest number from `least` on without a prime factor above 5, whose transform is fast."""
    threes_and_fives = [three * five for three in (1, 3, 9, 27, 81) for five in (1, 5, 25, 125)]
    return min(number << twos for number in threes_and_fives for twos in range(12) if number << twos >= least)


def _averaged(scans: BasebandScans, turn: NDArray[np.float64], count: int) -> BasebandScans:
    """The means of views at angles (V,), rad, over sectors of `SECTOR` steps of `count` views a turn."""
    sector = np.floor(turn * count / (2 * np.pi * SECTOR)).astype(np.intp)
    _, group, size = np.unique(sector, return_inverse=True, return_counts=True)
    if len(turn) < 1.5 * len(size):
        return scans
    share = (group == np.arange(len(size))[:, None]) / size[:, None]
    distance = scans.aperture.axis_distance
    assert distance is not None
    return replace(
        scans,
        samples=(share @ scans.samples).astype(np.complex64),
        aperture=scans.aperture.turned(share @ turn, distance),
        noise_std=scans.noise_std * float(np.sqrt(np.mean(1 / size))),
        independent_samples=scans.independent_samples * len(size) / len(turn),
    )


def _fold_heights(scans: BasebandScans, radius_m: float) -> BasebandScans:
    """Turns at several antenna heights, each folded; the scans unchanged if a height is not a circle."""
    aperture = scans.aperture
    groups = aperture.height_groups()
    if len(groups) < 2 or aperture.half_baseline is not None:
        return scans
    parts = []
    for views in groups:
        x, y, z = aperture.positions[views].T
        away = np.hypot(x, y)
        if np.ptp(away) > SAME_DISTANCE_M:
            return scans
        circle = Aperture.turntable(-np.arctan2(y, x), float(away.mean()), float(z.mean()))
        parts.append(fold_views(select_views(scans, views).with_aperture(circle), radius_m))
    return replace(
        scans,
        samples=np.concatenate([part.samples for part in parts]),
        aperture=Aperture(np.concatenate([part.aperture.positions for part in parts])),
        noise_std=float(np.sqrt(np.mean([part.noise_std**2 for part in parts]))),
        independent_samples=sum(part.independent_samples for part in parts),
    )
