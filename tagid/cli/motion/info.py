"""`tagid motion info`: what a robot or table reports; nothing moves."""

from __future__ import annotations

import typer

from tagid.cli.common.frame import Terminal, command
from tagid.cli.motion.device import Url, driven, facts_table
from tagid.result import Result


def register(group: typer.Typer) -> None:
    """Add the command."""

    @command(group, "motion info")
    def info(terminal: Terminal, url: Url = None) -> Result:
        """Show the state of a robot or table; nothing moves.

        Example: tagid motion info roomba+serial:///dev/ttyUSB1
        """
        device = driven(url)
        facts = device.describe()
        return Result("motion info", facts, facts_table(facts))
