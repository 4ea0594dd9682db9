"""Pictures of a report: curves, or points, in one box each."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from tagid.constants import SAMPLE_STEP_S
from tagid.report.axes import nice_ticks, tick_labels
from tagid.signal import analytic
from tagid.types import Floats

if TYPE_CHECKING:
    from reportlab.graphics.shapes import Drawing

_MOST_POINTS: Final = 300
_SIZE: Final = (206.0, 110.0)
"""Of a box, points of 1/72 inch; two stand beside each other on a page."""
_LEFT, _BELOW, _ABOVE, _RIGHT = 34.0, 30.0, 6.0, 8.0
_INKS: Final = ("#1f5fa8", "#c05a00")
_FRAME: Final = "#999999"
_FLOOR_DB: Final = -40.0
_FINE: Final = 1024
"""Samples to which a pulse is filled up for its spectrum."""


@dataclass(frozen=True)
class Picture:
    """A box with one or two curves.

    Attributes:
        title: of the abscissa, with its unit, and of the ordinate.
        curves: x and y of every curve.
        dots: points that are not joined; one unit is as long in both directions.
    """

    title: str
    curves: tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]
    dots: bool = False

    @classmethod
    def of(cls, title: str, *curves: tuple[Floats, Floats], dots: bool = False) -> Picture:
        """The picture of arrays; of long ones every so many-th point is kept."""
        return cls(title, tuple((_few(x), _few(y)) for x, y in curves), dots)

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Picture:
        """The picture of plain JSON values. Raises KeyError, TypeError, ValueError."""
        curves = tuple((tuple(map(float, x)), tuple(map(float, y))) for x, y in data["curves"])
        return cls(str(data["title"]), curves, bool(data["dots"]))


def _few(values: Floats) -> tuple[float, ...]:
    return tuple(float(f"{value:.4g}") for value in values[:: -(-len(values) // _MOST_POINTS)])


def wave_and_spectrum(samples: Floats) -> tuple[Picture, Picture]:
    """A pulse, whose middle sample is time zero, over time, and its spectrum."""
    time_ns = np.asarray((np.arange(len(samples)) - len(samples) // 2) * SAMPLE_STEP_S * 1e9, np.float64)
    shown = (time_ns >= -2) & (time_ns <= 4)
    frequency_hz = np.asarray(np.fft.rfftfreq(_FINE, SAMPLE_STEP_S), np.float64)
    frequency, level = _band(frequency_hz, np.abs(np.fft.rfft(samples, _FINE)) ** 2)
    level = np.maximum(level - level.max(), _FLOOR_DB)
    return (
        Picture.of("ns: pulse", (time_ns[shown], samples[shown])),
        Picture.of("GHz: spectrum of the pulse, dB", (frequency, level)),
    )


def noise_spectrum(frequency_hz: Floats, power: Floats) -> Picture:
    """The mean spectrum of the noise, over its median."""
    frequency, level = _band(frequency_hz, power)
    return Picture.of("GHz: spectrum of the noise, dB", (frequency, level - np.median(level)))


def _band(frequency_hz: Floats, power: Floats) -> tuple[Floats, Floats]:
    """(frequency, GHz; level, dB) of the frequencies about the radar's band."""
    inside = (frequency_hz >= 2e9) & (frequency_hz <= 6e9)
    level = np.asarray(10 * np.log10(np.maximum(power[inside], 1e-12)), np.float64)
    return frequency_hz[inside] / 1e9, level


def echo_over_range(ranges_m: Floats, scan: Floats, noise: float, title: str) -> Picture:
    """The envelope of a scan (bins,) over the noise of a sample."""
    envelope = np.abs(analytic(scan[None].astype(np.float32)))[0].astype(np.float64)
    level = 20 * np.log10(np.maximum(envelope / max(noise, 1e-9), 0.1))
    return Picture.of(f"m: {title}, dB over the noise of a scan", (ranges_m, level))


def drawing_of(picture: Picture) -> Drawing:
    """The picture as a drawing of reportlab, which writes it as PDF or SVG."""
    from reportlab.graphics.shapes import Circle, Drawing, PolyLine, Rect, String
    from reportlab.lib.colors import HexColor

    width, height = _SIZE
    drawing = Drawing(_LEFT + width + _RIGHT, _BELOW + height + _ABOVE)
    frame = HexColor(_FRAME)
    drawing.add(Rect(_LEFT, _BELOW, width, height, fillColor=None, strokeColor=frame, strokeWidth=0.5))
    across, up = _limits(picture)
    for ink, (x, y) in zip(_INKS, picture.curves, strict=False):
        points = [
            (_LEFT + _share(a, across) * width, _BELOW + _share(b, up) * height)
            for a, b in zip(x, y, strict=True)
        ]
        if picture.dots:
            for a, b in points:
                hollow = ink == _INKS[0]
                drawing.add(
                    Circle(a, b, 4 if hollow else 2, fillColor=None if hollow else HexColor(ink),
                           strokeColor=HexColor(ink), strokeWidth=0.8)
                )  # fmt: skip
        else:
            flat = [value for point in points for value in point]
            drawing.add(PolyLine(flat, strokeColor=HexColor(ink), strokeWidth=0.8))
    marks = nice_ticks(*across)
    for at, words in zip(marks, tick_labels(marks), strict=True):
        x_at = _LEFT + _share(at, across) * width
        drawing.add(String(x_at, _BELOW - 10, words, fontSize=7, textAnchor="middle"))
    marks = nice_ticks(*up, 4)
    for at, words in zip(marks, tick_labels(marks), strict=True):
        y_at = _BELOW + _share(at, up) * height
        drawing.add(String(_LEFT - 3, y_at - 2, words, fontSize=7, textAnchor="end"))
    drawing.add(String(_LEFT + width / 2, 4, picture.title, fontSize=7.5, textAnchor="middle"))
    return drawing


def _share(value: float, ends: tuple[float, float]) -> float:
    return (value - ends[0]) / (ends[1] - ends[0])


def _limits(picture: Picture) -> tuple[tuple[float, float], tuple[float, float]]:
    """What the box shows of x and of y."""
    across = _ends([value for x, _ in picture.curves for value in x], 0.05 if picture.dots else 0.0)
    up = _ends([value for _, y in picture.curves for value in y], 0.05)
    if picture.dots:
        scale = max((across[1] - across[0]) / _SIZE[0], (up[1] - up[0]) / _SIZE[1])
        across, up = _about(across, scale * _SIZE[0]), _about(up, scale * _SIZE[1])
    return across, up


def _about(ends: tuple[float, float], length: float) -> tuple[float, float]:
    middle = sum(ends) / 2
    return middle - length / 2, middle + length / 2


def _ends(values: list[float], margin: float) -> tuple[float, float]:
    finite = [value for value in values if math.isfinite(value)] or [0.0]
    low, high = min(finite), max(finite)
    spare = max((high - low) * margin, 1e-9 if high > low else 0.5)
    return low - spare, high + spare


def to_svg(picture: Picture) -> str:
    """The picture as SVG."""
    from reportlab.graphics.renderSVG import drawToString

    return str(drawToString(drawing_of(picture)))
