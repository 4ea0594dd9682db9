"""Figures of the imaging benchmarks."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tagid.report.axes import Axes, colour_bar
from tagid.report.canvas import Canvas
from tagid.report.colours import BLUE, GREEN, INK, ORANGE, colourise, to_decibels

DYNAMIC_RANGE_DB = 30.0
_COLOURS = ((140, 140, 150), BLUE, (110, 60, 160), GREEN, (170, 140, 30), ORANGE, (200, 30, 60), INK)


def picture_grid(
    pictures: Sequence[Sequence[np.ndarray]],
    extents_m: Sequence[float],
    rows: Sequence[str],
    columns: Sequence[str],
    path: Path,
) -> None:
    """Magnitudes in dB below each one's maximum: rows of scenes, columns of methods."""
    side, gap, remaining, top = 150, 22, 118, 56
    width = remaining + len(columns) * (side + gap) + 90
    canvas = Canvas(width, top + len(rows) * (side + 46) + 10)
    for j, name in enumerate(columns):
        canvas.text((remaining + j * (side + gap) + side / 2, 30), name, 17, anchor="mm")
    for i, (line, extent) in enumerate(zip(pictures, extents_m, strict=True)):
        y = top + i * (side + 46)
        for j, values in enumerate(line):
            x = remaining + j * (side + gap)
            decibels = to_decibels(np.abs(values), DYNAMIC_RANGE_DB)[::-1]
            canvas.raster((x, y, x + side, y + side), colourise(decibels, DYNAMIC_RANGE_DB))
            canvas.line([(x, y), (x + side, y), (x + side, y + side), (x, y + side), (x, y)], INK, 1)
        for k, word in enumerate(textwrap.wrap(rows[i], 12, break_long_words=False, break_on_hyphens=False)):
            canvas.text((8, y + 14 + 20 * k), word, 16)
        canvas.text((remaining, y + side + 6), f"{extent:g} m", 15)
    x = remaining + len(columns) * (side + gap)
    colour_bar(canvas, (x, top, x + 16, top + side), DYNAMIC_RANGE_DB)
    canvas.save(path)


def curves(
    x: Sequence[float],
    lines: dict[str, Sequence[float]],
    labels: tuple[str, str],
    path: Path,
    title: str = "",
) -> None:
    """Lines with a legend over common x values."""
    known = np.array([v for line in lines.values() for v in line if np.isfinite(v)])
    pad = 0.05 * float(np.ptp(known)) or 1.0
    canvas = Canvas(820, 480)
    limits = (float(known.min()) - pad, float(known.max()) + pad)
    axes = Axes(canvas, (100, 50, 590, 400), (float(min(x)), float(max(x))), limits)
    axes.grid()
    for i, (name, line) in enumerate(lines.items()):
        colour = _COLOURS[i % len(_COLOURS)]
        axes.curve(np.asarray(x, dtype=float), np.asarray(line, dtype=float), colour, 2.5)
        canvas.line([(610, 70 + 28 * i), (640, 70 + 28 * i)], colour, 3)
        canvas.text((648, 70 + 28 * i), name, 17, anchor="lm")
    axes.frame(*labels, title)
    canvas.save(path)
