"""Where to look in scans from free antenna positions: path delay, middle and side of the image.

A turntable's image lies about its axis; a radar on a rail or in the hand has no such point, so delay and
region come from the strongest echoes, or from the user.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tagid.capture import Capture
from tagid.geometry import ImageGrid
from tagid.imaging.preprocess import Background, PreprocessSettings, preprocess
from tagid.imaging.rangefocus import DelayFocus, focus_delay, is_straight

COARSEST_PIXEL_M = 0.018
"""Under a quarter of the P440's wavelength: a coarser pixel may fall between the ripples of a point."""

_MARGIN_M = 0.4
_MAX_PIXELS = 360


@dataclass(frozen=True, eq=False)
class Region:
    """What is to be imaged, and the capture as seen from there.

    Attributes:
        capture: positions relative to `centre_m`, the path delay taken off the ranges.
        grid: the square about `centre_m`.
        centre_m: (x, y) in the frame of the original positions, m.
        focus: result of the delay search; None where there was none.
        mirrored: the path is straight, so that what lies on one side shows on the other, too.
    """

    capture: Capture
    grid: ImageGrid
    centre_m: tuple[float, float]
    focus: DelayFocus | None
    mirrored: bool


def choose_region(
    capture: Capture,
    grid: ImageGrid,
    centre_m: tuple[float, float] | None,
    search_m: float = 1.0,
    background: Background = "mean",
    free: tuple[bool, bool] = (False, False),
) -> Region:
    """Delay and region of a capture of free antenna positions.

    Args:
        capture: scans with antenna_positions_m.
        grid: size wanted.
        centre_m: (x, y) of the image's middle, m; None is the origin where the strongest echo lies in the
            grid about it, and else the middle of all strong echoes.
        search_m: half width of the delay search, one-way m; 0 takes the ranges as given.
        background: as in `PreprocessSettings`.
        free: whether extent and pixels may be changed to hold the echoes and to resolve their ripples.

    Raises:
        DataError: as `preprocess`. UsageError: the search is too wide.
    """
    positions = capture.antenna_positions_m
    assert positions is not None
    towards = centre_m or (0.0, 0.0)
    focus: DelayFocus | None = None
    if search_m > 0:
        # Everything within the range window, as the delay is not known yet.
        middle = np.array([*positions.mean(axis=0)[:2], 0.0])
        reach = float(capture.ranges_m[-1]) + search_m
        wide = PreprocessSettings(background, True, extent_m=min(100.0, 2 * reach), margin_m=search_m + 0.1)
        scans = preprocess(replace(capture, antenna_positions_m=positions - middle), settings=wide)
        there = (towards[0] - float(middle[0]), towards[1] - float(middle[1]))
        _, focus = focus_delay(scans, search_m, there)
        points = tuple(
            replace(p, x_m=p.x_m + float(middle[0]), y_m=p.y_m + float(middle[1])) for p in focus.points
        )
        focus = replace(focus, points=points)
        if focus.reliable:
            capture = replace(capture, range_start_m=capture.range_start_m - focus.delay_m)
    extent = grid.extent
    if centre_m is None:
        centre_m, extent = _about_echoes(focus, grid.extent, free[0])
    pixels = grid.pixels
    if free[1]:
        pixels = int(np.clip(np.ceil(extent / COARSEST_PIXEL_M), pixels, max(pixels, _MAX_PIXELS)))
    grid = ImageGrid(extent, pixels)
    shift = np.array([*centre_m, 0.0])
    seen = replace(capture, antenna_positions_m=positions - shift)
    return Region(seen, grid, centre_m, focus, is_straight(positions))


def _about_echoes(focus: DelayFocus | None, extent: float, free: bool) -> tuple[tuple[float, float], float]:
    """Middle and side of a square with the strong echoes; the one about the origin where it has the first."""
    points = focus.points if focus is not None else ()
    if not points or max(abs(points[0].x_m), abs(points[0].y_m)) < extent / 2:
        return (0.0, 0.0), extent
    x, y = [p.x_m for p in points], [p.y_m for p in points]
    centre = (round((max(x) + min(x)) / 2, 2), round((max(y) + min(y)) / 2, 2))
    wide = max(max(x) - min(x), max(y) - min(y)) + 2 * _MARGIN_M
    return centre, round(min(wide, 100.0), 2) if free else extent
