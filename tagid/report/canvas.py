"""A white canvas with text, lines and rasters, saved as PNG atomically.

Drawing is done at twice the size and reduced at the end, which smooths lines and letters, because Pillow has
no anti-aliasing.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from tagid.errors import UsageError
from tagid.files import write_bytes
from tagid.report.colours import INK, RGB, WHITE

OVERSAMPLING = 2
_LARGEST_SIDE = 20_000

Point = tuple[float, float]


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


class Canvas:
    """A sheet of width x height px; all coordinates are px of the finished picture, y downwards."""

    def __init__(self, width: int, height: int) -> None:
        if not (0 < width <= _LARGEST_SIDE and 0 < height <= _LARGEST_SIDE):
            raise UsageError(f"a picture of {width} x {height} px cannot be drawn")
        self.width = width
        self.height = height
        self._image = Image.new("RGB", (width * OVERSAMPLING, height * OVERSAMPLING), WHITE)
        self._draw = ImageDraw.Draw(self._image)

    def text(
        self,
        at: Point,
        text: str,
        size: int = 22,
        colour: RGB = INK,
        anchor: str = "la",
        halo: RGB | None = None,
    ) -> None:
        """Text at a point; `anchor` as in Pillow (l/m/r and a/m/s/d), `halo` draws a rim in that colour."""
        self._draw.text(
            (at[0] * OVERSAMPLING, at[1] * OVERSAMPLING),
            text,
            fill=colour,
            font=_font(size * OVERSAMPLING),
            anchor=anchor,
            stroke_width=2 * OVERSAMPLING if halo else 0,
            stroke_fill=halo,
        )

    def text_upwards(self, at: Point, text: str, size: int) -> None:
        """Text turned to read upwards, its middle at a point."""
        width = int(self.text_width(text, size) + 2)
        sheet = Image.new("L", (width * OVERSAMPLING, 2 * size * OVERSAMPLING), 0)
        centre = (width * OVERSAMPLING / 2, size * OVERSAMPLING)
        ImageDraw.Draw(sheet).text(centre, text, fill=255, font=_font(size * OVERSAMPLING), anchor="mm")
        turned = sheet.transpose(Image.Transpose.ROTATE_90)
        corner = (
            round(at[0] * OVERSAMPLING - turned.width / 2),
            round(at[1] * OVERSAMPLING - turned.height / 2),
        )
        self._image.paste(INK, corner, turned)

    def text_width(self, text: str, size: int = 22) -> float:
        """Width of a line of text, px."""
        return float(_font(size * OVERSAMPLING).getlength(text)) / OVERSAMPLING

    def line(self, points: Sequence[Point], colour: RGB = INK, width: float = 1.5) -> None:
        scaled = [(x * OVERSAMPLING, y * OVERSAMPLING) for x, y in points]
        self._draw.line(scaled, fill=colour, width=max(1, round(width * OVERSAMPLING)), joint="curve")

    def rectangle(self, box: tuple[float, float, float, float], fill: RGB) -> None:
        """A filled rectangle (left, top, right, bottom)."""
        self._draw.rectangle([round(v * OVERSAMPLING) for v in box], fill=fill)

    def circle(self, at: Point, radius: float, colour: RGB, width: float = 2.5) -> None:
        x, y, r = (v * OVERSAMPLING for v in (*at, radius))
        self._draw.ellipse((x - r, y - r, x + r, y + r), outline=colour, width=round(width * OVERSAMPLING))

    def raster(
        self, box: tuple[float, float, float, float], colours: NDArray[np.uint8], smooth: bool = False
    ) -> None:
        """Colours (rows, columns, 3), first row on top, stretched over a box (left, top, right, bottom)."""
        left, top, right, bottom = (round(v * OVERSAMPLING) for v in box)
        how = Image.Resampling.BICUBIC if smooth else Image.Resampling.NEAREST
        picture = Image.fromarray(np.ascontiguousarray(colours))
        self._image.paste(picture.resize((right - left, bottom - top), how), (left, top))

    def png(self) -> bytes:
        buffer = io.BytesIO()
        self._image.reduce(OVERSAMPLING).save(buffer, format="PNG")
        return buffer.getvalue()

    def save(self, path: Path) -> None:
        """Write the PNG atomically: a reader sees the old file or the complete new one.

        Raises StorageError, DiskFullError.
        """
        write_bytes(path, self.png())
