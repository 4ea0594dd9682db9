"""Rasters drawn with characters in the terminal, for use over ssh without graphics.

Two pixels share a cell by a half block in colour; without colour, ten characters represent lightness. What is
redrawn many times per second has few colours, and equal neighbours share one escape sequence, because the
terminal may be behind a slow connection.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.segment import Segment
from rich.style import Style
from rich.text import Text

from tagid.errors import UsageError
from tagid.report.colours import colourise, to_decibels, viridis
from tagid.report.picture import checked_magnitude

_DEPTH_DB = 30.0
"""Pixels further below the brightest one are darkest."""
_RAMP = " .:-=+*#%@"
_LARGEST_WIDTH = 400
LEVELS: Final = 16
_COLOURS: Final = [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in viridis(LEVELS).tolist()]


def colour_wanted(console: Console) -> bool:
    """Whether a console shows coloured half blocks: it has colours, no NO_COLOR, and a UTF encoding."""
    return console.color_system is not None and not console.no_color and console.encoding.startswith("utf")


def preview(
    values: NDArray[np.inexact],
    extent_m: float,
    width: int = 60,
    *,
    colour: bool,
    centre_m: tuple[float, float] = (0.0, 0.0),
) -> Text:
    """A reflectivity image as text, +y up, with its extents.

    Args:
        values: (y, x) complex or real, row 0 the lowest y.
        extent_m: side of the image along x, m.
        width: columns of the terminal to use, labels included; character cells are assumed to be twice as
            high as wide.
        colour: half blocks in colour, or characters, see `colour_wanted`.
        centre_m: (x, y) of the image centre, m.

    Raises:
        DataError: the image is empty, not two-dimensional or not finite.
        UsageError: invalid extent or width.
    """
    magnitude = checked_magnitude(values, extent_m, _DEPTH_DB)
    if not 16 <= width <= _LARGEST_WIDTH:
        raise UsageError(f"preview width is {width}", f"Give 16 to {_LARGEST_WIDTH} columns.")
    half_x, half_y = extent_m / 2, extent_m / 2 * magnitude.shape[0] / magnitude.shape[1]
    x, y = centre_m
    labels = {0: f"{y + half_y:+.2f} m", -1: f"{y - half_y:+.2f} m"}
    margin = max(len(label) for label in labels.values()) + 1
    columns = width - margin
    cells = max(1, round(columns * magnitude.shape[0] / magnitude.shape[1] / 2))
    picture = (_half_blocks if colour else _characters)(magnitude[::-1], cells, columns)
    text = Text(no_wrap=True, overflow="crop")
    for row, line in enumerate(picture):
        label = labels[0] if row == 0 else labels[-1] if row == len(picture) - 1 else ""
        text.append(label.rjust(margin - 1) + " ").append_text(line).append("\n")
    left, right = f"{x - half_x:+.2f} m", f"{x + half_x:+.2f} m"
    text.append(" " * margin + left + f"{right:>{max(1, columns - len(left))}}\n")
    return text.append(" " * margin).append_text(_scale(colour))


def resample(magnitude: NDArray[np.float64], rows: int, columns: int) -> NDArray[np.float64]:
    """(rows, columns) of (y, x) values: each cell is its largest pixel, so that no reflector is lost."""
    for axis, size in ((0, rows), (1, columns)):
        old = magnitude.shape[axis]
        first = (np.arange(size) * old) // size
        last = np.maximum(-((-(np.arange(size) + 1) * old) // size), first + 1)
        parts = [magnitude.take(range(a, b), axis).max(axis) for a, b in zip(first, last, strict=True)]
        magnitude = np.stack(parts, axis)
    return magnitude


def _half_blocks(magnitude: NDArray[np.float64], cells: int, columns: int) -> list[Text]:
    decibels = to_decibels(resample(magnitude, 2 * cells, columns), _DEPTH_DB)
    colours = colourise(decibels, _DEPTH_DB)
    lines = []
    for cell in range(cells):
        line = Text()
        for upper, lower in zip(colours[2 * cell], colours[2 * cell + 1], strict=True):
            line.append("▀", f"{_rgb(upper)} on {_rgb(lower)}")
        lines.append(line)
    return lines


def _characters(magnitude: NDArray[np.float64], cells: int, columns: int) -> list[Text]:
    decibels = to_decibels(resample(magnitude, cells, columns), _DEPTH_DB)
    level = np.rint((decibels / _DEPTH_DB + 1) * (len(_RAMP) - 1)).astype(int)
    return [Text("".join(_RAMP[i] for i in row)) for row in level]


def _scale(coloured: bool) -> Text:
    steps = np.linspace(-_DEPTH_DB, 0, len(_RAMP))
    bar = Text(f"{-_DEPTH_DB:.0f} dB ")
    if coloured:
        for rgb in colourise(steps, _DEPTH_DB):
            bar.append("  ", f"on {_rgb(rgb)}")
    else:
        bar.append(_RAMP)
    return bar.append(" 0 dB")


def _rgb(colour: NDArray[np.uint8]) -> str:
    return f"#{colour[0]:02x}{colour[1]:02x}{colour[2]:02x}"


class Blocks:
    """Coloured half blocks for rich, as segments: texts with a thousand styles are too slow to draw.

    Args:
        levels: (2 * lines, columns) of 0..LEVELS - 1.
    """

    def __init__(self, levels: NDArray[np.intp]) -> None:
        self._levels = levels

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        columns = self._levels.shape[1]
        for upper, lower in zip(self._levels[::2], self._levels[1::2], strict=True):
            edges = np.flatnonzero((np.diff(upper) != 0) | (np.diff(lower) != 0)) + 1
            for first, last in pairwise([0, *edges.tolist(), columns]):
                yield Segment("▀" * (last - first), _style(int(upper[first]), int(lower[first])))
            yield Segment.line()


def raster(levels: NDArray[np.intp], colour: bool) -> RenderableType:
    """Levels (rows, columns) of 0..LEVELS - 1 as text, the first row on top.

    With colours two rows share a line, so their number is even; without, each row is a line.
    """
    if colour:
        return Blocks(levels)
    ramp = levels * (len(_RAMP) - 1) // (LEVELS - 1)
    return Text("\n".join("".join(_RAMP[i] for i in row) for row in ramp.tolist()), no_wrap=True)


@cache
def _style(upper: int, lower: int) -> Style:
    return Style.parse(f"{_COLOURS[upper]} on {_COLOURS[lower]}")
