"""`tagid radar reboot`: restart a radar and wait until it responds."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from tagid.cli.common import options
from tagid.cli.common.frame import Terminal, command
from tagid.cli.radar.device import open_configured
from tagid.config import load_config, radar_url
from tagid.errors import UsageError
from tagid.result import Result


def register(group: typer.Typer) -> None:
    """Add the command."""

    @command(group, "radar reboot")
    def reboot(
        terminal: Terminal,
        radar: options.RadarUrl = None,
        wait: Annotated[float, typer.Option("--wait", help="Longest time to wait for a response, s.")] = 20.0,
    ) -> Result:
        """Restart the radar and wait until it responds (7 s on Ethernet, 11 s otherwise).

        Example: tagid radar reboot --radar udp://192.168.1.100
        """
        import time

        from rich.text import Text

        if not 1 <= wait <= 600:
            raise UsageError(f"--wait is {wait}", "Give 1 to 600 seconds.")
        config = load_config({"radar.url": radar})
        started = time.monotonic()
        with open_configured(config) as device, terminal.progress("reboot", wait):
            taken = device.reboot(wait)
        took = time.monotonic() - started
        url = radar_url(config)
        data = {"url": url, "seconds": round(took, 3), "config": asdict(taken)}
        return Result("radar reboot", data, Text(f"{url} responds again after {took:.1f} s"))
