"""Axis distances far from the stated one at which the image is bright: candidates for an error."""

from __future__ import annotations

import numpy as np

from tagid.capture import Capture
from tagid.errors import DataError
from tagid.geometry import ImageGrid
from tagid.imaging.backprojection import backproject
from tagid.imaging.preprocess import Background, PreprocessSettings, preprocess

AXIS_SEARCH_M = 0.2
"""Half-width of the search for a wrong axis distance, m: misread tape, or antenna mount not included."""
_STEP_M = 5e-3
_NEAR_M = 0.02
"""Errors that the reader corrects are not candidates."""
_TRIES = 3
_VIEWS = 90
_GRID = ImageGrid(0.5, 72)
"""Covers the largest built-in layout off the axis, with the pixel size of the axis-distance search."""


def bright_offsets(capture: Capture, background: Background = "mean") -> list[float]:
    """Offsets of the axis distance, m, with the brightest image, outside the reader's own search range.

    The capture is of one turn, with angles and axis distance. The measure is sum |f|^8 of the backprojection,
    as in `tagid.imaging.autofocus`.
    """
    wide = PreprocessSettings(background, matched_filter=True, extent_m=_GRID.extent, margin_m=AXIS_SEARCH_M)
    every = max(1, capture.views // _VIEWS)
    try:
        scans = preprocess(capture.select(slice(None, None, every)), settings=wide)
    except DataError:
        return []
    given = float(capture.axis_distance_m or 0.0)
    steps = round(AXIS_SEARCH_M / _STEP_M)
    offsets = np.linspace(-AXIS_SEARCH_M, AXIS_SEARCH_M, 2 * steps + 1)
    offsets = offsets[given + offsets > _GRID.extent / 2]
    images = (
        backproject(scans.with_aperture(scans.aperture.with_axis_distance(given + offset)), _GRID).values
        for offset in offsets
    )
    bright = np.array([(np.abs(image).astype(np.float64) ** 8).sum() for image in images])
    peaks = [i for i in range(1, len(bright) - 1) if bright[i] >= max(bright[i - 1], bright[i + 1])]
    peaks = [i for i in peaks if abs(offsets[i]) > _NEAR_M]
    return [float(offsets[i]) for i in sorted(peaks, key=lambda i: -bright[i])[:_TRIES]]
