"""`tagid radar`: the group of commands for the radar itself.

One thin file a command; a new one is added to `PARTS` and nowhere else.
"""

from __future__ import annotations

import typer

from tagid.cli.radar import calibrate, config, find, info, monitor, reboot, record

PARTS = (find, info, config, monitor, record, calibrate, reboot)
"""Modules with a `register(group)`, in the order of the help text."""


def register(app: typer.Typer) -> None:
    """Add the group."""
    group = typer.Typer(help="Find, ask, set and record the radar itself.", no_args_is_help=True)
    app.add_typer(group, name="radar")

    @group.callback()
    def _group() -> None:
        """Find, ask, set and record the radar itself."""

    for part in PARTS:
        part.register(group)
