"""`tagid radar info`: versions, state and settings of a radar."""

from __future__ import annotations

from dataclasses import asdict

import typer

from tagid.cli.common import options
from tagid.cli.common.frame import Terminal, command
from tagid.cli.radar.device import open_configured
from tagid.config import load_config, radar_url
from tagid.result import Result


def register(group: typer.Typer) -> None:
    """Add the command."""

    @command(group, "radar info")
    def info(terminal: Terminal, radar: options.RadarUrl = None) -> Result:
        """Show versions, serial number, temperature, self-test and settings of the radar.

        Example: tagid radar info --radar udp://192.168.1.100
        """
        from tagid.radar.survey import survey
        from tagid.report.radar import info_table

        config = load_config({"radar.url": radar})
        found = survey(open_configured(config))
        data = {"url": radar_url(config), **asdict(found)}
        table = info_table(radar_url(config), found)
        return Result("radar info", data, table, messages=tuple(found.warnings()))
