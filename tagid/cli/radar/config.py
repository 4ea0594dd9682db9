"""`tagid radar config`: show the radar's settings and change individual ones."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid.cli.common import options
from tagid.cli.common.frame import Terminal, command
from tagid.cli.radar.device import open_configured
from tagid.config import load_config, radar_url
from tagid.errors import ConfigError, UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.radar.settings import RadarConfig

_LONGEST_M = 3e5
"""The range limit of a signed 32-bit number of picoseconds."""


def register(group: typer.Typer) -> None:
    """Add the command."""

    @command(group, "radar config")
    def config(
        terminal: Terminal,
        radar: options.RadarUrl = None,
        start: Annotated[
            float | None,
            typer.Option(
                "--start", min=-10000, max=10000, help="Start of the window, metres from the antennas."
            ),
        ] = None,
        stop: Annotated[
            float | None,
            typer.Option(
                "--stop", min=-10000, max=10000, help="End of the window, metres from the antennas."
            ),
        ] = None,
        start_ps: Annotated[
            int | None,
            typer.Option(
                "--start-ps",
                min=-2147483648,
                max=2147483647,
                help="The same in two-way picoseconds, including cables.",
            ),
        ] = None,
        stop_ps: Annotated[
            int | None, typer.Option("--stop-ps", min=-2147483648, max=2147483647, help="The same.")
        ] = None,
        integration: Annotated[
            int | None,
            typer.Option(
                "--integration",
                "--pii",
                min=-1000,
                max=1000,
                help="Integration index, 6 to 15: 2^n pulses per sample.",
            ),
        ] = None,
        gain: Annotated[
            int | None, typer.Option("--gain", min=-1000, max=1000, help="Transmit gain, 0 to 63.")
        ] = None,
        antenna_mode: Annotated[
            int | None,
            typer.Option("--antenna-mode", min=-1000, max=1000, help="0 A/A, 1 B/B, 2 TxA-RxB, 3 TxB-RxA."),
        ] = None,
        code_channel: Annotated[
            int | None, typer.Option("--code-channel", min=-1000, max=1000, help="0 to 10.")
        ] = None,
        node_id: Annotated[
            int | None, typer.Option("--node-id", min=0, max=4294967295, help="Node id of the radar.")
        ] = None,
        save: Annotated[
            bool, typer.Option("--save", help="Store the settings in the radar's flash.")
        ] = False,
        cable_delay: options.CableDelay = None,
    ) -> Result:
        """Show the radar's settings; change those given, and show the resulting values.

        Example: tagid radar config --start 0.5 --stop 2.5 --pii 11
        """
        settings = load_config({"radar.url": radar, "radar.cable_delay_ps": cable_delay})
        delay = float(settings["radar.cable_delay_ps"])
        wanted = {
            "scan_start_ps": _edge("start", start, start_ps, delay),
            "scan_stop_ps": _edge("stop", stop, stop_ps, delay),
            "base_integration_index": integration,
            "transmit_gain": gain,
            "antenna_mode": antenna_mode,
            "code_channel": code_channel,
            "node_id": node_id,
        }
        asked = {name: value for name, value in wanted.items() if value is not None}
        radar_url(settings)
        with open_configured(settings) as device:
            before = device.config
            taken = before
            if asked or save:
                # The settings read back may contain the flag of an earlier save; write flash only on request.
                taken = device.set_config(replace(before, **asked, persist=int(save)))
        return _result(before, asked, taken, delay)


def _edge(name: str, metres: float | None, picoseconds: int | None, delay_ps: float) -> int | None:
    """An end of the window in two-way picoseconds, cable delay included."""
    if metres is None:
        return picoseconds
    if picoseconds is not None:
        raise UsageError(f"--{name} and --{name}-ps set the same value", "Give one of them.")
    if not (math.isfinite(metres) and abs(metres) <= _LONGEST_M):
        raise ConfigError(f"--{name} is {metres} m", "Give metres from the antennas.")
    from tagid.constants import SPEED_OF_LIGHT

    return round(2e12 * metres / SPEED_OF_LIGHT + delay_ps)


def _result(before: RadarConfig, asked: dict[str, int], taken: RadarConfig, delay_ps: float) -> Result:
    from tagid.report.radar_settings import settings_table

    got = asdict(taken)
    other = {name: value for name, value in asked.items() if got[name] != value}
    grid = [name for name in other if name in ("scan_start_ps", "scan_stop_ps")]
    notes = []
    if grid:
        notes.append(
            "the window was aligned to the radar's grid (1.9 ps, samples in multiples of 96); the requested "
            f"window is {'inside' if _holds(asked, taken) else 'NOT inside'}"
        )
    notes += [f"the radar set {n} to {got[n]} instead of {v}" for n, v in other.items() if n not in grid]
    end = taken.range_start_m(delay_ps) + taken.samples * taken.range_step_m
    data: dict[str, Any] = {
        "before": asdict(before),
        "asked": asked,
        "taken": got,
        "window_m": [taken.range_start_m(delay_ps), end],
        "cable_delay_ps": delay_ps,
        "samples": taken.samples,
        "scan_period_s": taken.scan_period_s,
        "clip_counts": taken.clip_counts,
    }
    table = settings_table(before, asked, taken, delay_ps)
    return Result("radar config", data, table, messages=tuple(notes))


def _holds(asked: dict[str, int], taken: RadarConfig) -> bool:
    """Whether the actual window covers the requested one, to within the grid of 2 ps."""
    start = asked.get("scan_start_ps", taken.scan_start_ps)
    stop = asked.get("scan_stop_ps", taken.scan_stop_ps)
    return taken.scan_start_ps <= start and stop <= taken.scan_stop_ps + 4
