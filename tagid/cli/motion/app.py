"""`tagid motion`: the commands for robots and turntables.

One file per command; a new command is added to `PARTS` only.
"""

from __future__ import annotations

import typer

from tagid.cli.motion import calibrate, find, info, spin, stop

PARTS = (find, info, spin, stop, calibrate)
"""Modules with a `register(group)`, in the order of the help text."""


def register(app: typer.Typer) -> None:
    """Add the group."""
    group = typer.Typer(
        help="Find, query, rotate, stop and calibrate robots and turntables.", no_args_is_help=True
    )
    app.add_typer(group, name="motion")

    @group.callback()
    def _group() -> None:
        """Find, query, rotate, stop and calibrate robots and turntables."""

    for part in PARTS:
        part.register(group)
