"""The distance from the radar to the rotation axis, found from the sharpness of the image.

No tape measure reaches the phase centre of an antenna, so the distance must come from the data. A wrong one
shifts every echo in range by the same amount: the image loses brightness, at a centimetre its points spread.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.backprojection import backproject
from tagid.imaging.preprocess import select_views
from tagid.imaging.types import BasebandScans

STEP_M = 0.005
"""Step of the search. The peak is as wide as the range envelope (some 5 cm): in the far field a range offset
turns only the phase of the image, so nothing narrower is to be seen and a parabola interpolates it."""

MIN_PEAK_DB = 13.0
"""Image peak over its mean noise power below which nothing is focused; noise alone reached 12.1 dB in 80
trials of 12 to 360 views."""

_PIXEL_M = 0.007
_MAX_PIXELS = 160
_VIEWS = 90
_HALF_WINDOW = 2


@dataclass(frozen=True)
class AxisFocus:
    """What the search for the axis distance found.

    Attributes:
        axis_distance_m: distance that the returned scans assume, m; None for free antenna positions.
        offset_m: its difference from the one given, m; 0 where nothing was changed.
        sharpness: sum |f|^4 / (sum |f|^2)^2 of the image there.
        contrast: largest focus measure (see `focus_axis_distance`) over the median of the search, >= 1.
        peak_db: power of the brightest pixel over the mean noise power of a pixel, dB; inf without noise.
        reliable: a target above the noise, and the best distance inside the search; only then is it taken.
    """

    axis_distance_m: float | None
    offset_m: float = 0.0
    sharpness: float = 0.0
    contrast: float = 1.0
    peak_db: float = 0.0
    reliable: bool = False


def sharpness(values: NDArray[np.complexfloating]) -> float:
    """sum |f|^4 / (sum |f|^2)^2 of a complex image of any shape; 0 for a blank one."""
    power = np.square(values.real, dtype=np.float64) + np.square(values.imag, dtype=np.float64)
    total = float(power.sum())
    return float((power**2).sum()) / total**2 if total > 0 else 0.0


def focus_axis_distance(
    scans: BasebandScans, grid: ImageGrid, search_m: float = 0.03
) -> tuple[BasebandScans, AxisFocus]:
    """The same scans under the axis distance that makes the brightest points.

    The measure is sqrt(sum |f|^8) of the backprojection, searched in 5 mm steps with a parabola about the
    best. Of 3 points at 10 dB SNR a sample it has an rms error of 1 mm at 36 views, 0.6 mm at 360. The usual
    sum |f|^4 / (sum |f|^2)^2 is worse (2 mm at 360 views): its denominator, which collects the sidelobes,
    depends on the distance too.

    Args:
        scans: scans of a turntable; those of free antenna positions come back unchanged.
        grid: the square of interest; the search uses its extent with its own pixels.
        search_m: half width of the search, m; at most 0.1.

    Raises:
        UsageError: search_m is not between 0 and 0.1 m.
    """
    if not 0 < search_m <= 0.1:
        raise UsageError(f"the axis search is +-{search_m} m", "Give a half width of up to 0.1 m.")
    distance = scans.aperture.axis_distance
    if scans.aperture.angles is None or distance is None:
        return scans, AxisFocus(None)
    pixels = int(np.clip(np.ceil(grid.extent / _PIXEL_M), 2, _MAX_PIXELS))
    search = ImageGrid(grid.extent, pixels)
    few = select_views(scans, slice(None, None, max(1, scans.aperture.views // _VIEWS)))
    offsets = np.linspace(-search_m, search_m, 2 * max(2, int(np.ceil(search_m / STEP_M))) + 1)
    if distance <= search_m:
        return scans, AxisFocus(distance)
    images = [_image_at(few, search, distance + float(offset)) for offset in offsets]
    measure = np.array([float(np.sqrt(((np.abs(f).astype(np.float64)) ** 8).sum())) for f in images])
    best = int(np.argmax(measure))
    if measure[best] == 0:
        return scans, AxisFocus(distance)
    contrast = float(measure[best] / np.median(measure))
    peak_db = _peak_db(few, images[best])
    if not 0 < best < len(offsets) - 1 or peak_db < MIN_PEAK_DB:
        return scans, AxisFocus(distance, 0.0, sharpness(images[best]), contrast, peak_db, False)
    offset = _vertex(offsets, measure, best)
    focused = scans.with_aperture(scans.aperture.with_axis_distance(distance + offset))
    return focused, AxisFocus(distance + offset, offset, sharpness(images[best]), contrast, peak_db, True)


def _image_at(scans: BasebandScans, grid: ImageGrid, distance: float) -> NDArray[np.complex64]:
    aperture = scans.aperture.with_axis_distance(distance)
    return backproject(scans.with_aperture(aperture), grid).values


def _peak_db(scans: BasebandScans, image: NDArray[np.complex64]) -> float:
    if scans.noise_std <= 0:
        return float("inf")
    noise = scans.noise_std**2 / scans.aperture.views
    return float(10 * np.log10(np.abs(image).max() ** 2 / noise))


def _vertex(at: NDArray[np.float64], values: NDArray[np.float64], best: int) -> float:
    """Vertex of the parabola through the best value and two neighbours a side (least squares)."""
    middle = int(np.clip(best, _HALF_WINDOW, len(at) - 1 - _HALF_WINDOW))
    part = slice(middle - _HALF_WINDOW, middle + _HALF_WINDOW + 1)
    bend, slope, _ = np.polyfit(at[part] - at[middle], values[part], 2)
    if bend >= 0:
        return float(at[best])
    return float(np.clip(at[middle] - slope / (2 * bend), at[part][0], at[part][-1]))
