"""Technical drawings in millimetres: one list of lines, circles and texts, written as SVG, PNG or 1:1 PDF.

A print template is only useful at true scale, so millimetres go all the way to the printer.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from html import escape

from PIL import Image, ImageDraw, ImageFont

from tagid.errors import UsageError

MM_PER_INCH = 25.4
PRINT_DPI = 300
PAPERS_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
MARGIN_MM = 10.0
"""Printers leave 5 to 7 mm of a sheet blank."""
MAX_SIDE_MM = 10_000.0
MAX_PAGES = 60


@dataclass(frozen=True)
class Line:
    """A straight line between points (x, y), mm; dashed for what is not to be cut or stuck on."""

    start: tuple[float, float]
    end: tuple[float, float]
    width: float = 0.3
    dashed: bool = False


@dataclass(frozen=True)
class Circle:
    """A circle, mm; filled or open."""

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
        """Put marks on the sheet."""
        self.marks.extend(marks)

    def cross(self, at: tuple[float, float], half: float) -> None:
        """An upright cross that marks a place."""
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
                f'dominant-baseline="central" stroke="none" fill="black">{escape(mark.text)}</text>'
            )
    return "\n".join([*rows, "</g>", "</svg>", ""]).encode("utf-8")


def _stroke(mark: Line | Circle) -> str:
    return f'stroke-width="{mark.width:g}"' + (' stroke-dasharray="2 1.5"' if mark.dashed else "")


def to_png(drawing: Drawing, dpi: float = 200.0) -> bytes:
    """The drawing as a PNG that carries its resolution."""
    buffer = io.BytesIO()
    smooth = _raster(drawing, 2 * dpi, (0.0, 0.0, drawing.width, drawing.height)).reduce(2)
    smooth.save(buffer, format="PNG", optimize=True, dpi=(dpi, dpi))
    return buffer.getvalue()


def to_pdf(drawings: list[Drawing], paper: str) -> bytes:
    """The drawings at 1:1 on as many sheets of paper as they need.

    Args:
        drawings: each begins on a sheet of its own.
        paper: "a4", "a3" or "letter".

    Raises UsageError for another paper, or more than MAX_PAGES sheets.
    """
    sheets: list[Image.Image] = []
    for drawing in drawings:
        tiles = page_tiles(drawing, paper)
        if len(sheets) + len(tiles) > MAX_PAGES:
            raise UsageError(f"the template needs more than {MAX_PAGES} sheets", "Use a larger --paper.")
        for number, tile in enumerate(tiles, 1):
            sheets.append(_sheet(drawing, tile, paper, f"{number}/{len(tiles)}"))
    buffer = io.BytesIO()
    first, *rest = sheets
    first.save(
        buffer,
        format="PDF",
        save_all=True,
        append_images=rest,
        resolution=PRINT_DPI,
        quality=92,
        title="tagid",
    )
    return buffer.getvalue()


def page_tiles(drawing: Drawing, paper: str) -> list[tuple[float, float, float, float]]:
    """Parts (left, bottom, right, top), mm, of the drawing that fit on one sheet each, upper left first."""
    if paper not in PAPERS_MM:
        raise UsageError(f"there is no paper {paper!r}", f"Use {', '.join(PAPERS_MM)}.")
    width, height = (side - 2 * MARGIN_MM for side in PAPERS_MM[paper])
    tiles = []
    top = drawing.height
    while top > 1e-6:
        left = 0.0
        while left < drawing.width - 1e-6:
            tiles.append((left, top - height, left + width, top))
            left += width
        top -= height
    return tiles


def _sheet(drawing: Drawing, tile: tuple[float, float, float, float], paper: str, number: str) -> Image.Image:
    """One sheet of paper with a tile of the drawing inside the margins and the tile's corners marked."""
    scale = PRINT_DPI / MM_PER_INCH
    width, height = PAPERS_MM[paper]
    sheet = Image.new("L", (round(width * scale), round(height * scale)), 255)
    part = _raster(drawing, PRINT_DPI, tile)
    sheet.paste(part, (round(MARGIN_MM * scale), round(MARGIN_MM * scale)))
    pen = ImageDraw.Draw(sheet)
    for x in (MARGIN_MM, width - MARGIN_MM):
        for y in (MARGIN_MM, height - MARGIN_MM):
            px, py, arm = x * scale, y * scale, 4 * scale
            pen.line([(px - arm, py), (px + arm, py)], fill=150, width=2)
            pen.line([(px, py - arm), (px, py + arm)], fill=150, width=2)
    pen.text(
        (width * scale / 2, height * scale - MARGIN_MM * scale / 2),
        f"tagid template, sheet {number}: print at 100 %, join at the corner marks",
        fill=0,
        font=ImageFont.load_default(round(3 * scale)),
        anchor="mm",
    )
    return sheet


def _raster(drawing: Drawing, dpi: float, part: tuple[float, float, float, float]) -> Image.Image:
    """A part (left, bottom, right, top), mm, of the drawing as a grey raster."""
    scale = dpi / MM_PER_INCH
    left, bottom, right, top = part
    image = Image.new("L", (round((right - left) * scale), round((top - bottom) * scale)), 255)
    pen = ImageDraw.Draw(image)

    def px(at: tuple[float, float]) -> tuple[float, float]:
        return (at[0] - left) * scale, (top - at[1]) * scale

    for mark in drawing.marks:
        if isinstance(mark, Text):
            anchor = {"start": "lm", "middle": "mm", "end": "rm"}[mark.anchor]
            font = ImageFont.load_default(max(1, round(mark.size * scale)))
            pen.text(px(mark.at), mark.text, fill=0, font=font, anchor=anchor)
            continue
        width = max(1, round(mark.width * scale))
        if isinstance(mark, Line):
            for start, end in _dashes(mark) if mark.dashed else [(mark.start, mark.end)]:
                pen.line([px(start), px(end)], fill=0, width=width)
        else:
            (x, y), r = px(mark.centre), mark.radius * scale
            if mark.dashed:
                for angle in range(0, 360, 6):
                    pen.arc((x - r, y - r, x + r, y + r), angle, angle + 3.5, fill=0, width=width)
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
        end = min(at + 2.0, length)
        pieces.append(((x1 + ux * at, y1 + uy * at), (x1 + ux * end, y1 + uy * end)))
        at += 3.5
    return pieces
