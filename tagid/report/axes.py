"""A frame with ticks and units, for curves and rasters in physical coordinates.

One class serves the image, the range profile, the sinogram and the spectrum, so that all have the same style.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.report.canvas import Canvas, Point
from tagid.report.colours import BAND, GRID, INK, RGB, colourise

TICK_SIZE = 20
LABEL_SIZE = 22


def nice_ticks(low: float, high: float, count: int = 6) -> list[float]:
    """Round numbers (1, 2 or 5 times a power of ten apart) within [low, high], `count` or somewhat fewer.

    >>> nice_ticks(-0.25, 0.25)
    [-0.2, -0.1, 0.0, 0.1, 0.2]
    """
    span = high - low
    if not (math.isfinite(span) and span > 0):
        return [low]
    power = 10.0 ** math.floor(math.log10(span / count))
    step = next(power * m for m in (1, 2, 5, 10) if power * m * count >= span * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    digits = max(0, 1 - math.floor(math.log10(step)))
    return [round(i * step, digits) + 0.0 for i in range(first, last + 1)]


def tick_labels(ticks: list[float]) -> list[str]:
    """Labels with as many decimals as the spacing of the ticks needs.

    >>> tick_labels([-0.2, 0.0, 0.2])
    ['-0.2', '0.0', '0.2']
    """
    if len(ticks) == 1:
        return [f"{ticks[0]:.12g}"]
    step = min((b - a for a, b in itertools.pairwise(ticks)), default=1.0)
    if step <= 0 or max(abs(t) for t in ticks) >= 1e6:
        return [f"{t:g}" for t in ticks]
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    return [f"{t:.{decimals}f}" for t in ticks]


@dataclass(frozen=True)
class Axes:
    """A frame on a canvas.

    Attributes:
        box: (left, top, right, bottom) of the frame, px.
        x, y: its (left, right) and (bottom, top) limits in physical units.
    """

    canvas: Canvas
    box: tuple[float, float, float, float]
    x: tuple[float, float]
    y: tuple[float, float]

    def place(self, x: float, y: float) -> Point:
        """The px of a physical point."""
        left, top, right, bottom = self.box
        return (
            left + (x - self.x[0]) / (self.x[1] - self.x[0]) * (right - left),
            bottom + (y - self.y[0]) / (self.y[1] - self.y[0]) * (top - bottom),
        )

    def grid(self) -> None:
        """Faint lines at the ticks; drawn before the curves."""
        left, top, right, bottom = self.box
        for tick in nice_ticks(min(self.x), max(self.x)):
            px = self.place(tick, self.y[0])[0]
            self.canvas.line([(px, top), (px, bottom)], GRID, 1)
        for tick in nice_ticks(min(self.y), max(self.y), self._rows):
            px = self.place(self.x[0], tick)[1]
            self.canvas.line([(left, px), (right, px)], GRID, 1)

    def frame(self, x_label: str, y_label: str, title: str = "") -> None:
        """Frame, ticks, numbers and labels; drawn after the contents, which it clips."""
        left, top, right, bottom = self.box
        canvas = self.canvas
        canvas.line([(left, top), (right, top), (right, bottom), (left, bottom), (left, top)], INK, 1.5)
        ticks = nice_ticks(min(self.x), max(self.x))
        for tick, label in zip(ticks, tick_labels(ticks), strict=True):
            px = self.place(tick, self.y[0])[0]
            canvas.line([(px, bottom), (px, bottom + 7)])
            canvas.text((px, bottom + 11), label, TICK_SIZE, anchor="ma")
        ticks = nice_ticks(min(self.y), max(self.y), self._rows)
        widest = 0.0
        for tick, label in zip(ticks, tick_labels(ticks), strict=True):
            px = self.place(self.x[0], tick)[1]
            canvas.line([(left - 7, px), (left, px)])
            canvas.text((left - 11, px), label, TICK_SIZE, anchor="rm")
            widest = max(widest, canvas.text_width(label, TICK_SIZE))
        canvas.text(((left + right) / 2, bottom + 38), x_label, LABEL_SIZE, anchor="ma")
        canvas.text_upwards((left - 11 - widest - 22, (top + bottom) / 2), y_label, LABEL_SIZE)
        if title:
            canvas.text((left, top - 12), title, LABEL_SIZE, anchor="ls")

    @property
    def _rows(self) -> int:
        return max(3, min(8, int((self.box[3] - self.box[1]) / 45)))

    def curve(self, x: NDArray[np.floating], y: NDArray[np.floating], colour: RGB, width: float = 2) -> None:
        """A line through (n,) points, values outside the limits drawn at the edge."""
        inside = (x >= min(self.x)) & (x <= max(self.x))
        clipped = np.clip(y, min(self.y), max(self.y))
        points = [self.place(float(a), float(b)) for a, b in zip(x[inside], clipped[inside], strict=True)]
        if len(points) > 1:
            self.canvas.line(points, colour, width)

    def band(self, low: float, high: float) -> None:
        """Shades the part of the frame between two x values."""
        low, high = max(low, min(self.x)), min(high, max(self.x))
        if high > low:
            left, right = self.place(low, self.y[0])[0], self.place(high, self.y[0])[0]
            self.canvas.rectangle((left, self.box[1], right, self.box[3]), BAND)


def colour_bar(canvas: Canvas, box: tuple[float, float, float, float], dynamic_range_db: float) -> None:
    """A bar from -dynamic_range_db to 0 dB with ticks on its right, within (left, top, right, bottom) px."""
    left, top, right, bottom = box
    axes = Axes(canvas, box, (0, 1), (-dynamic_range_db, 0))
    ramp = np.linspace(0, -dynamic_range_db, 256)[:, None]
    canvas.raster(box, colourise(ramp, dynamic_range_db))
    canvas.line([(left, top), (right, top), (right, bottom), (left, bottom), (left, top)], INK, 1.5)
    ticks = nice_ticks(-dynamic_range_db, 0, 8)
    for tick, text in zip(ticks, tick_labels(ticks), strict=True):
        px = axes.place(0, tick)[1]
        canvas.line([(right, px), (right + 7, px)])
        canvas.text((right + 11, px), text, TICK_SIZE, anchor="lm")
    canvas.text((left, top - 12), "dB", LABEL_SIZE, anchor="ls")
