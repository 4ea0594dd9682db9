"""The monitor's screen: range to the right, time downwards, and the figures above it, as text.

It is drawn a dozen times per second, possibly over a slow connection.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.text import Text

from tagid.radar.status import WARM_C
from tagid.recording.monitoring import Snapshot
from tagid.report.colours import to_decibels
from tagid.report.preview import LEVELS, raster, resample

DEPTH_DB: Final = 40.0
_HEAD_LINES: Final = 4
_SILENT_S: Final = 2.0


def draw(snapshot: Snapshot, title: str, size: tuple[int, int], colour: bool) -> RenderableType:
    """The whole screen of so many columns and lines: coloured half blocks, or characters; the title first."""
    columns, lines = max(size[0] - 1, 20), max(size[1], 8)
    text = Text(no_wrap=True, overflow="crop", end="")
    text.append(title[:columns], style="bold").append("\n")
    text.append_text(_figures(snapshot)).append("\n")
    text.append_text(_state(snapshot)).append("\n")
    low, high = (f"{metres:.2f} m" for metres in snapshot.range_m)
    middle = f"{sum(snapshot.range_m) / 2:.2f} m"
    gap = max(columns - len(low) - len(high) - len(middle), 2)
    text.append(low + " " * (gap // 2) + middle + " " * (gap - gap // 2) + high, style="dim").append("\n")
    height = lines - _HEAD_LINES
    if not len(snapshot.rows):
        return text.append("waiting for scans")
    wanted = 2 * height if colour else height
    shown = snapshot.rows[:wanted].astype(np.float64)
    levels = _levels(resample(shown, len(shown), columns))
    if len(levels) < wanted:
        levels = np.concatenate([levels, np.zeros((wanted - len(levels), columns), np.intp)])
    return Group(text, raster(levels, colour))


def _figures(s: Snapshot) -> Text:
    """Scan rate, strongest return, clipping, loss, temperature; problems in red."""
    text = Text()
    rate = "-" if s.scan_rate_hz is None else f"{s.scan_rate_hz:.1f}"
    text.append(f"{rate} scans/s  ")
    text.append(s.strongest)
    text.append("  ")
    text.append(f"clipped {s.clipped_fraction:.2%}", style="bold red" if s.clipped_fraction else "")
    text.append("  ")
    text.append(f"lost {s.lost_fraction:.1%} ({s.lost})", style="bold yellow" if s.lost else "")
    text.append("  ")
    hot = s.temperature_c is not None and s.temperature_c > WARM_C
    degrees = "-" if s.temperature_c is None else f"{s.temperature_c:.1f}"
    return text.append(f"{degrees} degC", style="bold red" if hot else "")


def _state(s: Snapshot) -> Text:
    if s.silent_s > _SILENT_S:
        return Text(f"no scan for {s.silent_s:.0f} s", style="bold red")
    if s.note:
        return Text(s.note, style="yellow")
    return Text(f"{s.scans} scans in {s.seconds:.0f} s; Ctrl-C stops")


def _levels(envelope: NDArray[np.float64]) -> NDArray[np.intp]:
    """0..15 by decibels below the strongest; noise is level 0 almost everywhere."""
    decibels = to_decibels(envelope, DEPTH_DB)
    floor = max(float(np.median(decibels)) + 6.0, -DEPTH_DB)
    share = (decibels - floor) / max(-floor, 1.0)
    return np.clip(np.rint(share * (LEVELS - 1)), 0, LEVELS - 1).astype(np.intp)
