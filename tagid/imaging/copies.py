"""Copies of a scene beside it, from antenna positions that are too far apart or too few (grating lobes).

A point p of matched-filtered scans also shows at q, with the part |mean_v g(d_v) exp(2jk d_v)| of its
amplitude, d_v how much farther q is from the antenna of view v and g the range response: a wide band smears
the copies.
"""

from __future__ import annotations

import numpy as np

from tagid.imaging.types import BasebandScans
from tagid.types import Floats

STEPS_PER_RESOLUTION = 8
_SHOWN = 0.28
"""Part of its amplitude from which on a copy is warned of, -11 dB: the first sidelobe of an evenly sampled
path is 0.22, of one that bends 0.26."""
_SHOWN_IN_HEIGHT = 0.5
"""The same between heights: few of them have high sidelobes wherever they are."""
_LEAST_PREDICTED = 0.6
"""A weaker echo is a stronger one's copy where this part of its amplitude is expected there."""
_AROUND = np.linspace(-4, 4, 17)
"""Where a copy, which a wide band blurs, may be: in quarters of the resolution across, or of wavelengths."""


def along_path(scans: BasebandScans) -> Floats:
    """Unit vector (3,) of the direction in which the antenna positions reach farthest."""
    positions = scans.aperture.positions
    return np.asarray(np.linalg.svd(positions - positions.mean(axis=0), full_matrices=False)[2][0])


def path_warning(scans: BasebandScans, extent_m: float) -> str | None:
    """A warning where an image of some extent, m, holds a scene and its copy along the path; else None."""
    apart, strength = strongest_copy(scans, along_path(scans), extent_m)
    if strength < _SHOWN:
        return None
    weaker_db = -20 * np.log10(strength)
    return (
        f"the antenna positions are too far apart: what is here shows again {apart:.2g} m beside itself "
        f"along the path, {weaker_db:.0f} dB weaker; record views up to {scans.wavelength_m / 4:.2g} m "
        f"apart, or give an `imaging.extent_m` below {apart:.2g}"
    )


def height_warning(scans: BasebandScans, rise_m: float, heights: int) -> str | None:
    """A warning where a volume of some rise, m, holds a scene and its copy in height; else None."""
    apart, strength = strongest_copy(scans, np.array([0.0, 0.0, 1.0]), rise_m)
    if strength < _SHOWN_IN_HEIGHT:
        return None
    weaker_db = -20 * np.log10(strength)
    return (
        f"the scene shows again {apart:.2g} m above and below itself, {weaker_db:.0f} dB weaker: "
        f"the {heights} antenna heights are too far apart or too few; record heights in between, or give a "
        f"volume of less than {apart:.2g} m"
    )


def strongest_copy(scans: BasebandScans, direction: Floats, reach_m: float) -> tuple[float, float]:
    """Distance, m, and relative amplitude of the strongest copy of the origin along a unit vector (3,), or
    (0, 0). Copies count up to `reach_m`; the aperture of the matched-filtered scans is seen from the middle
    of the scene.
    """
    across = float(np.ptp(scans.aperture.positions @ direction))
    distance = float(np.median(scans.aperture.distances(np.zeros((1, 3)))))
    if not across > 0 or not (resolution := scans.wavelength_m * distance / (2 * across)) < reach_m:
        return 0.0, 0.0
    apart = np.arange(resolution, reach_m, resolution / STEPS_PER_RESOLUTION)
    apart = np.concatenate([-apart[::-1], apart])
    strength = _shown_at(scans, np.zeros(3), apart[:, None] * direction)
    strongest = int(np.argmax(strength))
    return abs(float(apart[strongest])), float(strength[strongest])


def are_copies(scans: BasebandScans, points: Floats, amplitudes: Floats) -> list[bool]:
    """Whether each of some echoes, at points (n, 2), m, strongest first, is a copy of a stronger one; the
    scans are matched-filtered.
    """
    positions = scans.aperture.positions
    distance = np.median(scans.aperture.distances(points))
    fine = scans.wavelength_m * distance / (4 * max(float(np.ptp(positions, axis=0).max()), 1e-9))
    steps = np.stack(np.meshgrid(_AROUND, _AROUND), axis=-1).reshape(-1, 2)
    copies = [False] * len(points)
    for weaker in range(1, len(points)):
        around = points[weaker] + steps * max(fine, scans.wavelength_m / 4)
        around = np.column_stack([around, np.zeros(len(around))])
        for stronger in np.flatnonzero(~np.array(copies[:weaker])):
            shown = _shown_at(scans, np.array([*points[stronger], 0.0]), around, free=False).max()
            if shown * amplitudes[stronger] >= _LEAST_PREDICTED * amplitudes[weaker]:
                copies[weaker] = True
                break
    return copies


def _shown_at(scans: BasebandScans, point: Floats, points: Floats, free: bool = True) -> Floats:
    """(n,) part of the amplitude of a point (3,) that shows at others (n, 3); `free`: those may move by
    the mean difference of their ranges."""
    ranges = scans.aperture.distances(points) - scans.aperture.distances(point[None])
    if free:
        ranges -= ranges.mean(axis=0)
    phases = np.exp(4j * np.pi / scans.wavelength_m * ranges)
    return np.asarray(np.abs((scans.response(ranges) * phases).mean(axis=0)), dtype=np.float64)
