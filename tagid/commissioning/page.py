"""The page of a commissioning: every row green or red, and the measured pulse as a drawing, in one file."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from tagid._version import __version__
from tagid.commissioning.page_content import Curve, curves_of, heading, plain
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
svg { max-width: 100%; height: auto; }
@media print {
  body { margin: 0; max-width: none; }
  h2 { break-after: avoid; }
  tr, svg { break-inside: avoid; }
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
        "content=\"default-src 'none'; style-src 'unsafe-inline'\">"
        f'<meta name="viewport" content="width=device-width"><title>{head}</title>'
        f"<style>{_STYLE}</style></head>"
        f"<body><h1>{head}</h1>{about}{''.join(parts)}<footer>tagid {__version__}</footer></body></html>\n"
    )
    write_bytes(path, page.encode())


def _section(title: str, report: StepReport) -> str:
    rows = "".join(_row(row) for row in report.rows)
    pulse = _pulse(report.pulse) if report.pulse else ""
    return (
        f"<h2>{html.escape(title)}</h2><p>{html.escape(report.date_utc)}</p>"
        f"<table><tbody>{rows}</tbody></table>{pulse}"
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


def _pulse(samples: Sequence[float]) -> str:
    """The measured pulse and its spectrum, as a drawing."""
    boxes = ((50.0, 20.0, 400.0, 170.0), (500.0, 20.0, 380.0, 170.0))
    drawn = [_curve(curve, box) for curve, box in zip(curves_of(samples), boxes, strict=True)]
    return (
        '<svg viewBox="0 0 900 240" role="img" aria-label="measured pulse and its spectrum">'
        f"{''.join(drawn)}</svg>"
    )


def _curve(curve: Curve, box: tuple[float, float, float, float]) -> str:
    left, top, width, height = box
    x, y = curve.within(width, height)
    points = " ".join(f"{left + a:.1f},{top + height - b:.1f}" for a, b in zip(x, y, strict=True))
    marks = "".join(
        f'<text x="{left + at:.0f}" y="{top + height + 18:.0f}" font-size="13" '
        f'text-anchor="middle">{words}</text>'
        for at, words in curve.across_marks(width)
    )
    levels = "".join(
        f'<text x="{left - 6:.0f}" y="{top + height - at + 4:.0f}" font-size="13" '
        f'text-anchor="end">{words}</text>'
        for at, words in curve.up_marks(height)
    )
    return (
        f'<rect x="{left}" y="{top}" width="{width}" height="{height}" fill="none" stroke="#999"/>'
        f'<polyline points="{points}" fill="none" stroke="#1f5fa8" stroke-width="1.5"/>{marks}{levels}'
        f'<text x="{left + width / 2}" y="{top + height + 38}" font-size="13" text-anchor="middle">'
        f"{curve.title}</text>"
    )
