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
        from tagid.radar.messages import OPMODE_MRM, SLEEP_ACTIVE
        from tagid.report.radar import info_table

        config = load_config({"radar.url": radar})
        url = radar_url(config)
        device = open_configured(config)
        try:
            # Only questions, and no connect, which stops a run: somebody may be recording.
            status, opmode, sleep = device.status(), device.get_opmode(), device.get_sleep_mode()
            taken, uptime_s = None, None
            if opmode == OPMODE_MRM:
                taken, uptime_s = device.get_config(), device.uptime_s()
        finally:
            device.close()
        data = {
            "url": url,
            "status": asdict(status),
            "config": asdict(taken) if taken else None,
            "opmode": opmode,
            "sleep_mode": sleep,
            "uptime_s": uptime_s,
        }
        notes = status.warnings()
        if taken is None:
            notes.append(
                f"the radar is in operating mode {opmode}, not MRM: any other command sets it to MRM"
            )
        if sleep != SLEEP_ACTIVE:
            notes.append(f"the radar sleeps (mode {sleep}): any other command wakes it")
        return Result("radar info", data, info_table(url, status, taken, uptime_s), messages=tuple(notes))
