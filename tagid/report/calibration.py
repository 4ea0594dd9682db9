"""What a calibration found, with where its uncertainty comes from."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from tagid.constants import SPEED_OF_LIGHT
from tagid.metadata import ReferenceFacts
from tagid.recording.calibration import DelayEstimate


def calibration_table(
    estimate: DelayEstimate | None, reference: ReferenceFacts | None, stored: str | None
) -> Table:
    """The delay in ps and as the range that it takes off, and the empty scene's noise."""
    table = Table(show_header=False, box=None)
    if estimate is not None:
        e = estimate
        table.add_row("delay", Text(f"{e.delay_ps:.0f} ps +- {e.sigma_ps:.0f} ps", style="bold green"))
        table.add_row("", f"takes {_metres(e.delay_ps):.4f} m +- {_metres(e.sigma_ps):.4f} m off every range")
        table.add_row("echo", f"at {e.echo_ps / 1e3:.3f} ns, {e.snr_db:.1f} dB over the rest")
        parts = f"tape {e.tape_ps:.0f}, noise {e.noise_ps:.1f}, shape of the pulse {e.shape_ps:.0f} ps"
        table.add_row("of which", parts)
    if reference is not None:
        table.add_row(
            "empty scene", f"{reference.scans} scans, noise {reference.noise_std:.1f} counts per sample"
        )
    table.add_row("kept in", stored or "nothing was kept")
    return table


def _metres(time_ps: float) -> float:
    return time_ps * 1e-12 * SPEED_OF_LIGHT / 2
