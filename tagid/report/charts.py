"""A recording in one picture: range profile, sinogram and spectrum.

It shows, before reconstruction, whether the radar detects the object and the scans are valid.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.counting import counted
from tagid.recording.curves import RecordingCurves, slow_time
from tagid.report.axes import LABEL_SIZE, Axes, colour_bar
from tagid.report.canvas import Canvas
from tagid.report.colours import BAND_INK, BLUE, GAP, GREEN, INK, ORANGE, RGB, colourise, to_decibels
from tagid.report.picture import fit_text
from tagid.signal import median

_WIDTH, _HEIGHT = 1000, 1330
_LEFT, _RIGHT = 120, 880
_PROFILE = (_LEFT, 110, _RIGHT, 370)
_SINOGRAM = (_LEFT, 500, _RIGHT, 860)
_SPECTRUM = (_LEFT, 990, _RIGHT, 1250)
_HIGHEST_SHOWN_HZ = 8.2e9


def draw_recording(
    capture: Capture, path: Path, title: str = "", *, changing_only: bool = False, turning: bool = True
) -> None:
    """Writes a PNG of a recording, 1000 x 1330 px.

    From above: mean and largest envelope over range and the mean envelope of the changing part (dB of the
    largest); the envelope of every view over range (dB below the 99.9th percentile, gaps of lost scans in
    grey); the mean spectrum over frequency with the band of the pulse shaded. Frequencies follow from the
    range step: sampling rate = c / (2 step).

    Args:
        path: the PNG; written atomically.
        title: one line above the charts, truncated if too long.
        changing_only: draw the scans without the mean scan; otherwise leakage and room hide a rotating tag.
        turning: whether the object rotates, so that the scans over time are a sinogram.

    Raises:
        StorageError, DiskFullError: the file cannot be written.
    """
    curves = RecordingCurves.of(capture, changing_only=changing_only)
    canvas = Canvas(_WIDTH, _HEIGHT)
    canvas.text((_LEFT, 30), fit_text(canvas, title, _WIDTH - _LEFT - 30, 28), 28)
    _draw_profile(canvas, curves, capture.range_step_m)
    what = "what changes in" if changing_only else "envelope of"
    count = counted(capture.views, "scan")
    name = "Sinogram" if turning else "Scans over time"
    _draw_sinogram(canvas, capture, curves, f"{name}: {what} {count}")
    _draw_spectrum(canvas, capture, curves)
    canvas.save(Path(path))


def resample_views(
    envelope: NDArray[np.float32], position: NDArray[np.float64], rows: int, columns: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The sinogram on a raster: the largest envelope in each cell, so that narrow echoes are kept.

    Args:
        envelope: (views, bins).
        position: (views,) rising slow time.
        rows, columns: raster's size, at least 1.

    Returns:
        (rows, columns) values, row 0 the earliest, and (rows,) True if no view lies within 1.5 intervals.
    """
    bins = envelope.shape[1]
    starts = (np.arange(min(columns, bins)) * bins) // min(columns, bins)
    narrow = np.maximum.reduceat(envelope, starts, axis=1)
    interval = float(median(np.diff(position))) if len(position) > 1 else 1.0
    interval = interval or (position[-1] - position[0]) / len(position) or 1.0
    edges = np.linspace(position[0] - interval / 2, position[-1] + interval / 2, rows + 1)
    middles = (edges[1:] + edges[:-1]) / 2
    after = np.clip(np.searchsorted(position, middles), 0, len(position) - 1)
    before = np.maximum(after - 1, 0)
    closer_before = np.abs(position[before] - middles) <= np.abs(position[after] - middles)
    nearest = np.where(closer_before, before, after)
    gaps = np.abs(position[nearest] - middles) > 1.5 * interval
    picture = narrow[nearest]
    owner = np.clip(np.searchsorted(edges, position, side="right") - 1, 0, rows - 1)
    np.maximum.at(picture, owner, narrow)
    return picture, gaps


def _draw_profile(canvas: Canvas, curves: RecordingCurves, step_m: float) -> None:
    top = float(curves.max_envelope.max())
    largest = to_decibels(curves.max_envelope, 120.0, top)
    mean = to_decibels(curves.mean_envelope, 120.0, top)
    axes = Axes(canvas, _PROFILE, _span(curves.range_m, step_m), (_floor(mean), 4.0))
    axes.grid()
    axes.curve(curves.range_m, largest, ORANGE, 1.5)
    axes.curve(curves.range_m, to_decibels(curves.changing_envelope, 120.0, top), GREEN, 2.5)
    axes.curve(curves.range_m, mean, BLUE, 2.5)
    axes.frame("range, one way (m)", "envelope (dB)", "Range profile")
    _legend(canvas, _PROFILE, [("mean", BLUE), ("largest of any view", ORANGE), ("changing part", GREEN)])


def _draw_sinogram(canvas: Canvas, capture: Capture, curves: RecordingCurves, title: str) -> None:
    position, label = slow_time(capture)
    rows, columns = _SINOGRAM[3] - _SINOGRAM[1], _SINOGRAM[2] - _SINOGRAM[0]
    picture, gaps = resample_views(curves.envelope, position, rows, columns)
    reference = float(np.percentile(curves.envelope, 99.9)) or None
    # The colour scale ends slightly below the median of the noise, because it is meant for echoes.
    middle = float(to_decibels(np.median(picture, keepdims=True), 80.0, reference).item())
    depth_db = float(min(max(10 * math.ceil((3 - middle) / 10), 20), 60))
    colours = colourise(to_decibels(picture, depth_db, reference), depth_db)
    colours[gaps] = GAP
    interval = (position[-1] - position[0]) / max(len(position) - 1, 1) or 1.0
    slow = (float(position[0] - interval / 2), float(position[-1] + interval / 2))
    axes = Axes(canvas, _SINOGRAM, _span(curves.range_m, capture.range_step_m), slow)
    canvas.raster(_SINOGRAM, colours[::-1])
    axes.frame("range, one way (m)", label, title)
    bar = (_RIGHT + 22, _SINOGRAM[1], _RIGHT + 44, _SINOGRAM[3])
    colour_bar(canvas, bar, depth_db)


def _draw_spectrum(canvas: Canvas, capture: Capture, curves: RecordingCurves) -> None:
    low = capture.center_frequency_hz - capture.bandwidth_hz / 2
    high = capture.center_frequency_hz + capture.bandwidth_hz / 2
    last = float(curves.frequency_hz[-1])
    shown = min(max(_HIGHEST_SHOWN_HZ, 1.3 * high), last) if last > 0 else 1e9
    # Zero frequency is the offset of the converter, not an echo: it must not set the scale.
    echo = curves.spectrum[1:] if len(curves.spectrum) > 1 else curves.spectrum
    decibels = to_decibels(curves.spectrum, 120.0, float(echo.max()))
    inside = curves.frequency_hz <= shown
    axes = Axes(canvas, _SPECTRUM, (0.0, shown / 1e9), (_floor(decibels[inside]), 4.0))
    axes.band(low / 1e9, high / 1e9)
    axes.grid()
    axes.curve(curves.frequency_hz / 1e9, decibels, BLUE, 2)
    axes.frame("frequency (GHz)", "spectrum (dB)", "Spectrum, mean of all views")
    _legend(canvas, _SPECTRUM, [(f"band {low / 1e9:.1f} to {high / 1e9:.1f} GHz", BAND_INK)])


def _floor(decibels: NDArray[np.float64]) -> float:
    """Lower limit that leaves a margin below the noise floor: a multiple of 10 dB, minus 5."""
    quiet = float(np.percentile(decibels, 2))
    return -10 * math.ceil(min(max(-quiet, 15.0), 85.0) / 10) - 5


def _span(ranges: NDArray[np.float64], step_m: float) -> tuple[float, float]:
    return float(ranges[0] - step_m / 2), float(ranges[-1] + step_m / 2)


def _legend(canvas: Canvas, box: tuple[float, float, float, float], entries: list[tuple[str, RGB]]) -> None:
    """Entries side by side above the frame, the last at its right edge."""
    right = box[2]
    for text, colour in reversed(entries):
        width = canvas.text_width(text, LABEL_SIZE - 2)
        canvas.text((right, box[1] - 12), text, LABEL_SIZE - 2, INK, anchor="rs")
        canvas.line([(right - width - 34, box[1] - 18), (right - width - 8, box[1] - 18)], colour, 4)
        right -= width + 58
