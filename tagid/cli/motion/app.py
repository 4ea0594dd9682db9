"""`tagid motion`: the group of commands for what turns the object.

One thin file a command; a new one is added to `PARTS` and nowhere else.
"""

from __future__ import annotations

import typer

from tagid.cli.motion import calibrate, find, info, spin, stop

PARTS = (find, info, spin, stop, calibrate)
"""Modules with a `register(group)`, in the order of the help text."""


def register(app: typer.Typer) -> None:
    """Add the group."""
    group = typer.Typer(help="Find, ask, turn and calibrate what turns the object.", no_args_is_help=True)
    app.add_typer(group, name="motion")

    @group.callback()
    def _group() -> None:
        """Find, ask, turn and calibrate what turns the object."""

    for part in PARTS:
        part.register(group)
