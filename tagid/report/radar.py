"""Status, settings and calibration of a radar as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict

from rich.text import Text

from tagid.constants import RANGE_STEP_M, SPEED_OF_LIGHT
from tagid.metadata import ReferenceFacts
from tagid.radar.discovery import FoundRadar
from tagid.radar.settings import RadarConfig
from tagid.radar.survey import RadarSurvey
from tagid.recording.calibration import DelayEstimate
from tagid.report.table import Table

_ANTENNAS = {0: "A/A", 1: "B/B", 2: "transmit A, receive B", 3: "transmit B, receive A", 255: "default"}


def info_table(url: str, radar: RadarSurvey) -> Table:
    """Status and settings of one radar, one line each, units named."""
    status = radar.status
    rows = {
        "radar": f"{url}, serial {status.serial}" + (f", {status.package}" if status.package else ""),
        "versions": f"MRM {status.mrm_version}, kernel {status.kernel_version}, FPGA {status.fpga_version}"
        + (f", board {status.board_revision}" if status.board_revision else ""),
        "temperature": f"{status.temperature_c:.2f} degC",
        "self test": "passed" if not status.built_in_test else f"FAILED, code {status.built_in_test}",
    }
    if radar.uptime_s is not None:
        rows["up for"] = _duration(radar.uptime_s)
    if radar.config is not None:
        rows |= _settings_rows(radar.config)
    return Table(rows=[(name, Text(text)) for name, text in rows.items()])


def _settings_rows(config: RadarConfig) -> dict[str, str]:
    start, stop = config.range_start_m(), config.range_start_m() + config.samples * config.range_step_m
    return {
        "node": str(config.node_id),
        "window": f"{start:.3f} to {stop:.3f} m with cables, {config.samples} samples "
        f"({config.scan_start_ps} to {config.scan_stop_ps} ps)",
        "integration": f"index {config.base_integration_index}, {1 << config.base_integration_index} pulses",
        "scan rate": f"up to {1 / config.scan_period_s:.1f} scans per second",
        "gain": f"{config.transmit_gain} of 63, code channel {config.code_channel}",
        "antennas": _ANTENNAS.get(config.antenna_mode, str(config.antenna_mode)),
    }


def found_table(radars: Sequence[FoundRadar]) -> Table:
    table = Table("radar", "where", "serial", "MRM", "temperature", "self test")
    for radar in radars:
        s = radar.status
        if s is None:
            table.add_row(radar.url, radar.kind, Text("no answer", style="yellow"), "", "", "")
            continue
        test = Text("passed" if not s.built_in_test else f"FAILED ({s.built_in_test})")
        table.add_row(
            radar.url, radar.kind, str(s.serial), s.mrm_version, f"{s.temperature_c:.2f} degC", test
        )
    return table


def _duration(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if not hours:
        return f"{minutes} min {rest} s" if minutes else f"{seconds:.1f} s"
    return f"{hours} h {minutes} min {rest} s"


_MEANING = {
    "scan_start_ps": "first sample, two-way ps",
    "scan_stop_ps": "end of the window, two-way ps",
    "base_integration_index": "2^n pulses per sample",
    "transmit_gain": "0 to 63",
    "antenna_mode": "0 A/A, 1 B/B, 2 TxA-RxB, 3 TxB-RxA",
    "code_channel": "0 to 10, different for neighbouring radars",
    "node_id": "node id of the radar",
    "persist": "1: stored in flash",
}


def settings_table(
    before: RadarConfig, asked: Mapping[str, int], taken: RadarConfig, cable_delay_ps: float
) -> Table:
    """One line per setting; deviations from the request are marked, start and stop also in metres."""
    table = Table("setting", "before", "asked", "taken", "meaning")
    old, new = asdict(before), asdict(taken)
    for name, meaning in _MEANING.items():
        wanted = asked.get(name)
        took = Text(str(new[name]))
        if wanted is not None and wanted != new[name]:
            took.stylize("bold yellow")
            took.append(" !")
        elif old[name] != new[name]:
            took.stylize("bold green")
        table.add_row(name, str(old[name]), "" if wanted is None else str(wanted), took, meaning)
    for label, side in (("from", "scan_start_ps"), ("to", "scan_stop_ps")):
        wanted = asked.get(side)
        shown = "" if wanted is None else _metres(wanted, cable_delay_ps)
        table.add_row(
            f"window {label}",
            _metres(old[side], cable_delay_ps),
            shown,
            _metres(new[side], cable_delay_ps),
            f"metres without the {cable_delay_ps:g} ps of cable and antennas",
        )
    rate = f"{1 / before.scan_period_s:.1f}", "", f"{1 / taken.scan_period_s:.1f}"
    table.add_row("scans per second", *rate, "at most, from samples and integration")
    samples = str(before.samples), "", str(taken.samples)
    table.add_row("samples", *samples, f"per scan, {RANGE_STEP_M * 1e3:.2f} mm apart, a multiple of 96")
    clip = str(before.clip_counts), "", str(taken.clip_counts)
    table.add_row("clips at", *clip, "counts")
    return table


def _metres(time_ps: float, cable_delay_ps: float = 0.0, digits: int = 3) -> str:
    return f"{(time_ps - cable_delay_ps) * 1e-12 * SPEED_OF_LIGHT / 2:.{digits}f}"


def calibration_table(
    estimate: DelayEstimate | None,
    reference: ReferenceFacts | None,
    stored: str | None,
    previous_ps: float | None = None,
) -> Table:
    """Delay before, in ps, and measured, in ps and as range correction, and noise of the empty scene."""
    table = Table()
    if estimate is not None:
        e = estimate
        if previous_ps is not None:
            table.add_row("before", f"{previous_ps:.0f} ps")
        table.add_row("delay", Text(f"{e.delay_ps:.0f} ps +- {e.sigma_ps:.0f} ps", style="bold green"))
        table.add_row(
            "",
            f"subtracts {_metres(e.delay_ps, digits=4)} m +- {_metres(e.sigma_ps, digits=4)} m "
            "from every range",
        )
        table.add_row("echo", f"at {e.echo_ps / 1e3:.3f} ns, {e.snr_db:.1f} dB above the other echoes")
        parts = f"tape {e.tape_ps:.0f}, noise {e.noise_ps:.1f}, pulse shape {e.shape_ps:.0f} ps"
        table.add_row("of which", parts)
    if reference is not None:
        table.add_row(
            "empty scene", f"{reference.scans} scans, noise {reference.noise_std:.1f} counts per sample"
        )
    table.add_row("stored in", stored or "not stored")
    return table
