"""Table of calibration results with their uncertainty budget."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from tagid.constants import SPEED_OF_LIGHT
from tagid.metadata import ReferenceFacts
from tagid.recording.calibration import DelayEstimate


def calibration_table(
    estimate: DelayEstimate | None, reference: ReferenceFacts | None, stored: str | None
) -> Table:
    """Delay in ps and as range correction, and noise of the empty scene."""
    table = Table(show_header=False, box=None)
    if estimate is not None:
        e = estimate
        table.add_row("delay", Text(f"{e.delay_ps:.0f} ps +- {e.sigma_ps:.0f} ps", style="bold green"))
        table.add_row(
            "", f"subtracts {_metres(e.delay_ps):.4f} m +- {_metres(e.sigma_ps):.4f} m from every range"
        )
        table.add_row("echo", f"at {e.echo_ps / 1e3:.3f} ns, {e.snr_db:.1f} dB above the rest")
        parts = f"tape {e.tape_ps:.0f}, noise {e.noise_ps:.1f}, pulse shape {e.shape_ps:.0f} ps"
        table.add_row("of which", parts)
    if reference is not None:
        table.add_row(
            "empty scene", f"{reference.scans} scans, noise {reference.noise_std:.1f} counts per sample"
        )
    table.add_row("stored in", stored or "not stored")
    return table


def _metres(time_ps: float) -> float:
    return time_ps * 1e-12 * SPEED_OF_LIGHT / 2
