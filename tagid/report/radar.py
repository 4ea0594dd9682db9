"""Radar status and settings as tables."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from tagid.radar.discovery import FoundRadar
from tagid.radar.settings import RadarConfig
from tagid.radar.survey import RadarSurvey

_ANTENNAS = {0: "A/A", 1: "B/B", 2: "transmit A, receive B", 3: "transmit B, receive A", 255: "default"}


def info_table(url: str, found: RadarSurvey) -> Table:
    """Status and settings of one radar, one line each, units named."""
    status = found.status
    rows = {
        "radar": f"{url}, serial {status.serial}" + (f", {status.package}" if status.package else ""),
        "versions": f"MRM {status.mrm_version}, kernel {status.kernel_version}, FPGA {status.fpga_version}"
        + (f", board {status.board_revision}" if status.board_revision else ""),
        "temperature": f"{status.temperature_c:.2f} degC",
        "self test": "passed" if not status.built_in_test else f"FAILED, code {status.built_in_test}",
    }
    if found.uptime_s is not None:
        rows["up for"] = _duration(found.uptime_s)
    if found.config is not None:
        rows |= _settings_rows(found.config)
    table = Table(show_header=False, box=None)
    for name, text in rows.items():
        table.add_row(name, Text(text))
    return table


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
    """Table of the radars found."""
    table = Table("radar", "where", "serial", "MRM", "temperature", "self test", box=None)
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
    return (
        f"{hours} h {minutes} min {rest} s"
        if hours
        else f"{minutes} min {rest} s"
        if minutes
        else f"{seconds:.1f} s"
    )
