"""A raster as text, redrawn many times per second in a terminal: coloured half blocks, or characters.

Few colours are used and equal neighbours share one escape sequence, because the terminal may be behind a slow
connection.
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

from tagid.report.colours import viridis

LEVELS: Final = 16
_RAMP: Final = " .:-=+*#%@"
_COLOURS: Final = [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in viridis(LEVELS).tolist()]


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
