"""The page of a commissioning as a PDF of vectors: rows in green and red, and drawings."""

from __future__ import annotations

import html
import io
from collections.abc import Sequence
from typing import Final

from reportlab.lib.colors import HexColor
from reportlab.lib.enums import TA_LEFT
from reportlab.lib.pagesizes import A4
from reportlab.lib.styles import ParagraphStyle
from reportlab.lib.units import mm
from reportlab.platypus import KeepTogether, Paragraph, SimpleDocTemplate, Spacer, Table, TableStyle
from reportlab.platypus.flowables import Flowable

from tagid._version import __version__
from tagid.commissioning.page_content import heading, plain
from tagid.commissioning.pictures import Picture, drawing_of
from tagid.commissioning.rows import Level, Row, StepReport
from tagid.rig import RigProfile

_TEXT: Final = ParagraphStyle("text", fontName="Helvetica", fontSize=8.5, leading=11, alignment=TA_LEFT)
_BOLD: Final = ParagraphStyle("bold", parent=_TEXT, fontName="Helvetica-Bold")
_STEP: Final = ParagraphStyle("step", parent=_BOLD, fontSize=12, leading=15, spaceBefore=8, spaceAfter=3)
_HEAD: Final = ParagraphStyle("head", parent=_BOLD, fontSize=16, leading=20, spaceAfter=2)
_BACKGROUND: Final = {Level.PASS: "#d9f2df", Level.NOTE: "#eeeeee", Level.FAIL: "#fbdcdc"}
_INK: Final = {Level.PASS: "#0b5a22", Level.NOTE: "#444444", Level.FAIL: "#8f1010"}
_COLUMNS_MM: Final = (14.0, 40.0, 40.0, 86.0)


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
        story += [_beside(report.pictures[at : at + 2]) for at in range(0, len(report.pictures), 2)]
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


def _beside(pictures: Sequence[Picture]) -> Table:
    """Two drawings beside each other."""
    drawn: list[object] = [drawing_of(picture) for picture in pictures]
    return Table([[*drawn, *[""] * (2 - len(drawn))]], colWidths=[90 * mm] * 2)
