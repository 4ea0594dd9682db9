"""Technical drawings as a PDF at 1:1: vectors, whose text can be searched and copied."""

from __future__ import annotations

import io
from collections.abc import Sequence

from reportlab.lib.units import mm
from reportlab.pdfbase.pdfmetrics import stringWidth
from reportlab.pdfgen.canvas import Canvas

from tagid.errors import UsageError
from tagid.report.drafting import (
    DASH_MM,
    GAP_MM,
    HALO_MM,
    MARGIN_MM,
    Drawing,
    Line,
    Text,
    Tile,
    page_tiles,
)

MAX_PAGES = 500
_FONT = "Helvetica"
_MIDDLE = 0.35
"""Of a letter over its baseline, in units of the font's size."""


def to_pdf(drawings: Sequence[Drawing], paper: str) -> bytes:
    """The drawings at 1:1, each from a new sheet of paper on, on as many sheets as they need.

    Raises UsageError for an unknown paper, or more than MAX_PAGES sheets.
    """
    cut = [(drawing, *page_tiles(drawing, paper)) for drawing in drawings]
    if sum(len(tiles) for _, tiles, _ in cut) > MAX_PAGES:
        raise UsageError(f"the drawing needs more than {MAX_PAGES} sheets", "Use a larger `paper`.")
    buffer = io.BytesIO()
    pen = Canvas(buffer, pageCompression=0, invariant=1)
    pen.setTitle("tagid")
    for drawing, tiles, size in cut:
        for number, tile in enumerate(tiles, 1):
            joint = f", part {number} of {len(tiles)}: join at the corner marks" if len(tiles) > 1 else ""
            pen.setPageSize((size[0] * mm, size[1] * mm))
            pen.scale(mm, mm)
            _draw(pen, drawing, tile, size)
            _frame(pen, size, f"tagid: print at 100 %{joint}")
            pen.showPage()
    pen.save()
    return buffer.getvalue()


def _draw(pen: Canvas, drawing: Drawing, tile: Tile, size: tuple[float, float]) -> None:
    """The part of a drawing in a tile, its upper left corner at that of the margins."""
    left, bottom, right, top = tile
    pen.saveState()
    pen.translate(MARGIN_MM - left, size[1] - MARGIN_MM - top)
    inside = pen.beginPath()
    inside.rect(left, bottom, right - left, top - bottom)
    pen.clipPath(inside, stroke=0)
    for mark in drawing.marks:
        if isinstance(mark, Text):
            _text(pen, mark)
            continue
        pen.setLineWidth(mark.width)
        pen.setDash([DASH_MM, GAP_MM] if mark.dashed else [])
        if isinstance(mark, Line):
            pen.line(*mark.start, *mark.end)
        else:
            pen.circle(*mark.centre, mark.radius, stroke=1, fill=int(mark.filled))
    pen.restoreState()


def _text(pen: Canvas, mark: Text) -> None:
    """A text on white, so that the lines behind it do not make it illegible."""
    x, y = mark.at
    width = stringWidth(mark.text, _FONT, mark.size)
    x -= {"start": 0.0, "middle": width / 2, "end": width}[mark.anchor]
    halo = HALO_MM / 2
    pen.setFillGray(1)
    pen.rect(x - halo, y - mark.size / 2, width + 2 * halo, mark.size, stroke=0, fill=1)
    pen.setFillGray(0)
    pen.setFont(_FONT, mark.size)
    pen.drawString(x, y - _MIDDLE * mark.size, mark.text)


def _frame(pen: Canvas, size: tuple[float, float], words: str) -> None:
    """Marks at the corners of the margins, and a line below them."""
    width, height = size
    pen.setStrokeGray(0.6)
    pen.setLineWidth(0.2)
    for x in (MARGIN_MM, width - MARGIN_MM):
        for y in (MARGIN_MM, height - MARGIN_MM):
            pen.line(x - 4, y, x + 4, y)
            pen.line(x, y - 4, x, y + 4)
    pen.setFillGray(0)
    pen.setFont(_FONT, 3)
    pen.drawCentredString(width / 2, MARGIN_MM / 2 - 1, words)
