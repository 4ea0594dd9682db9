"""The page of a commissioning, HTML or PDF: rows in green and red, and drawings of what was measured."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from reportlab.lib.colors import HexColor
from reportlab.lib.enums import TA_LEFT
from reportlab.lib.pagesizes import A4
from reportlab.lib.styles import ParagraphStyle
from reportlab.lib.units import mm
from reportlab.platypus import KeepTogether, Paragraph, SimpleDocTemplate, Spacer, Table, TableStyle
from reportlab.platypus.flowables import Flowable

from tagid._version import __version__
from tagid.commissioning.pictures import Picture, drawing_of, to_svg
from tagid.commissioning.rows import Level, Row, StepReport
from tagid.files import write_bytes
from tagid.rig import RigProfile

_STYLE: Final = """
body { font: 15px/1.4 system-ui, sans-serif; margin: 2rem auto; max-width: 60rem; padding: 0 1rem;
  color: #1a1a1a; background: #fff; }
table { border-collapse: collapse; width: 100%; margin: .5rem 0 1.5rem; }
th, td { text-align: left; vertical-align: top; padding: .35rem .6rem; border-bottom: 1px solid #ddd; }
th { width: 14rem; font-weight: 600; }
td.level { width: 4rem; font-weight: 700; }
td.number { width: 13rem; white-space: nowrap; font-variant-numeric: tabular-nums; }
tr.pass td.level { background: #d9f2df; color: #0b5a22; }
tr.fail td.level { background: #fbdcdc; color: #8f1010; }
tr.note td.level { background: #eee; color: #444; }
p.advice { margin: .2rem 0 0; font-weight: 600; }
img { max-width: 48%; height: auto; }
@media print {
  body { margin: 0; max-width: none; }
  h2 { break-after: avoid; }
  tr, img { break-inside: avoid; }
}
"""
_TEXT: Final = ParagraphStyle("text", fontName="Helvetica", fontSize=8.5, leading=11, alignment=TA_LEFT)
_BOLD: Final = ParagraphStyle("bold", parent=_TEXT, fontName="Helvetica-Bold")
_STEP: Final = ParagraphStyle("step", parent=_BOLD, fontSize=12, leading=15, spaceBefore=8, spaceAfter=3)
_HEAD: Final = ParagraphStyle("head", parent=_BOLD, fontSize=16, leading=20, spaceAfter=2)
_BACKGROUND: Final = {Level.PASS: "#d9f2df", Level.NOTE: "#eeeeee", Level.FAIL: "#fbdcdc"}
_INK: Final = {Level.PASS: "#0b5a22", Level.NOTE: "#444444", Level.FAIL: "#8f1010"}
_COLUMNS_MM: Final = (14.0, 40.0, 40.0, 86.0)


def write_page(path: Path, reports: Sequence[tuple[str, StepReport]], profile: RigProfile | None) -> None:
    """Write the page atomically, a PDF of vectors or else HTML, by the path's suffix.

    It has the reports of the steps done, in their order, each after its title, and the profile, if there is
    one already. Raises StorageError, DiskFullError.
    """
    if path.suffix.lower() == ".pdf":
        write_bytes(path, to_pdf(reports, profile))
        return
    parts = [_section(title, report) for title, report in reports]
    head, rig = _heading(reports, profile)
    about = f"<p>{html.escape(rig)}</p>" if rig else ""
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta http-equiv="Content-Security-Policy" '
        "content=\"default-src 'none'; style-src 'unsafe-inline'; img-src data:\">"
        f'<meta name="viewport" content="width=device-width"><title>{head}</title>'
        f"<style>{_STYLE}</style></head>"
        f"<body><h1>{head}</h1>{about}{''.join(parts)}<footer>tagid {__version__}</footer></body></html>\n"
    )
    write_bytes(path, page.encode())


def _section(title: str, report: StepReport) -> str:
    rows = "".join(_row(row) for row in report.rows)
    pictures = "".join(_picture(picture) for picture in report.pictures)
    return (
        f"<h2>{html.escape(title)}</h2><p>{html.escape(report.date_utc)}</p>"
        f"<table><tbody>{rows}</tbody></table>{pictures}"
    )


def _row(row: Row) -> str:
    advice = (
        f'<p class="advice">{_escaped(row.advice)}</p>' if row.advice and row.level is not Level.PASS else ""
    )
    return (
        f'<tr class="{row.level}"><td class="level">{row.level}</td>'
        f'<th scope="row">{html.escape(row.name)}</th>'
        f'<td class="number">{html.escape(row.number.replace("+-", "±"))}</td>'
        f"<td>{_escaped(row.text)}{advice}</td></tr>"
    )


def _escaped(text: str) -> str:
    """A sentence without the marks around commands and settings."""
    return html.escape(text.replace("`", ""))


def _picture(picture: Picture) -> str:
    data = base64.b64encode(to_svg(picture).encode()).decode()
    return f'<img alt="{html.escape(picture.title)}" src="data:image/svg+xml;base64,{data}">'


def _heading(reports: Sequence[tuple[str, StepReport]], profile: RigProfile | None) -> tuple[str, str]:
    """(head line, sentence about the rig or nothing) of a page."""
    passed = all(report.passed for _, report in reports) and profile is not None
    head = "The rig is commissioned" if passed else "The rig is not commissioned yet"
    return head, "" if profile is None else f"Rig of {profile.day}, radar {profile.radar.serial}."


def to_pdf(reports: Sequence[tuple[str, StepReport]], profile: RigProfile | None) -> bytes:
    """The pages, A4; arguments as of `write_page`."""
    buffer = io.BytesIO()
    head, about = _heading(reports, profile)
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
        words = [Paragraph(_escaped(row.text), _TEXT)] if row.text else []
        if row.advice and row.level is not Level.PASS:
            words.append(Paragraph(_escaped(row.advice), _BOLD))
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
