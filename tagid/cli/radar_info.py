"""`tagid radar info`: what a radar says of itself."""

from __future__ import annotations

from dataclasses import asdict

import typer

from tagid.cli import options
from tagid.cli.frame import Terminal, command
from tagid.cli.radar_device import open_configured, radar_url
from tagid.config import load_config
from tagid.result import Result


def register(group: typer.Typer) -> None:
    """Add the command."""

    @command(group, "radar info")
    def info(terminal: Terminal, radar: options.RadarUrl = None) -> Result:
        """Show versions, serial number, temperature, self test and settings of the radar.

        Example: tagid radar info --radar udp://192.168.1.100
        """
        from tagid.report.radar import info_table

        config = load_config({"radar.url": radar})
        with open_configured(config) as device:
            status, taken, opmode = device.status(), device.config, device.get_opmode()
            sleep, uptime_s = device.get_sleep_mode(), device.uptime_s()
        url = radar_url(config)
        data = {
            "url": url,
            "status": asdict(status),
            "config": asdict(taken),
            "opmode": opmode,
            "sleep_mode": sleep,
            "uptime_s": uptime_s,
        }
        notes = tuple(status.warnings())
        return Result("radar info", data, info_table(url, status, taken, uptime_s), messages=notes)
