"""The small pictures of a report page: rasters without axes, a few kilobytes each.

Axes, scale bar and markers are drawn by the page itself, so that one raster serves all sizes.
"""

from __future__ import annotations

import io
import math
from functools import cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tagid.capture import Capture
from tagid.pipeline.answer import Identification
from tagid.pipeline.reconstruct import Reconstruction
from tagid.recording.curves import changing_envelope
from tagid.report.charts import resample_views
from tagid.report.colours import to_decibels, viridis
from tagid.report.records import Thumbnails
from tagid.tags.layouts.layout import Layout

IMAGE_SIDE = 96
"""Pixels of an image's side: 5 mm for the usual 0.5 m, a quarter of the method's resolution."""
SINOGRAM_ROWS, SINOGRAM_COLUMNS = 72, 128
IMAGE_DB, SINOGRAM_DB = 30.0, 30.0
_Value = TypeVar("_Value", bound=np.generic)
LEVELS = 32
"""Colours in a picture, about 1 dB apart: more would only enlarge files with noise."""


def draw_pictures(
    capture: Capture, result: Reconstruction, answer: Identification, layout: Layout | None
) -> Thumbnails:
    """Image and sinogram of a prepared, identified capture, and what the page draws around them.

    The drawing holds the imaging method; the image's width and centre, and the places of the named layout's
    reflectors, m; the dynamic range of both pictures' colours, dB; and the sinogram's number of views, first
    and last range, m, and angle, degrees (None without angles).
    """
    image = _png(to_decibels(_fitted(np.abs(result.image.values), IMAGE_SIDE), IMAGE_DB)[::-1], IMAGE_DB)
    sinogram = _png(_sinogram(capture), SINOGRAM_DB)
    reading = answer.reading
    placed: list[list[float]] = []
    if layout is not None and reading is not None:
        points = layout.placed(math.radians(reading.rotation_deg), np.array(reading.centre_m))
        placed = [[round(float(x), 5), round(float(y), 5)] for x, y in points]
    angles = capture.angles_rad
    ranges = capture.ranges_m
    drawing = {
        "method": result.method,
        "extent_m": result.image.grid.extent,
        "centre_m": [round(float(value), 5) for value in result.image.centre_m],
        "image_db": IMAGE_DB,
        "layout_m": placed,
        "range_m": [round(float(ranges[0]), 4), round(float(ranges[-1]), 4)],
        "angle_deg": None if angles is None else [round(math.degrees(float(angles[i])), 1) for i in (0, -1)],
        "views": capture.views,
        "sinogram_db": SINOGRAM_DB,
    }
    return Thumbnails(image, sinogram, drawing)


def smaller(png: bytes, side: int) -> bytes:
    """A picture of this module reduced to at most `side` px, in the same colours."""
    with Image.open(io.BytesIO(png)) as picture:
        return _encode(_fitted(np.asarray(picture), side))


def _fitted(values: NDArray[_Value], side: int) -> NDArray[_Value]:
    """At most so many pixels per side; the largest of each block, so that no point is lost."""
    step = -(-max(values.shape) // side)
    rows, columns = (n // step * step for n in values.shape)
    blocks = values[:rows, :columns].reshape(rows // step, step, columns // step, step)
    return np.asarray(blocks.max(axis=(1, 3)))


def _sinogram(capture: Capture) -> NDArray[np.float64]:
    """(rows, columns) dB of the part that changes between views, first view on top."""
    envelope = changing_envelope(capture)
    order = np.arange(capture.views, dtype=np.float64)
    if capture.angles_rad is not None and np.all(np.diff(capture.angles_rad) > 0):
        order = np.asarray(capture.angles_rad, dtype=np.float64)
    picture, _ = resample_views(envelope, order, min(SINOGRAM_ROWS, capture.views), SINOGRAM_COLUMNS)
    reference = float(np.percentile(envelope, 99.9)) or None
    return to_decibels(picture, SINOGRAM_DB, reference)


def _png(decibels: NDArray[np.float64], dynamic_range_db: float) -> bytes:
    levels = np.rint((decibels / dynamic_range_db + 1) * (LEVELS - 1))
    return _encode(np.clip(levels, 0, LEVELS - 1).astype(np.uint8))


@cache
def _palette() -> bytes:
    return viridis(LEVELS).tobytes()


def _encode(levels: NDArray[np.uint8]) -> bytes:
    picture = Image.fromarray(np.ascontiguousarray(levels))
    picture.putpalette(_palette())
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()
