"""The lengths of imaging, each from the wavelength, so that a scene scaled with it gives the same image.

Values in metres are those of a P440 (75.9 mm).
"""

from __future__ import annotations

import math

SEARCH_WAVELENGTHS = 0.527
"""Half width of the search for the axis distance: half a wavelength and two fifths of a step, so that an
error of half a wavelength is not at the edge, where nothing is trusted. 40 mm."""

MOST_PIXELS = 1024
"""Per side of an image."""

_SHOWN_PIXEL_WAVELENGTHS = 0.26
"""Coarser pixels are warned of: a quarter and what rounding adds."""


def views_needed(extent_m: float, wavelength_m: float) -> int:
    """Views per turn that an image of some width needs at a wavelength, m; denser scans can be averaged into
    as many.

    Between neighbours an echo at half the image's width then moves by 0.0575 wavelengths at most, 4.4 mm: one
    degree, the paper's step, for a P440 and an image of 0.5 m. Its phase turns by 0.72 rad, so that averaging
    the scans in between costs 2 % of it. 360 views are never reduced.
    """
    return max(360, round(math.pi * extent_m / (0.0575 * wavelength_m)))


def search_range_m(wavelength_m: float) -> float:
    """Half width of the search for the axis distance, m."""
    return SEARCH_WAVELENGTHS * wavelength_m


def finest_cell_m(wavelength_m: float) -> float:
    """Edge of the finest cell of the encoding, and pixel of images of which nothing else is said, m: 7.3 mm.

    The finest ripple of an image is that of 2k (half a wavelength); across a cell its phase is 2k h = 1.21
    rad, so that linear interpolation keeps at least cos(0.605) = 82 % of it.
    """
    return 0.0963 * wavelength_m


def coarsest_pixel_m(wavelength_m: float) -> float:
    """Pixel above which a point may fall between its own ripples, m: a quarter of the wavelength, 18 mm."""
    return 0.2372 * wavelength_m


def pixel_warning(extent_m: float, pixels: int, wavelength_m: float) -> str | None:
    """A warning where points may fall between the pixels of an image of some width, m, and pixels a side."""
    step = extent_m / pixels
    if step <= _SHOWN_PIXEL_WAVELENGTHS * wavelength_m:
        return None
    most = coarsest_pixel_m(wavelength_m)
    needed = math.ceil(extent_m / most)
    more = f"`imaging.pixels={needed}` or " if needed <= MOST_PIXELS else ""
    return (
        f"pixels of {step * 1e3:.3g} mm are coarser than a quarter of the wavelength, "
        f"{wavelength_m / 4e-3:.3g} mm: points between them are lost; "
        f"give {more}an `imaging.extent_m` of up to {pixels * most:.2g} m"
    )
