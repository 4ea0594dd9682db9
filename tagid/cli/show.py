"""`tagid show`: picture and statistics of a recording."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.cli.outputs import check_drawing
from tagid.config import load_config
from tagid.constants import CAPTURE_SUFFIX
from tagid.counting import counted
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.capture import Capture
    from tagid.recording.inspection import RecordingSummary


@command("show")
def show(
    terminal: Terminal,
    file: options.CaptureFile,
    png: Annotated[
        Path | None, typer.Option(help="Picture (default: NAME.show.png next to the file).")
    ] = None,
    changing: Annotated[
        bool, typer.Option("--changing", help="Subtract the mean scan, to show only changes.")
    ] = False,
    cable_delay: options.CableDelay = None,
    node: options.Node = None,
    reflector: options.Reflector = None,
    body: options.Body = None,
    layout: Annotated[str, typer.Option(help="With --reflector: layout of the tag.")] = "container-90",
    layout_file: options.LayoutFile = None,
) -> Result:
    """Draw range profile, scans over time and spectrum of a recording, and print its statistics.

    With --reflector, the measured SNR is compared with that of `tagid plan`, and the likely cause of a
    difference is reported.

    Example: tagid show helmet.tagid.h5
    Example: tagid show helmet.tagid.h5 --reflector octahedron:40mm --layout helmet-120
    """
    from tagid.operate.words import ending_words
    from tagid.pipeline.prepared import LoadSettings, intake_remarks, load_capture
    from tagid.recording.inspection import inspect, thinned
    from tagid.report.charts import draw_recording
    from tagid.report.table import Table

    # NAME.png next to the capture is the image of `scan` and must be kept.
    target = png or file.with_name(file.name.removesuffix(CAPTURE_SUFFIX) + ".show.png")
    check_drawing("--png", target, (".png",), [file])
    config = load_config({"radar.cable_delay_ps": cable_delay})
    loading = LoadSettings.of(config, node=node)
    capture = load_capture(file, loading, turn=False)
    summary = inspect(capture)
    turns = summary.changes or capture.angles_rad is not None
    draw_recording(thinned(capture)[0], target, file.name, changing_only=changing, turning=turns)
    compared = None
    distance_m, noise, snr_db = capture.axis_distance_m, summary.noise, summary.snr_db
    if reflector is not None and distance_m is not None and noise is not None and snr_db is not None:
        from tagid.cli.plan import PlanOptions
        from tagid.planning.plan import gap

        radar = capture.radar.config
        index = None if radar is None else radar.base_integration_index
        planned = PlanOptions(reflector, body, distance_m, index, layout=layout, file=layout_file).setup()
        compared = gap(capture, noise, snr_db, planned)
    rows = _rows(summary)
    if why := ending_words(capture.radar.ended):
        rows.append(("ended", why))
    if compared is not None:
        levels = f"SNR {compared.measured_db:.1f} dB measured, {compared.planned_db:.1f} dB planned, {layout}"
        rows += [("plan", levels), *([("likely cause", compared.cause)] if compared.cause else [])]
    elif reflector is not None:
        rows.append(("plan", _not_compared(capture, summary)))
    strongest = summary.strongest
    data = {
        "file": str(file),
        "png": str(target),
        "views": summary.views,
        "bins": summary.bins,
        "range_m": [summary.range_from_m, summary.range_to_m],
        "strongest_over_noise_db": summary.strongest_over_noise_db,
        "snr_db": summary.snr_db,
        "changing_range_m": summary.changing_range_m,
        "clipped_fraction": summary.clipped_fraction,
        "lost_scans": summary.lost_scans,
        "scan_rate_hz": summary.scan_rate_hz,
        "period_s": summary.period_s,
        "period_sigma_s": summary.period_sigma_s,
        "period_note": summary.period_note,
        "strongest": None
        if strongest is None
        else {"bin": strongest.bin, "range_m": strongest.range_m, "spread_bins": strongest.spread_bins},
        "complete": capture.complete,
        "ended": None if capture.radar.ended is None else capture.radar.ended.to_json(),
        "plan": compared and asdict(compared),
    }
    messages = intake_remarks(capture) + loading.against_the_rig(capture)
    if summary.every > 1:
        messages += (f"SNR, period and picture are from every {summary.every}th scan",)
    return Result("show", data, [Table(rows=rows), f"picture {target}"], messages=messages)


def _not_compared(capture: Capture, summary: RecordingSummary) -> str:
    """Why measured and planned SNR are not compared, and what to do."""
    if capture.axis_distance_m is None:
        return "not compared: the recording states no axis distance; `tagid import --axis-distance` adds it"
    if summary.noise is None:
        return "not compared: the noise of so few scans is not known; record a full turn"
    return (
        "not compared: nothing rotates beyond the noise of one scan. If `tagid plan` expects more: does the "
        "table turn, do the antennas point at the object, are both cables connected?"
    )


def _rows(summary: RecordingSummary) -> list[tuple[str, str]]:
    def or_dash(value: float | None, form: str) -> str:
        return "-" if value is None else format(value, form)

    rate = or_dash(summary.scan_rate_hz, ".1f")
    clipped = "-" if summary.clipped_fraction is None else f"{summary.clipped_fraction:.2%}"
    count = counted(summary.views, "scan")
    per_second = "" if summary.scan_rate_hz is None else f", {rate} per second"
    rows = [
        ("scans", f"{count} of {summary.bins} samples{per_second}"),
        ("range", f"{summary.range_from_m:.2f} to {summary.range_to_m:.2f} m"),
    ]
    if summary.changes:
        snr = f"{summary.snr_db:.1f} dB at {or_dash(summary.changing_range_m, '.2f')} m"
        rows.append(("SNR", snr))
        period = summary.period_note
        if summary.period_s is not None:
            period = f"{summary.period_s:.3f} s +- {summary.period_sigma_s or 0:.3f} s {period}"
        rows.append(("period", period))
    else:
        rows.append(("SNR", "- nothing changes beyond the noise" if summary.views > 1 else "- (one scan)"))
    rows += [
        ("clipped", clipped),
        ("lost scans", "-" if summary.lost_scans is None else str(summary.lost_scans)),
    ]
    if summary.strongest:
        s = summary.strongest
        over = f"{or_dash(summary.strongest_over_noise_db, '.1f')} dB over noise at {s.range_m:.2f} m"
        rows.append(("strongest", f"{over} (bin {s.bin}, moves {s.spread_bins:.1f} bins)"))
    return rows
