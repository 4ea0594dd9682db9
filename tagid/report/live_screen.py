"""The screen of a scan in progress: image, sinogram, evidence and figures, as text for any terminal.

It is drawn several times per second, possibly over a slow connection.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from tagid.errors import visible
from tagid.live.state import LiveState, Phase
from tagid.reading.preview import LayoutEvidence
from tagid.report.colours import to_decibels
from tagid.report.preview import LEVELS, raster, resample

MOST_COLUMNS, MOST_LINES = 640, 200
"""Largest part of a terminal that is drawn, in characters: a 4K screen in a small font has 640 by 135."""
IMAGE_DB: Final = 25.0
SINOGRAM_DB: Final = 30.0
_BAR: Final = 24
_HEAD: Final = 3
_GAP: Final = 2
_GUTTER: Final = 7
"""Columns of the labels to the left of a picture."""
_MOST_BARS: Final = 8


def bounded(size: tuple[int, int]) -> tuple[int, int]:
    """The part of a terminal that is drawn, columns and lines: a terminal may state any size."""
    return min(size[0], MOST_COLUMNS), min(size[1], MOST_LINES)


def draw(state: LiveState, title: str, size: tuple[int, int], colour: bool) -> RenderableType:
    """The whole screen of so many columns and lines: coloured half blocks, or characters; the title first."""
    columns, lines = bounded(size)
    columns, lines = max(columns - 1, 30), max(lines, 10)
    head = Text(no_wrap=True, overflow="crop")
    head.append(visible(title)[:columns] + "\n", style="bold")
    head.append_text(_figures(state)).append("\n").append_text(_answer(state))
    bars = _bars(state.evidence, columns, colour)
    height = lines - _HEAD - len(bars) - 1
    parts: list[RenderableType] = [head]
    if height >= 4:
        width = (columns - _GAP) // 2
        pictures = Table.grid(padding=(0, _GAP, 0, 0))
        pictures.add_row(_image(state, width, height, colour), _sinogram(state, width, height, colour))
        parts.append(pictures)
    return Group(*parts, *bars)


def _figures(s: LiveState) -> Text:
    """Scans, angle covered, SNR and losses."""
    text = Text(f"{s.scans} scans in {s.seconds:.1f} s  ")
    if s.turned_rad is None:
        text.append("angle not known yet  ")
    else:
        text.append(f"{min(np.rad2deg(s.turned_rad), 360.0):.0f} of 360 deg  ")
    text.append("SNR -  " if s.snr_db is None else f"SNR {s.snr_db:.1f} dB  ")
    text.append(f"lost {s.lost}  ", style="bold yellow" if s.lost else "")
    return text.append(f"{s.views} views" if s.views else "")


def _answer(s: LiveState) -> Text:
    """The answer so far, or the state of the scan."""
    if s.phase is Phase.FAILED:
        return Text(visible(s.note), style="bold red")
    if s.answer is not None:
        reading = s.answer.reading
        name = reading.layout if reading is not None and s.answer.status == "identified" else None
        words = name or s.answer.status.replace("_", " ")
        text = Text(visible(words).upper(), style="bold green" if name else "bold yellow")
        if reading is not None and reading.reason:
            text.append(f"  {reading.reason}", style="not bold")
        return text.append("" if s.final else "  (the recording continues)", style="dim")
    if s.note:
        return Text(visible(s.note), style="yellow")
    doing = {
        Phase.CONNECTING: "connecting to the radar",
        Phase.TURNING: "recording; Ctrl-C stops",
        Phase.READING: "reading",
    }
    return Text(doing.get(s.phase, ""))


def _bars(evidence: tuple[LayoutEvidence, ...], columns: int, colour: bool) -> list[Text]:
    """One line per layout, the best first: its log evidence as a part of the best one's, and its lead."""
    full, empty = ("█", "░") if colour else ("#", ".")
    best = evidence[:_MOST_BARS]
    width = min(max((len(item.layout) for item in best), default=0), 24)
    lines = []
    for item in best:
        filled = round(_BAR * max(item.log_evidence, 0) / max(best[0].log_evidence, 1))
        line = Text(no_wrap=True, overflow="crop")
        line.append(f"{visible(item.layout)[:width]:<{width}} ")
        line.append(full * filled + empty * (_BAR - filled), style="yellow")
        line.append(f" ahead by {item.lead:.0f}" if item.lead > 0 else f" {-item.lead:.0f} behind")
        lines.append(line)
    if len(evidence) > len(best):
        lines.append(Text(f"and {len(evidence) - len(best)} more layouts", style="dim"))
    return lines


def _image(s: LiveState, width: int, height: int, colour: bool) -> RenderableType:
    if s.image is None:
        return Text("no image yet".ljust(width))
    # A character cell is about twice as high as wide.
    side = max(min(width - _GUTTER, 2 * (height - 1)), 8)
    values = np.abs(s.image.values[::-1]).astype(np.float64)
    edge = f"{s.image.grid.extent * 500:.0f}"
    picture = _raster(values, IMAGE_DB, side, side // 2, colour)
    return _with_axes(picture, side, side // 2, (f"-{edge}", "x, mm", edge), (edge, "y, mm", f"-{edge}"))


def _sinogram(s: LiveState, width: int, height: int, colour: bool) -> RenderableType:
    if s.sinogram is None:
        return Text("no scans yet")
    columns, lines = max(width - _GUTTER, 8), height - 1
    picture = _raster(s.sinogram.rows.astype(np.float64), SINOGRAM_DB, columns, lines, colour)
    near, far = s.sinogram.range_m
    across = (f"{near:.2f}", "range, m", f"{far:.2f}")
    return _with_axes(picture, columns, lines, across, ("0 s", "", f"{s.seconds:.0f} s"))


def _with_axes(
    picture: RenderableType,
    columns: int,
    lines: int,
    across: tuple[str, str, str],
    down: tuple[str, str, str],
) -> RenderableType:
    """A picture of so many columns and lines with the first and last value and the title of its axes."""
    first, title, last = down
    labels = [first, *[""] * (lines - 2), last]
    if lines > 2:
        labels[lines // 2] = title
    below = f"{across[0]}{across[1]:^{max(columns - len(across[0]) - len(across[2]), 0)}}{across[2]}"
    framed = Table.grid()
    gutter = Text("\n".join(f"{label:>{_GUTTER - 1}} " for label in labels), style="dim", no_wrap=True)
    framed.add_row(gutter, picture)
    framed.add_row("", Text(below[:columns], style="dim", no_wrap=True))
    return framed


def _raster(
    values: NDArray[np.float64], depth_db: float, columns: int, lines: int, colour: bool
) -> RenderableType:
    """Values (rows, columns) as text, the first row on top."""
    rows = 2 * lines if colour else lines
    decibels = to_decibels(resample(values, rows, columns), depth_db)
    level = np.rint((decibels / depth_db + 1) * (LEVELS - 1))
    return raster(np.clip(level, 0, LEVELS - 1).astype(np.intp), colour)
