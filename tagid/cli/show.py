"""`tagid show`: what a recording holds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli.common import options
from tagid.cli.common.frame import Terminal, command
from tagid.config import load_config
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.recording.inspection import RecordingSummary


def register(app: typer.Typer) -> None:
    """Add the command."""

    @command(app, "show")
    def show(
        terminal: Terminal,
        file: options.CaptureFile,
        png: Annotated[Path | None, typer.Option("--png", help="Picture (default: beside the file).")] = None,
        changing: Annotated[bool, typer.Option("--changing", help="Draw only what changes.")] = False,
        cable_delay: options.CableDelay = None,
        node: options.Node = None,
    ) -> Result:
        """Draw range profile, sinogram and spectrum of a recording, with a short table.

        Example: tagid show helmet.tagid.h5
        """
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        from tagid.pipeline.load import LoadSettings, load_capture
        from tagid.recording.inspection import inspect
        from tagid.report.charts import draw_recording
        from tagid.storage.importers import remarks

        config = load_config({"radar.cable_delay_ps": cable_delay})
        capture = load_capture(file, LoadSettings.of(config, node=node), turn=False)
        summary = inspect(capture)
        target = png or file.with_name(file.name.removesuffix(".tagid.h5") + ".png")
        draw_recording(capture, target, file.name, changing_only=changing)
        table = Table(show_header=False, box=None)
        for name, text in _rows(summary):
            table.add_row(name, text)
        strongest = summary.strongest
        data = {
            "file": str(file),
            "png": str(target),
            "views": summary.views,
            "bins": summary.bins,
            "range_m": [summary.range_from_m, summary.range_to_m],
            "snr_db": summary.snr_db,
            "changing_snr_db": summary.changing_snr_db,
            "changing_range_m": summary.changing_range_m,
            "clipped_fraction": summary.clipped_fraction,
            "lost_scans": summary.lost_scans,
            "scan_rate_hz": summary.scan_rate_hz,
            "period_s": summary.period_s,
            "period_sigma_s": summary.period_sigma_s,
            "period_note": summary.period_note,
            "strongest": None
            if strongest is None
            else {
                "bin": strongest.bin,
                "range_m": strongest.range_m,
                "spread_bins": strongest.spread_bins,
            },
            "complete": capture.complete,
        }
        return Result("show", data, Group(table, Text(f"picture {target}")), messages=remarks(capture))


def _rows(summary: RecordingSummary) -> list[tuple[str, str]]:
    def or_dash(value: float | None, form: str) -> str:
        return "-" if value is None else format(value, form)

    rate = or_dash(summary.scan_rate_hz, ".1f")
    period = summary.period_note
    if summary.period_s is not None:
        period = f"{summary.period_s:.3f} s +- {summary.period_sigma_s or 0:.3f} s {period}"
    clipped = "-" if summary.clipped_fraction is None else f"{summary.clipped_fraction:.2%}"
    rows = [
        ("scans", f"{summary.views} of {summary.bins} samples, {rate} a second"),
        ("range", f"{summary.range_from_m:.2f} to {summary.range_to_m:.2f} m"),
        ("SNR", f"{or_dash(summary.snr_db, '.1f')} dB"),
        (
            "turning",
            f"{or_dash(summary.changing_snr_db, '.1f')} dB at {or_dash(summary.changing_range_m, '.2f')} m",
        ),
        ("clipped", clipped),
        ("lost scans", "-" if summary.lost_scans is None else str(summary.lost_scans)),
        ("period", period),
    ]
    if summary.strongest:
        s = summary.strongest
        rows.append(("strongest", f"{s.range_m:.2f} m (bin {s.bin}, moves {s.spread_bins:.1f} bins)"))
    return rows
