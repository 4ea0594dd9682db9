"""The distance from the radar to the rotation axis, estimated from the scans, with a test of the estimate.

A tape measure does not reach the phase centre of an antenna. A wrong distance shifts every echo in range by
the same amount, which a point cannot follow: seen from all sides it becomes a ring. Whether the scans tell
the distance depends on the object. Isolated reflectors do. A smooth convex body does not: its echo comes from
the nearest wall in every view, so another distance only makes it look larger or smaller.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.backprojection import backproject
from tagid.imaging.lengths import search_range_m
from tagid.imaging.pointmodel import (
    ENOUGH_VIEWS,
    PointSearch,
    band_delays,
    jackknife_error,
    needed_evidence,
    t_value,
)
from tagid.imaging.preprocess import thinned
from tagid.imaging.types import BasebandScans
from tagid.signal import fitted_peak, vertex
from tagid.types import Floats

STEP_WAVELENGTHS = 0.0659
"""Step of the brightness search, 5 mm for a P440. The peak is as wide as the range envelope, which for a
usable band (up to 1.8 times its centre) is more than a quarter of a wavelength; a parabola interpolates
it."""

MOST_WAVELENGTHS = 2.0
"""Widest search: further off, another distance explains points at other places nearly as well."""

MIN_PEAK_DB = 13.0
"""Image peak over its mean noise power below which nothing is focused; noise alone reached 12.1 dB in 80
trials of 12 to 360 views."""

LEAST_SECOND = 0.25
"""Energy of the second spot over that of the first. One spot alone with a nearer axis cannot be told from a
round body whose radius is the difference in distance."""

MOST_SIGMA_WAVELENGTHS = 1 / 16
"""Largest standard error of an estimate that is taken: a wrong one (a quarter off) is four of these away."""

BIAS_WAVELENGTHS = 0.1
"""Standard error that scans cannot show (8 mm for a P440): a delay that is the same in the whole band, as
that of a reflector or of the near wall of a body, passes for distance. Octahedra of 40 mm make it 8 mm too
long."""
PART_OF_TURN = "the views cover part of the turn, in which a shift of the scene passes for distance"
_MOST_GAP = np.pi / 9
"""Widest gap between directions of view over the usual one, rad, of what counts as a turn."""

_RIVAL_WAVELENGTHS = 0.25
"""Distances farther than this from the best one have to be refuted."""
_ENERGY_STEP_WAVELENGTHS = 0.1
BEYOND_SEARCH = "the best distance is at or beyond the edge of the search"
FAR_WAVELENGTHS = 1.7
"""Half width of the search for a distance that is given wrong: 129 mm for a P440, as much as an antenna that
stands 0.5 m higher than given makes at 1 m."""
_FAR_STEP_WAVELENGTHS = 0.2
_BEYOND = 1.4
"""The energy is compared so much farther than the search: what is explained the better the nearer the axis is
put must show it."""
_AGREE_WAVELENGTHS = 0.1
"""Brightness, which has the smaller error where it works, is followed where it agrees with the explained
energy to this."""

_PIXEL_WAVELENGTHS = 0.0922
_MAX_PIXELS = 160
_HALF_WINDOW = 2


@dataclass(frozen=True)
class AxisFocus:
    """What the search for the axis distance found.

    Attributes:
        axis_distance_m: distance that the returned scans assume, m; None for free antenna positions.
        offset_m: its difference from the one given, m; 0 if the given one was kept.
        peak_db: power of the brightest pixel over the mean noise power of a pixel, dB; inf without noise.
        reliable: the estimate passed every test; only then is it taken.
        best_m: the best guess, m, taken or not; None if there was no search.
        sigma_m: its standard error, m: that of the jackknife over the sectors of the turn, that over the
            parts of the band, and `BIAS_WAVELENGTHS`; nan where not known.
        evidence: least t value, over all distances more than a quarter wavelength away, of the hypothesis
            that the sectors of the turn are explained better by the best guess; `needed_evidence` says what
            is needed.
        second: energy of the second spot of the scene over that of the first.
        unexplained: share of the scans' energy that points leave over at the best guess.
        reason: why it was not taken; empty if it was.
    """

    axis_distance_m: float | None
    offset_m: float = 0.0
    peak_db: float = 0.0
    reliable: bool = False
    best_m: float | None = None
    sigma_m: float = float("nan")
    evidence: float = 0.0
    needed: float = 0.0
    second: float = 0.0
    unexplained: float = 1.0
    reason: str = ""

    def facts(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {
            "taken": self.reliable,
            "used_m": self.axis_distance_m,
            "best_guess_m": self.best_m,
            "sigma_m": self.sigma_m if np.isfinite(self.sigma_m) else None,
            "evidence": self.evidence,
            "evidence_needed": self.needed,
            "second_spot": self.second,
            "unexplained": self.unexplained,
            "reason": self.reason,
        }


def focus_axis_distance(
    scans: BasebandScans, grid: ImageGrid, search_m: float | None = None
) -> tuple[BasebandScans, AxisFocus]:
    """The same scans under the axis distance that the scans tell, or unchanged where they do not tell it.

    For each distance of the search a few points are fitted to the scans by least squares (`PointSearch`); the
    best distance leaves the least energy. It is taken only if the views cover a whole turn, the brightest
    pixel stands above the noise (`MIN_PEAK_DB`), and

    - the best distance lies inside the search: a convex body is explained the better the smaller it is made,
    - the scene has a second spot (`LEAST_SECOND`) or asks for a farther axis: a round body looks like a point
      on its own axis with the distance too short by its radius, never like one too far away,
    - the sectors of the turn agree: for each rival distance, the paired difference of what the two leave
      over, sector by sector, has a t value of at least `needed_evidence`,
    - the standard error over the sectors (jackknife) and over the parts of the band (`BandDelays.error_m`,
      which shows bodies and resonances) is at most `MOST_SIGMA_WAVELENGTHS`.

    Sharpness is no criterion: an extended body has no sharpest distance. Within the best region the
    brightness sqrt(sum |f|^8) of the backprojection refines the estimate: of 3 points at 10 dB SNR a sample
    it has an rms error of 1 mm at 36 views, 0.6 mm at 360.

    Args:
        scans: scans of a turntable; those of free antenna positions come back unchanged. Best without the
            matched filter, which gives the edges of the band little weight.
        grid: the square of interest; the search uses its extent with its own pixels.
        search_m: half width of the search, m; None: `search_range_m`.

    Raises:
        UsageError: search_m is not between a thousandth of a wavelength and `MOST_WAVELENGTHS`.
    """
    lam = scans.wavelength_m
    search_m = search_range_m(lam) if search_m is None else search_m
    if not lam / 1000 <= search_m <= MOST_WAVELENGTHS * lam:
        raise UsageError(
            f"the axis search is +-{search_m} m",
            f"Give a half width of up to {MOST_WAVELENGTHS:g} wavelengths ({MOST_WAVELENGTHS * lam:.3g} m).",
        )
    distance = scans.aperture.axis_distance
    if scans.aperture.angles is None or distance is None:
        return scans, AxisFocus(None)
    if distance <= search_m:
        return scans, AxisFocus(distance, reason="the axis is nearer than the search is wide")
    if not _is_turn(scans.aperture.angles):
        return scans, AxisFocus(distance, reason=PART_OF_TURN)
    pixels = int(np.clip(np.ceil(grid.extent / (_PIXEL_WAVELENGTHS * lam)), 2, _MAX_PIXELS))
    search = ImageGrid(grid.extent, pixels)
    few = thinned(scans, ENOUGH_VIEWS)
    offsets = np.linspace(-search_m, search_m, 2 * max(2, round(search_m / (STEP_WAVELENGTHS * lam))) + 1)
    apertures = (few.aperture.with_axis_distance(distance + float(offset)) for offset in offsets)
    images = [backproject(few.with_aperture(aperture), search).values for aperture in apertures]
    measure = np.array([float(np.sqrt(((np.abs(f).astype(np.float64)) ** 8).sum())) for f in images])
    brightest = int(np.argmax(measure))
    if measure[brightest] == 0:
        return scans, AxisFocus(distance, reason="the image is blank")
    bright = fitted_peak(offsets, measure, brightest, _HALF_WINDOW)
    focus = AxisFocus(
        distance,
        peak_db=_peak_db(few, images[brightest]),
        best_m=distance + bright,
    )
    if focus.peak_db < MIN_PEAK_DB:
        reason = f"the image peak is {focus.peak_db:.1f} dB over the noise, {MIN_PEAK_DB:g} dB are needed"
        return scans, replace(focus, reason=reason)
    focus = _judged(focus, few, grid, distance, search_m, bright)
    if not focus.reliable:
        return scans, focus
    return scans.with_aperture(scans.aperture.with_axis_distance(distance + focus.offset_m)), focus


def far_axis(scans: BasebandScans, grid: ImageGrid) -> float | None:
    """The axis distance, m, that the scans of a whole turn fit if the given one is wrong by up to
    `FAR_WAVELENGTHS`; None where they do not show that it is.

    Points must explain the scans better there than at the given distance, and the sectors of the turn agree
    on that. Any round body is explained better by a nearer axis. Such a one needs a second spot, and has to
    be better than all others, nearer ones as well.

    Args:
        scans: without matched filter, with as much range beyond the grid.
        grid: the square of interest.
    """
    given, lam = scans.aperture.axis_distance, scans.wavelength_m
    reach = FAR_WAVELENGTHS * lam
    if (
        scans.aperture.angles is None
        or given is None
        or given <= reach
        or not _is_turn(scans.aperture.angles)
    ):
        return None
    few = thinned(scans, ENOUGH_VIEWS)
    step = _FAR_STEP_WAVELENGTHS * lam
    nearest, farthest = round(min(_BEYOND * reach, 0.9 * given) / step), round(reach / step)
    offsets = step * np.arange(-nearest, farthest + 1, dtype=np.float64)
    points = PointSearch(few, grid)
    tried = [points.explain(few.aperture.with_axis_distance(given + offset)) for offset in offsets]
    residuals = np.array([explained.left for explained in tried])
    best = int(np.argmin(residuals.sum(axis=1)))
    off, near = offsets[best], np.abs(offsets) <= 1.01 * _RIVAL_WAVELENGTHS * lam
    if near[best] or residuals.shape[1] < 3:
        return None
    needed = needed_evidence(residuals.shape[1])
    shown = t_value(residuals[near] - residuals[best]).min() >= needed
    if off < 0:
        shown = off >= -reach and tried[best].second >= LEAST_SECOND
        shown = shown and _least_t(offsets, residuals, best, _RIVAL_WAVELENGTHS * lam) >= needed
    return given + _lowest(offsets, residuals.sum(axis=1)) if shown else None


def _is_turn(angles: Floats) -> bool:
    """Whether the directions of view (views,), rad, leave no gap."""
    directions = np.unique(np.round(angles % (2 * np.pi), 6))
    gaps = np.diff(directions, append=directions[0] + 2 * np.pi)
    return bool(gaps.max() - np.median(gaps) <= _MOST_GAP)


def _judged(
    focus: AxisFocus, few: BasebandScans, grid: ImageGrid, given: float, search_m: float, bright: float
) -> AxisFocus:
    """With the offset that leaves the least energy, and whether to believe it."""
    lam = few.wavelength_m
    wide = min(_BEYOND * search_m, 0.9 * given)
    steps = max(4, round(wide / (_ENERGY_STEP_WAVELENGTHS * lam)))
    offsets = np.linspace(-wide, wide, 2 * steps + 1)
    points = PointSearch(few, grid)
    tried = [points.explain(few.aperture.with_axis_distance(given + o)) for o in offsets]
    residuals = np.array([t.left for t in tried])
    total = residuals.sum(axis=1)
    best = int(np.argmin(total))
    offset = lowest = _lowest(offsets, total)
    if abs(bright - offset) <= _AGREE_WAVELENGTHS * lam:
        offset = bright
    sectors_m = _jackknife(offsets, residuals)
    there = few.with_aperture(few.aperture.with_axis_distance(given + offset))
    band_m = band_delays(there, points.explain(there.aperture)).error_m
    sigma_m = float(np.hypot(sectors_m, band_m))
    evidence = _least_t(offsets, residuals, best, _RIVAL_WAVELENGTHS * lam)
    needed = needed_evidence(residuals.shape[1])
    reason = ""
    if not (0 < best < len(offsets) - 1 and max(abs(offset), abs(lowest)) < search_m):
        reason = BEYOND_SEARCH
    elif tried[best].second < LEAST_SECOND and offset < 0:
        reason = "one spot dominates, which a round body at the given distance would explain as well"
    elif not evidence >= needed:
        reason = "the sectors of the turn do not agree on one distance"
    elif not sigma_m <= MOST_SIGMA_WAVELENGTHS * lam:
        reason = f"its standard error is {sigma_m * 1e3:.1f} mm"
        if band_m > sectors_m:
            reason = "the parts of the band do not agree on one distance"
    taken = 0.0 if reason else offset
    return replace(
        focus,
        axis_distance_m=given + taken,
        offset_m=taken,
        reliable=not reason,
        best_m=given + offset,
        sigma_m=float(np.hypot(sigma_m, BIAS_WAVELENGTHS * lam)),
        evidence=evidence,
        needed=needed,
        second=tried[best].second,
        unexplained=float(total[best]),
        reason=reason,
    )


def _least_t(offsets: Floats, residuals: Floats, best: int, rival_m: float) -> float:
    """Least t of the paired differences (groups,) between every rival and the best; 0 without a rival."""
    rivals = np.flatnonzero(np.abs(offsets - offsets[best]) >= rival_m * 0.999)
    if residuals.shape[1] < 3 or not len(rivals):
        return 0.0
    return float(t_value(residuals[rivals] - residuals[best]).min())


def _jackknife(offsets: Floats, residuals: Floats) -> float:
    """Standard error of the lowest point over the groups, in units of the offsets."""
    total = residuals.sum(axis=1)
    return jackknife_error([_lowest(offsets, total - group) for group in residuals.T])


def _lowest(offsets: Floats, total: Floats) -> float:
    """Place of the minimum by a parabola through it and its neighbours."""
    best = int(np.argmin(total))
    if not 0 < best < len(total) - 1:
        return float(offsets[best])
    shift = vertex(*(float(v) for v in total[best - 1 : best + 2]))
    return float(offsets[best] + shift * (offsets[1] - offsets[0]))


def _peak_db(scans: BasebandScans, image: NDArray[np.complex64]) -> float:
    if scans.noise_std <= 0:
        return float("inf")
    noise = scans.noise_std**2 / scans.aperture.views
    return float(10 * np.log10(np.abs(image).max() ** 2 / noise))
