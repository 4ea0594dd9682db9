"""The page of a commissioning: every row green or red, and drawings of what was measured, in one file."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from tagid._version import __version__
from tagid.commissioning.page_content import heading, plain
from tagid.commissioning.pictures import Picture, to_svg
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


def write_page(path: Path, reports: Sequence[tuple[str, StepReport]], profile: RigProfile | None) -> None:
    """Write the page atomically.

    Args:
        path: the file; .pdf for a PDF of vectors, else HTML.
        reports: of the steps done, in their order, each after its title.
        profile: the profile, if there is one already.

    Raises StorageError, DiskFullError.
    """
    if path.suffix.lower() == ".pdf":
        from tagid.commissioning.page_pdf import to_pdf

        write_bytes(path, to_pdf(reports, profile))
        return
    parts = [_section(title, report) for title, report in reports]
    head, rig = heading(reports, profile)
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
        f'<p class="advice">{_text(row.advice)}</p>' if row.advice and row.level is not Level.PASS else ""
    )
    return (
        f'<tr class="{row.level}"><td class="level">{row.level}</td>'
        f'<th scope="row">{html.escape(row.name)}</th>'
        f'<td class="number">{html.escape(row.number.replace("+-", "±"))}</td>'
        f"<td>{_text(row.text)}{advice}</td></tr>"
    )


def _text(text: str) -> str:
    return html.escape(plain(text))


def _picture(picture: Picture) -> str:
    data = base64.b64encode(to_svg(picture).encode()).decode()
    return f'<img alt="{html.escape(picture.title)}" src="data:image/svg+xml;base64,{data}">'
