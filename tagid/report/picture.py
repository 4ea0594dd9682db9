"""The reconstructed image as a picture: dB, metres, and the detected reflectors.

Large letters on white, readable in sunlight and in printed reports.
"""

from __future__ import annotations

import io
from collections.abc import Sequence, Set
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tagid.errors import DataError, UsageError
from tagid.report.axes import Axes, colour_bar
from tagid.report.canvas import Canvas, Point
from tagid.report.colours import INK, RGB, WHITE, colourise, to_decibels

_UNMATCHED: RGB = (255, 140, 110)
_WIDTH, _HEIGHT = 940, 900
_SIDE = 700
_LEFT, _TOP = 110, 100
_SMALL = 0.5
_THUMBNAIL_COLOURS = 32
_MEANING = {True: "reflector of the layout", False: "other echo"}


class Marker(NamedTuple):
    """A reflector to mark: position in m, a short label, and whether it belongs to the layout."""

    x: float
    y: float
    label: str = ""
    matched: bool = True


def draw_image(
    values: NDArray[np.inexact],
    extent_m: float,
    path: Path,
    title: str = "",
    reflectors: Sequence[Marker] = (),
    dynamic_range_db: float = 30.0,
    centre_m: tuple[float, float] = (0.0, 0.0),
    outline: Sequence[tuple[float, float]] = (),
) -> None:
    """Writes a PNG of a reflectivity image, 940 x 900 px.

    Args:
        values: (y, x) complex or real reflectivity; row 0 is the lowest y, which is drawn at the bottom.
        extent_m: side of the image along x, m; the pixels are square.
        path: the PNG; written atomically.
        title: one line above the image, truncated if too long.
        reflectors: markers, drawn as a circle if matched, otherwise as a cross. Those outside the image are
            omitted.
        dynamic_range_db: pixels further below the brightest one have the darkest colour.
        centre_m: (x, y) of the image centre, m; the rotation axis is the origin.
        outline: corners (x, y) of the body, m; drawn where they are inside the image.

    Raises:
        DataError: the image is empty, not two-dimensional or not finite.
        UsageError: the extent or the dynamic range is not positive.
        StorageError, DiskFullError: the file cannot be written.
    """
    magnitude = checked_magnitude(values, extent_m, dynamic_range_db)
    decibels = to_decibels(magnitude, dynamic_range_db)[::-1]
    rows, columns = magnitude.shape
    scale = _SIDE / max(rows, columns)
    box = (_LEFT, _TOP, _LEFT + columns * scale, _TOP + rows * scale)
    half_x, half_y = extent_m / 2, extent_m / 2 * rows / columns
    canvas = Canvas(_WIDTH, _HEIGHT)
    x, y = centre_m
    axes = Axes(canvas, box, (x - half_x, x + half_x), (y - half_y, y + half_y))
    # Smoothing is cosmetic; large pixels are drawn as squares.
    canvas.raster(box, colourise(decibels, dynamic_range_db), smooth=scale < 12)
    marked = [marker for marker in (Marker(*given) for given in reflectors) if _is_inside(axes, marker)]
    bounded = len(outline) > 2 and all(_is_inside(axes, Marker(*corner)) for corner in outline)
    if bounded:
        corners = [axes.place(*corner) for corner in (*outline, outline[0])]
        canvas.line(corners, INK, 4.0)
        canvas.line(corners, WHITE, 2.0)
    for marker in marked:
        _mark(axes, marker)
    axes.frame("x (m)", "y (m)")
    colour_bar(canvas, (_LEFT + _SIDE + 24, _TOP, _LEFT + _SIDE + 50, box[3]), dynamic_range_db)
    canvas.text((_LEFT, 36), fit_text(canvas, title, _WIDTH - _LEFT - 30, 28), 28)
    _legend(canvas, {marker.matched for marker in marked}, bounded)
    canvas.save(Path(path))


def thumbnail(png: bytes, side: int = 96) -> bytes:
    """The image of a picture of `draw_image` without axes and letters, a PNG of at most `side` px per side.

    Raises DataError if this is no such picture.
    """
    try:
        with Image.open(io.BytesIO(png), formats=("PNG",)) as picture:
            if picture.size != (_WIDTH, _HEIGHT):
                raise DataError(f"a picture of {picture.size} px is none of tagid")
            raster = picture.convert("RGB").crop((_LEFT, _TOP, _LEFT + _SIDE, _TOP + _SIDE))
            raster.thumbnail((side, side))
            buffer = io.BytesIO()
            raster.quantize(_THUMBNAIL_COLOURS).save(buffer, format="PNG", optimize=True)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise DataError(f"the picture cannot be read: {error}", "Scan the object again.") from None
    return buffer.getvalue()


def checked_magnitude(
    values: NDArray[np.inexact], extent_m: float, dynamic_range_db: float
) -> NDArray[np.float64]:
    """|values| as (y, x) float64; raises DataError or UsageError if it cannot be drawn."""
    if values.ndim != 2 or values.size == 0:
        raise DataError(f"the image has shape {values.shape}, expected (y, x)")
    magnitude: NDArray[np.float64] = np.abs(values).astype(np.float64)
    if not np.isfinite(magnitude).all():
        raise DataError(
            "the image contains values that are not finite", "Reconstruct it again from the capture."
        )
    if not (np.isfinite(extent_m) and extent_m > 0):
        raise UsageError(f"image extent is {extent_m} m", "Give a positive number of metres.")
    if not (np.isfinite(dynamic_range_db) and dynamic_range_db > 0):
        raise UsageError(f"dynamic range is {dynamic_range_db} dB", "Give a positive number of decibels.")
    return magnitude


def fit_text(canvas: Canvas, text: str, width: float, size: int) -> str:
    """The text on one line, truncated with an ellipsis if wider than `width` px."""
    line = " ".join(text.split())[:400]
    if canvas.text_width(line, size) <= width:
        return line
    while line and canvas.text_width(line + "…", size) > width:
        line = line[:-1]
    return line.rstrip() + "…"


def _legend(canvas: Canvas, kinds: Set[bool], bounded: bool) -> None:
    """What the marks that are drawn mean, between the title and the image."""
    x, y = _LEFT + 9.0, _TOP - 18.0
    for matched, meaning in _MEANING.items():
        if matched in kinds:
            _symbol(canvas, (x, y), matched, INK, 2.0, _SMALL)
            canvas.text((x + 18, y), meaning, 20, anchor="lm")
            x += 48 + canvas.text_width(meaning, 20)
    if bounded:
        canvas.line([(x - 9, y), (x + 9, y)], INK, 2.0)
        canvas.text((x + 18, y), "body", 20, anchor="lm")


def _symbol(canvas: Canvas, at: Point, matched: bool, colour: RGB, width: float, scale: float = 1.0) -> None:
    """A circle, or a cross, of one colour."""
    x, y = at
    if matched:
        canvas.circle(at, 17 * scale, colour, width)
        return
    arm = 12 * scale
    canvas.line([(x - arm, y - arm), (x + arm, y + arm)], colour, width)
    canvas.line([(x - arm, y + arm), (x + arm, y - arm)], colour, width)


def _is_inside(axes: Axes, marker: Marker) -> bool:
    return axes.x[0] <= marker.x <= axes.x[1] and axes.y[0] <= marker.y <= axes.y[1]


def _mark(axes: Axes, marker: Marker) -> None:
    x, y = axes.place(marker.x, marker.y)
    colour = WHITE if marker.matched else _UNMATCHED
    # A dark rim, so that marks show on bright pixels, too.
    _symbol(axes.canvas, (x, y), marker.matched, INK, 6.0, 1.08)
    _symbol(axes.canvas, (x, y), marker.matched, colour, 3.0)
    # Near the right edge the label goes to the other side.
    room = axes.canvas.text_width(marker.label, 22) + 26
    right = x + room < axes.box[2]
    axes.canvas.text(
        (x + 25 if right else x - 25, y), marker.label, 22, colour, "lm" if right else "rm", halo=INK
    )
