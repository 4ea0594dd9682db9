"""`tagid motion stop`: stop a robot or table, regardless of what started it."""

from __future__ import annotations

import typer

from tagid.cli.common.frame import Terminal, command
from tagid.cli.motion.device import Url, driven
from tagid.result import Result


def register(group: typer.Typer) -> None:
    """Add the command."""

    @command(group, "motion stop")
    def stop(terminal: Terminal, url: Url = None) -> Result:
        """Stop a robot or table, even while another process drives it; a robot is left in Passive mode.

        Example: tagid motion stop roomba+ble://tagid-bridge
        """
        from rich.text import Text

        device = driven(url, stopping=True)
        device.halt_now()
        return Result("motion stop", {"stopped": True}, Text(f"{device.name} has stopped"))
