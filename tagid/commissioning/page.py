"""The page of a commissioning: every row green or red, and the measured pulse as a drawing, in one file."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from tagid._version import __version__
from tagid.commissioning.rows import Level, Row, StepReport
from tagid.constants import SAMPLE_STEP_S
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


def write_page(
    path: Path, reports: Sequence[StepReport], titles: Sequence[str], profile: RigProfile | None
) -> None:
    """Write the page atomically.

    Args:
        path: the file.
        reports: of the steps done, in their order.
        titles: of the same steps.
        profile: the profile, if there is one already.

    Raises StorageError, DiskFullError.
    """
    parts = [_section(title, report) for title, report in zip(titles, reports, strict=True)]
    passed = all(report.passed for report in reports) and profile is not None
    head = "The rig is commissioned" if passed else "The rig is not commissioned yet"
    about = (
        "" if profile is None else f"<p>Rig of {html.escape(profile.day)}, radar {profile.radar.serial}.</p>"
    )
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
    """A sentence without the marks around commands and settings."""
    return html.escape(text.replace("`", ""))


def _pulse(samples: Sequence[float]) -> str:
    """The measured pulse over time and its spectrum, as a drawing."""
    wave = np.array(samples)
    time_ns = (np.arange(len(wave)) - len(wave) // 2) * SAMPLE_STEP_S * 1e9
    shown = (time_ns >= -2) & (time_ns <= 4)
    power = np.abs(np.fft.rfft(wave, 1024)) ** 2
    decibels = 10 * np.log10(np.maximum(power / power.max(), 1e-4))
    frequency = np.fft.rfftfreq(1024, SAMPLE_STEP_S) / 1e9
    band = (frequency >= 2.5) & (frequency <= 6)
    return (
        '<svg viewBox="0 0 900 240" role="img" aria-label="measured pulse and its spectrum">'
        + _curve(time_ns[shown], wave[shown], (50, 20, 400, 170), (-2.0, 4.0), (-1.0, 1.0), "ns", "pulse")
        + _curve(
            frequency[band],
            decibels[band],
            (500, 20, 380, 170),
            (2.5, 6.0),
            (-40.0, 0.0),
            "GHz",
            "spectrum, dB",
        )
        + "</svg>"
    )


def _curve(
    x: np.ndarray,
    y: np.ndarray,
    box: tuple[float, float, float, float],
    across: tuple[float, float],
    up: tuple[float, float],
    unit: str,
    title: str,
) -> str:
    left, top, width, height = box
    px = left + (x - across[0]) / (across[1] - across[0]) * width
    py = top + (up[1] - np.clip(y, *up)) / (up[1] - up[0]) * height
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(px, py, strict=True))
    marks = "".join(
        f'<text x="{left + (v - across[0]) / (across[1] - across[0]) * width:.0f}" '
        f'y="{top + height + 18:.0f}" '
        f'font-size="13" text-anchor="middle">{v:g}</text>'
        for v in range(math.ceil(across[0]), math.floor(across[1]) + 1)
    )
    levels = "".join(
        f'<text x="{left - 6:.0f}" y="{top + (up[1] - v) / (up[1] - up[0]) * height + 4:.0f}" font-size="13" '
        f'text-anchor="end">{v:g}</text>'
        for v in (up[0], (up[0] + up[1]) / 2, up[1])
    )
    return (
        f'<rect x="{left}" y="{top}" width="{width}" height="{height}" fill="none" stroke="#999"/>'
        f'<polyline points="{points}" fill="none" stroke="#1f5fa8" stroke-width="1.5"/>{marks}{levels}'
        f'<text x="{left + width / 2}" y="{top + height + 38}" font-size="13" text-anchor="middle">'
        f"{title} ({unit})</text>"
    )
