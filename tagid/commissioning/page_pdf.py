"""The page of a commissioning as a PDF of vectors: rows in green and red, and drawings."""

from __future__ import annotations

import html
import io
from collections.abc import Sequence
from typing import Final

from reportlab.graphics.shapes import Drawing, PolyLine, Rect, String
from reportlab.lib.colors import HexColor
from reportlab.lib.enums import TA_LEFT
from reportlab.lib.pagesizes import A4
from reportlab.lib.styles import ParagraphStyle
from reportlab.lib.units import mm
from reportlab.platypus import KeepTogether, Paragraph, SimpleDocTemplate, Spacer, Table, TableStyle
from reportlab.platypus.flowables import Flowable

from tagid._version import __version__
from tagid.commissioning.page_content import Curve, curves_of, heading, plain
from tagid.commissioning.rows import Level, Row, StepReport
from tagid.rig import RigProfile

_TEXT: Final = ParagraphStyle("text", fontName="Helvetica", fontSize=8.5, leading=11, alignment=TA_LEFT)
_BOLD: Final = ParagraphStyle("bold", parent=_TEXT, fontName="Helvetica-Bold")
_STEP: Final = ParagraphStyle("step", parent=_BOLD, fontSize=12, leading=15, spaceBefore=8, spaceAfter=3)
_HEAD: Final = ParagraphStyle("head", parent=_BOLD, fontSize=16, leading=20, spaceAfter=2)
_BACKGROUND: Final = {Level.PASS: "#d9f2df", Level.NOTE: "#eeeeee", Level.FAIL: "#fbdcdc"}
_INK: Final = {Level.PASS: "#0b5a22", Level.NOTE: "#444444", Level.FAIL: "#8f1010"}
_COLUMNS_MM: Final = (14.0, 40.0, 40.0, 86.0)
_BOX_MM: Final = (78.0, 40.0)
_INSET_MM: Final = (9.0, 9.0)


def to_pdf(reports: Sequence[tuple[str, StepReport]], profile: RigProfile | None) -> bytes:
    """The pages, A4; arguments as of `tagid.commissioning.page.write_page`."""
    buffer = io.BytesIO()
    head, about = heading(reports, profile)
    document = SimpleDocTemplate(
        buffer, pagesize=A4, leftMargin=15 * mm, rightMargin=15 * mm, topMargin=14 * mm, bottomMargin=14 * mm,
        title=head, author="tagid", creator=f"tagid {__version__}", pageCompression=0, invariant=1,
    )  # fmt: skip
    story: list[Flowable] = [Paragraph(head, _HEAD)]
    if about:
        story.append(Paragraph(html.escape(about), _TEXT))
    for title, report in reports:
        step = [
            Paragraph(html.escape(title), _STEP),
            Paragraph(html.escape(report.date_utc), _TEXT),
            Spacer(1, 2),
        ]
        story.append(KeepTogether([*step, _table(report.rows)]))
        if report.pulse:
            story += [Spacer(1, 4), _pictures(curves_of(report.pulse))]
    document.build(story)
    return buffer.getvalue()


def _table(rows: Sequence[Row]) -> Table:
    """One line a row, with the colour of its verdict."""
    lines, colours = [], []
    for number, row in enumerate(rows):
        verdict = ParagraphStyle("verdict", parent=_BOLD, textColor=HexColor(_INK[row.level]))
        words = [Paragraph(html.escape(plain(row.text)), _TEXT)] if row.text else []
        if row.advice and row.level is not Level.PASS:
            words.append(Paragraph(html.escape(plain(row.advice)), _BOLD))
        lines.append(
            [
                Paragraph(row.level.value, verdict),
                Paragraph(html.escape(row.name), _BOLD),
                Paragraph(html.escape(row.number.replace("+-", "±")), _TEXT),
                words,
            ]
        )
        colours.append(("BACKGROUND", (0, number), (0, number), HexColor(_BACKGROUND[row.level])))
    table = Table(lines, colWidths=[width * mm for width in _COLUMNS_MM])
    rules = [
        ("LINEBELOW", (0, 0), (-1, -1), 0.4, HexColor("#dddddd")),
        ("VALIGN", (0, 0), (-1, -1), "TOP"),
        ("TOPPADDING", (0, 0), (-1, -1), 2),
        ("BOTTOMPADDING", (0, 0), (-1, -1), 3),
    ]
    table.setStyle(TableStyle([*rules, *colours]))
    return table


def _pictures(curves: Sequence[Curve]) -> Table:
    """Drawings beside each other."""
    return Table([[_drawing(curve) for curve in curves]])


def _drawing(curve: Curve) -> Drawing:
    width, height = (side * mm for side in _BOX_MM)
    left, bottom = (inset * mm for inset in _INSET_MM)
    drawing = Drawing(left + width + 2 * mm, bottom + height + 3 * mm)
    drawing.add(
        Rect(left, bottom, width, height, fillColor=None, strokeColor=HexColor("#999999"), strokeWidth=0.5)
    )
    x, y = curve.within(width, height)
    points = [value for pair in zip(left + x, bottom + y, strict=True) for value in pair]
    drawing.add(PolyLine(points, strokeColor=HexColor("#1f5fa8"), strokeWidth=0.8))
    for at, words in curve.across_marks(width):
        drawing.add(String(left + at, bottom - 3.5 * mm, words, fontSize=7, textAnchor="middle"))
    for at, words in curve.up_marks(height):
        drawing.add(String(left - 1 * mm, bottom + at - 2, words, fontSize=7, textAnchor="end"))
    drawing.add(String(left + width / 2, 0, curve.title, fontSize=7.5, textAnchor="middle"))
    return drawing
