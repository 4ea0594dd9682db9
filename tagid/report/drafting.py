"""Technical drawings in millimetres: one list of lines, circles and texts, written as SVG or PNG; PDF: `pdf`.

A print template is only useful at true scale, so all coordinates are in millimetres.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass, field, replace
from html import escape

from PIL import Image, ImageDraw, ImageFont

from tagid.errors import UsageError

MM_PER_INCH = 25.4
PAPERS_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
MARGIN_MM = 10.0
"""Printers leave 5 to 7 mm of a sheet blank."""
MAX_SIDE_MM = 10_000.0
HALO_MM = 0.8
"""White margin around letters, so that lines behind them do not make them illegible."""
DASH_MM, GAP_MM = 2.0, 1.5
_DPI = 200.0


@dataclass(frozen=True)
class Line:
    """A straight line between points (x, y), mm; dashed if not to be cut or glued."""

    start: tuple[float, float]
    end: tuple[float, float]
    width: float = 0.3
    dashed: bool = False


@dataclass(frozen=True)
class Circle:
    centre: tuple[float, float]
    radius: float
    width: float = 0.3
    dashed: bool = False
    filled: bool = False


@dataclass(frozen=True)
class Text:
    """Text of a height in mm, vertically centred on its point; anchor "start", "middle" or "end"."""

    at: tuple[float, float]
    text: str
    size: float = 4.0
    anchor: str = "middle"


Mark = Line | Circle | Text


def moved(mark: Mark, x: float, y: float) -> Mark:
    """The same mark elsewhere, by so many mm."""

    def there(point: tuple[float, float]) -> tuple[float, float]:
        return point[0] + x, point[1] + y

    if isinstance(mark, Line):
        return replace(mark, start=there(mark.start), end=there(mark.end))
    if isinstance(mark, Circle):
        return replace(mark, centre=there(mark.centre))
    return replace(mark, at=there(mark.at))


@dataclass
class Drawing:
    """A sheet of width x height mm, the origin at its lower left, y upwards."""

    width: float
    height: float
    marks: list[Mark] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not (0 < self.width <= MAX_SIDE_MM and 0 < self.height <= MAX_SIDE_MM):
            raise UsageError(f"a drawing of {self.width:.0f} x {self.height:.0f} mm cannot be made")

    def add(self, *marks: Mark) -> None:
        self.marks.extend(marks)

    def cross(self, at: tuple[float, float], half: float) -> None:
        """An upright cross that marks a position."""
        x, y = at
        self.add(Line((x - half, y), (x + half, y)), Line((x, y - half), (x, y + half)))


def to_svg(drawing: Drawing) -> bytes:
    """The drawing as an SVG file whose width and height are true millimetres."""
    w, h = drawing.width, drawing.height
    rows = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{w:g}mm" height="{h:g}mm" '
        f'viewBox="0 0 {w:g} {h:g}">',
        f'<rect width="{w:g}" height="{h:g}" fill="white"/>',
        '<g stroke="black" fill="none" font-family="sans-serif">',
    ]
    for mark in drawing.marks:
        if isinstance(mark, Line):
            (x1, y1), (x2, y2) = mark.start, mark.end
            rows.append(
                f'<line x1="{x1:.3f}" y1="{h - y1:.3f}" x2="{x2:.3f}" y2="{h - y2:.3f}" {_stroke(mark)}/>'
            )
        elif isinstance(mark, Circle):
            x, y = mark.centre
            fill = ' fill="black"' if mark.filled else ""
            rows.append(
                f'<circle cx="{x:.3f}" cy="{h - y:.3f}" r="{mark.radius:.3f}" {_stroke(mark)}{fill}/>'
            )
        else:
            x, y = mark.at
            rows.append(
                f'<text x="{x:.3f}" y="{h - y:.3f}" font-size="{mark.size:g}" text-anchor="{mark.anchor}" '
                f'dominant-baseline="central" stroke="white" stroke-width="{HALO_MM:g}" paint-order="stroke" '
                f'fill="black">{escape(mark.text)}</text>'
            )
    return "\n".join([*rows, "</g>", "</svg>", ""]).encode("utf-8")


def _stroke(mark: Line | Circle) -> str:
    return f'stroke-width="{mark.width:g}"' + (
        f' stroke-dasharray="{DASH_MM:g} {GAP_MM:g}"' if mark.dashed else ""
    )


def to_png(drawing: Drawing) -> bytes:
    """The drawing as a PNG that carries its resolution."""
    buffer = io.BytesIO()
    _raster(drawing, 2 * _DPI).reduce(2).save(buffer, format="PNG", optimize=True, dpi=(_DPI, _DPI))
    return buffer.getvalue()


Tile = tuple[float, float, float, float]
"""A part (left, bottom, right, top) of a drawing, mm."""


def room(paper: str) -> tuple[float, float]:
    """Width and height, mm, of the printable area of a sheet. Raises UsageError for another paper."""
    if paper not in PAPERS_MM:
        raise UsageError(f"unknown paper size {paper!r}", f"Use {', '.join(PAPERS_MM)}.")
    width, height = PAPERS_MM[paper]
    return width - 2 * MARGIN_MM, height - 2 * MARGIN_MM


def page_tiles(drawing: Drawing, paper: str) -> tuple[list[Tile], tuple[float, float]]:
    """Parts of the drawing that fit on a sheet each, upper left first, and the sheet's width and height, mm.

    Portrait or landscape, whichever needs fewer sheets; empty parts are omitted.
    """
    room(paper)
    upright = PAPERS_MM[paper]
    ways = [(_tiles(drawing, size), size) for size in (upright, upright[::-1])]
    return min(ways, key=lambda way: len(way[0]))


def _tiles(drawing: Drawing, size: tuple[float, float]) -> list[Tile]:
    width, height = (side - 2 * MARGIN_MM for side in size)
    tiles = []
    top = drawing.height
    while top > 1e-6:
        left = 0.0
        while left < drawing.width - 1e-6:
            tiles.append((left, top - height, left + width, top))
            left += width
        top -= height
    return [tile for tile in tiles if any(_touches(mark, tile) for mark in drawing.marks)] or tiles[:1]


def _touches(mark: Mark, tile: Tile) -> bool:
    """Whether the mark's upright bounding box reaches into the tile; of a circle, its line."""
    left, bottom, right, top = tile
    if isinstance(mark, Text):
        half = 0.6 * mark.size * len(mark.text)
        x, y = mark.at
        spans = {"start": (0, half), "middle": (-half / 2, half / 2), "end": (-half, 0)}
        before, after = spans[mark.anchor]
        low, high = (x + before, y - mark.size), (x + after, y + mark.size)
    elif isinstance(mark, Line):
        low = min(mark.start[0], mark.end[0]), min(mark.start[1], mark.end[1])
        high = max(mark.start[0], mark.end[0]), max(mark.start[1], mark.end[1])
    else:
        (x, y), r = mark.centre, mark.radius
        far = max(abs(left - x), abs(right - x)), max(abs(bottom - y), abs(top - y))
        near = max(left - x, 0.0, x - right), max(bottom - y, 0.0, y - top)
        return math.hypot(*near) <= r <= math.hypot(*far)
    return low[0] <= right and high[0] >= left and low[1] <= top and high[1] >= bottom


def _raster(drawing: Drawing, dpi: float) -> Image.Image:
    scale = dpi / MM_PER_INCH
    image = Image.new("L", (round(drawing.width * scale), round(drawing.height * scale)), 255)
    pen = ImageDraw.Draw(image)

    def px(at: tuple[float, float]) -> tuple[float, float]:
        return at[0] * scale, (drawing.height - at[1]) * scale

    for mark in drawing.marks:
        if isinstance(mark, Text):
            anchor = {"start": "lm", "middle": "mm", "end": "rm"}[mark.anchor]
            font = ImageFont.load_default(max(1, round(mark.size * scale)))
            halo = round(HALO_MM / 2 * scale)
            pen.text(px(mark.at), mark.text, 0, font, anchor, stroke_width=halo, stroke_fill=255)
            continue
        width = max(1, round(mark.width * scale))
        if isinstance(mark, Line):
            for start, end in _dashes(mark) if mark.dashed else [(mark.start, mark.end)]:
                pen.line([px(start), px(end)], fill=0, width=width)
        else:
            (x, y), r = px(mark.centre), mark.radius * scale
            if mark.dashed:
                count = max(8, round(2 * math.pi * mark.radius / (DASH_MM + GAP_MM)))
                part_deg = 360 / count * DASH_MM / (DASH_MM + GAP_MM)
                for i in range(count):
                    angle = 360 * i / count
                    pen.arc((x - r, y - r, x + r, y + r), angle, angle + part_deg, fill=0, width=width)
            else:
                fill = 0 if mark.filled else None
                pen.ellipse((x - r, y - r, x + r, y + r), outline=0, fill=fill, width=width)
    return image


def _dashes(line: Line) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    (x1, y1), (x2, y2) = line.start, line.end
    length = ((x2 - x1) ** 2 + (y2 - y1) ** 2) ** 0.5
    if length == 0:
        return []
    ux, uy = (x2 - x1) / length, (y2 - y1) / length
    pieces, at = [], 0.0
    while at < length:
        end = min(at + DASH_MM, length)
        pieces.append(((x1 + ux * at, y1 + uy * at), (x1 + ux * end, y1 + uy * end)))
        at += DASH_MM + GAP_MM
    return pieces
