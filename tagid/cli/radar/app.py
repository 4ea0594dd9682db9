"""`tagid radar`: the group of commands for the radar itself.

One file per command; a new command is added to `PARTS` only.
"""

from __future__ import annotations

import typer

from tagid.cli.radar import calibrate, config, find, info, monitor, reboot, record

PARTS = (find, info, config, monitor, record, calibrate, reboot)
"""Modules with a `register(group)`, in the order of the help text."""


def register(app: typer.Typer) -> None:
    """Add the group."""
    group = typer.Typer(
        help="Find, query, configure, monitor and calibrate the radar, and record scans.",
        no_args_is_help=True,
    )
    app.add_typer(group, name="radar")

    @group.callback()
    def _group() -> None:
        """Find, query, configure, monitor and calibrate the radar, and record scans."""

    for part in PARTS:
        part.register(group)
