"""A radar's previous, requested and actual settings side by side; the radar rounds to its own grid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

from rich.table import Table
from rich.text import Text

from tagid.constants import RANGE_STEP_M, SPEED_OF_LIGHT
from tagid.radar.settings import RadarConfig

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
    table = Table("setting", "before", "asked", "taken", "meaning", box=None)
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


def _metres(time_ps: int, cable_delay_ps: float) -> str:
    return f"{(time_ps - cable_delay_ps) * 1e-12 * SPEED_OF_LIGHT / 2:.3f}"
