"""`tagid radar`: the group of commands for the radar itself.

One thin file a command; a new one is added to `PARTS` and nowhere else.
"""

from __future__ import annotations

import typer

from tagid.cli import (
    radar_calibrate,
    radar_config,
    radar_find,
    radar_info,
    radar_monitor,
    radar_reboot,
    radar_record,
)

PARTS = (radar_find, radar_info, radar_config, radar_monitor, radar_record, radar_calibrate, radar_reboot)
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
