"""Where to look in scans from free antenna positions: path delay, middle and side of the image.

A turntable's image lies about its axis; a radar on a rail or in the hand has no such point, so delay and
region come from the strongest echoes, or from the user.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from tagid.capture import Capture
from tagid.geometry import ImageGrid
from tagid.imaging.copies import are_copies
from tagid.imaging.lengths import coarsest_pixel_m
from tagid.imaging.pathside import is_straight
from tagid.imaging.preprocess import Background, PreprocessSettings, preprocess
from tagid.imaging.rangefocus import (
    DelayFocus,
    EchoPoint,
    find_echoes,
    focus_delay,
    search_range_m,
)

_MARGIN_RESOLUTIONS = 4.5
"""Range resolutions (c / 2B) about the strong echoes: 0.4 m for a P440."""
_CLEAR_RESOLUTIONS = 0.5
"""Range resolutions between an echo and the edge of an image that shows it."""
_MAX_PIXELS = 360


@dataclass(frozen=True, eq=False)
class Region:
    """What is to be imaged, and the capture as seen from there.

    Attributes:
        capture: positions relative to `centre_m`, the path delay subtracted from the ranges.
        grid: the square about `centre_m`.
        centre_m: (x, y) in the frame of the original positions, m.
        focus: result of the delay search; None if there was none.
        mirrored: what lies on one side of the path shows on the other, too: it is straight, or both sides
            explain the scans alike.
        points: the strong echoes, strongest first, in the frame of the original positions, without copies of
            stronger ones (`tagid.imaging.copies`).
    """

    capture: Capture
    grid: ImageGrid
    centre_m: tuple[float, float]
    focus: DelayFocus | None
    mirrored: bool
    points: tuple[EchoPoint, ...] = ()


def choose_region(
    capture: Capture,
    grid: ImageGrid,
    centre_m: tuple[float, float] | None,
    search_m: float | None = None,
    background: Background = "mean",
    towards_m: tuple[float, float] | None = None,
    *,
    free_extent: bool = False,
    free_pixels: bool = False,
) -> Region:
    """Delay and region of a capture of free antenna positions.

    Args:
        capture: scans with antenna_positions_m.
        grid: size wanted.
        centre_m: (x, y) of the image's middle, m; None is the origin where a grid about it shows all strong
            echoes, or, with an extent that may not be changed, the strongest; else the middle of them.
        search_m: half width of the delay search, one-way m; 0 takes the ranges as given, None: as wide as
            `rangefocus.search_range_m`.
        background: as in `PreprocessSettings`.
        towards_m: a point (x, y) on the side of a nearly straight path that is wanted, m; None: that of the
            image's centre, or the side that the scans tell, or the origin's where they do not.
        free_extent: whether the extent may be changed to hold the strong echoes.
        free_pixels: whether the pixels may be increased to resolve their ripples.

    Raises:
        DataError: as `preprocess`. UsageError: the search is too wide.
    """
    positions = capture.aperture().positions
    lam = capture.wavelength_m
    search_m = search_range_m(lam) if search_m is None else search_m
    towards = towards_m or centre_m or (0.0, 0.0)
    focus: DelayFocus | None = None
    points: tuple[EchoPoint, ...] = ()
    if search_m > 0 or centre_m is None:
        # Everything within the range window, as the delay is not known yet.
        middle = np.array([*positions.mean(axis=0)[:2], 0.0])
        reach = float(capture.ranges_m[-1]) + search_m
        wide = PreprocessSettings(background, True, extent_m=2 * reach, margin_m=search_m + 1.3 * lam)
        scans = preprocess(capture.shifted(middle), settings=wide)
        there = (towards[0] - float(middle[0]), towards[1] - float(middle[1]))
        if search_m > 0:
            compare = towards_m is None and centre_m is None
            _, focus = focus_delay(scans, search_m, there, compare=compare)
            points = focus.points
        else:
            points = find_echoes(scans, there)
        if points:
            spots = np.array([(p.x_m, p.y_m) for p in points])
            copies = are_copies(scans, spots, np.array([p.amplitude for p in points]))
            points = tuple(p for p, copy in zip(points, copies, strict=True) if not copy)
        points = tuple(replace(p, x_m=p.x_m + float(middle[0]), y_m=p.y_m + float(middle[1])) for p in points)
        if focus is not None:
            focus = replace(focus, points=points)
            if focus.reliable:
                capture = replace(capture, range_start_m=capture.range_start_m - focus.delay_m)
    extent = grid.extent
    if centre_m is None:
        resolution = capture.wave_speed_m_s / (2 * capture.bandwidth_hz)
        centre_m, extent = _about_echoes(points, grid.extent, free_extent, resolution)
    pixels = grid.pixels
    if free_pixels:
        pixels = int(np.clip(np.ceil(extent / coarsest_pixel_m(lam)), pixels, max(pixels, _MAX_PIXELS)))
    grid = ImageGrid(extent, pixels)
    shift = np.array([*centre_m, 0.0])
    alike = None if focus is None else focus.alike
    mirrored = is_straight(positions, lam) if alike is None else alike
    return Region(capture.shifted(shift), grid, centre_m, focus, mirrored, points)


def _about_echoes(
    points: tuple[EchoPoint, ...], extent: float, free: bool, resolution_m: float
) -> tuple[tuple[float, float], float]:
    """Middle and side of a square with the strong echoes.

    It is the one about the origin where that shows all of them, or, if its size is given, the strongest.
    """
    margin_m = _MARGIN_RESOLUTIONS * resolution_m
    wanted = points if free else points[:1]
    reach = max((max(abs(p.x_m), abs(p.y_m)) for p in wanted), default=0.0)
    if not points or reach < extent / 2 - _CLEAR_RESOLUTIONS * resolution_m:
        return (0.0, 0.0), extent
    if not free:
        # A square of given size about the middle of far echoes would show none of them.
        points = tuple(
            p for p in points if max(abs(p.x_m - points[0].x_m), abs(p.y_m - points[0].y_m)) < extent / 2
        )
    x, y = [p.x_m for p in points], [p.y_m for p in points]
    wide = max(max(x) - min(x), max(y) - min(y)) + 2 * margin_m
    # Short numbers, fine beside the margin whatever the wavelength.
    digits = max(0, 1 - math.floor(math.log10(margin_m)))
    centre = (round((max(x) + min(x)) / 2, digits), round((max(y) + min(y)) / 2, digits))
    return centre, round(wide, digits) if free else extent
