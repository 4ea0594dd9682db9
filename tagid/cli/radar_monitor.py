"""`tagid radar monitor`: live display of the scans in the terminal."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.cli.radar import Interval, Seconds, open_configured
from tagid.config import Config, load_config, radar_url
from tagid.errors import UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

    from tagid.radar.p440 import P440
    from tagid.recording.monitoring import Monitor

_REFRESHES = 24
"""Target frame rate per second; drawing takes time, and 10 are required over a slow connection."""
_TEMPERATURE_EVERY_S = 2.0


@command("radar monitor")
def monitor(
    terminal: Terminal,
    radar: options.RadarUrl = None,
    changing: Annotated[
        bool, typer.Option("--changing", help="Subtract the running mean, to show only what changes.")
    ] = False,
    seconds: Seconds = None,
    interval_us: Interval = 0,
    cable_delay: options.CableDelay = None,
) -> Result:
    """Show range over time, strongest return, clipping, loss and temperature, at the radar's settings.

    Example: tagid radar monitor --radar udp://192.168.1.100
    """
    if seconds is not None and not 0 < seconds < 1e8:
        raise UsageError(f"--seconds is {seconds}", "Give a positive number of seconds.")
    config = load_config({"radar.url": radar, "radar.cable_delay_ps": cable_delay})
    radar_url(config)
    return _watch(terminal, config, changing, seconds, interval_us)


class _Screen:
    """Draws snapshots and counts how often."""

    def __init__(self, view: Monitor, title: str, console: Console) -> None:
        from tagid.report.preview import colour_wanted

        self._view, self._title, self._console = view, title, console
        self._colour = colour_wanted(console)
        self.frames = 0
        self.first_s = self.last_s = 0.0

    def __call__(self) -> RenderableType:
        from tagid.report.waterfall import draw

        self.last_s = time.monotonic()
        self.first_s = self.first_s or self.last_s
        self.frames += 1
        size = self._console.size
        return draw(self._view.snapshot(), self._title, (size.width, size.height), self._colour)

    @property
    def rate_hz(self) -> float | None:
        """Frames per second."""
        spent = self.last_s - self.first_s
        return (self.frames - 1) / spent if spent > 0 else None


def _watch(
    terminal: Terminal, config: Config, changing: bool, seconds: float | None, interval_us: int
) -> Result:
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    from tagid.recording.monitoring import Monitor

    console = Console(stderr=True, highlight=False)
    with open_configured(config) as device:
        view = Monitor(device.config, config["radar.cable_delay_ps"], changing)
        view.temperature_c = device.status().temperature_c
        screen = _Screen(view, f"tagid radar monitor {radar_url(config)}", console)
        try:
            if terminal.quiet or not console.is_terminal:
                _receive(device, view, seconds, interval_us)
            else:
                with Live(
                    console=console, screen=True, refresh_per_second=_REFRESHES, get_renderable=screen,
                    redirect_stdout=False, redirect_stderr=False,
                ):  # fmt: skip
                    _receive(device, view, seconds, interval_us)
        except KeyboardInterrupt:
            pass  # the usual end
    last = view.snapshot()
    data: dict[str, Any] = {
        "seconds": last.seconds,
        "scans": last.scans,
        "scan_rate_hz": last.scan_rate_hz,
        "snr_db": last.snr_db,
        "peak_m": last.peak_m,
        "clipped_fraction": last.clipped_fraction,
        "lost": last.lost,
        "lost_fraction": last.lost_fraction,
        "temperature_c": last.temperature_c,
        "frames": screen.frames,
        "frames_per_second": screen.rate_hz,
    }
    text = f"{last.scans} scans in {last.seconds:.1f} s, {last.lost} lost, {last.strongest}"
    return Result("radar monitor", data, Text(text))


def _receive(device: P440, view: Monitor, seconds: float | None, interval_us: int) -> None:
    from tagid.metadata import ScanGap
    from tagid.radar.resume import steady_scans

    def note(gap: ScanGap) -> None:
        view.note = f"the radar was disconnected for {gap.seconds:.1f} s: {gap.reason}"

    began = time.monotonic()
    ask_at = began + _TEMPERATURE_EVERY_S
    for scan in steady_scans(device, interval_us=interval_us, on_gap=note):
        view.add(scan, device.statistics)
        now = time.monotonic()
        if now >= ask_at:
            ask_at = now + _TEMPERATURE_EVERY_S
            device.ask_status()
        if device.latest_status is not None:
            view.temperature_c = device.latest_status.temperature_c
        if seconds is not None and now - began >= seconds:
            return
