"""What the hypotheses that competed leave of a recording: sinograms of one scale, one below the other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tagid.reading.reading import Explanation, Residuals
from tagid.report.axes import Axes, colour_bar
from tagid.report.canvas import Canvas
from tagid.report.colours import colourise, to_decibels
from tagid.report.picture import fit_text

DEPTH_DB = 40.0
_WIDTH, _LEFT, _RIGHT = 940, 110, 130
_TOP, _HEIGHT, _GAP = 60, 150, 70


def draw_residuals(residuals: Residuals, hypotheses: Sequence[Explanation], path: Path) -> None:
    """Writes a PNG, atomically: the echo that changes over the views, and what each hypothesis leaves of it.

    The hypotheses are those of the residuals, best first. Raises StorageError, DiskFullError.
    """
    titles = ["recorded, without what stands still"]
    titles += [
        f"{hypothesis.residual_words} by {hypothesis.words}"
        for hypothesis in hypotheses[: len(residuals.by_hypothesis)]
    ]
    rows = [residuals.recorded, *residuals.by_hypothesis]
    canvas = Canvas(_WIDTH, _TOP + len(rows) * (_HEIGHT + _GAP) + 30)
    reference = float(np.max(residuals.recorded, initial=1e-6))
    for i, (title, profiles) in enumerate(zip(titles, rows, strict=True)):
        top = _TOP + i * (_HEIGHT + _GAP)
        box = (_LEFT, top, _WIDTH - _RIGHT, top + _HEIGHT)
        low, high = float(residuals.range_m[0]), float(residuals.range_m[-1])
        axes = Axes(canvas, box, (0.0, 360.0), (low, high))
        decibels = to_decibels(_evenly(residuals, profiles), DEPTH_DB, reference)[::-1]
        canvas.raster(box, colourise(decibels, DEPTH_DB))
        last = i == len(rows) - 1
        axes.frame("angle (deg)" if last else "", "range (m)" if i == 0 else "")
        canvas.text((_LEFT, top - 12), fit_text(canvas, title, _WIDTH - _LEFT - 30, 20), 20, anchor="ls")
    right = _WIDTH - _RIGHT
    colour_bar(canvas, (right + 24, _TOP, right + 50, _TOP + _HEIGHT), DEPTH_DB)
    canvas.save(path)


def _evenly(residuals: Residuals, profiles: NDArray[np.float16]) -> NDArray[np.float64]:
    """(R, 180) of the nearest view every two degrees; the darkest where no view is within 20 degrees."""
    wanted = np.deg2rad(np.arange(1, 360, 2))
    apart = np.abs(np.angle(np.exp(1j * (wanted[:, None] - residuals.angle_rad))))
    nearest = apart.argmin(axis=1)
    return np.where(apart.min(axis=1) < np.deg2rad(20), profiles[:, nearest].astype(np.float64), 0.0)
