"""`tagid config`: settings and their sources."""

from __future__ import annotations

from typing import Annotated

import typer

from tagid.cli.common.frame import Terminal, command
from tagid.config import SETTINGS, change_file, load_config
from tagid.errors import UsageError
from tagid.result import Result


def register(app: typer.Typer) -> None:
    """Add the command."""

    @command(app, "config")
    def config(
        terminal: Terminal,
        action: Annotated[str, typer.Argument(help="list, set, unset or path.")] = "list",
        name: Annotated[str | None, typer.Argument(help="A setting, e.g. radar.url.")] = None,
        value: Annotated[str | None, typer.Argument(help="The new value.")] = None,
    ) -> Result:
        """Show or change the stored settings.

        Example: tagid config set radar.url udp://192.168.1.100
        """
        from rich.table import Table
        from rich.text import Text

        if action in ("set", "unset"):
            if name is None or (value is None) != (action == "unset"):
                raise UsageError(
                    f"tagid config {action} needs a setting" + (" and a value" * (action == "set")),
                    "e.g. `tagid config set motion.axis_distance_m 1.0`, `tagid config unset radar.url`.",
                )
            if value is not None:
                _check_url(name, value)
            path = change_file(name, value)
            text = f"{name} = {value}" if value is not None else f"{name} reset to its default"
            return Result("config", {"path": str(path), name: value}, Text(f"{text} ({path})"))
        loaded = load_config()
        if action == "path":
            return Result("config", {"path": str(loaded.path)}, Text(str(loaded.path)))
        if action != "list":
            raise UsageError(f"unknown action {action!r}", "Use list, set, unset or path.")
        table = Table(box=None)
        # Names are copied by the user, so they are never truncated; long values continue on the next line.
        table.add_column("setting", no_wrap=True)
        table.add_column("value", overflow="fold")
        table.add_column("from", no_wrap=True)
        table.add_column("meaning", overflow="fold", ratio=1)
        for setting in SETTINGS:
            entry = loaded.values[setting.name]
            shown = "-" if entry.value is None else str(entry.value)
            table.add_row(setting.name, shown, entry.source, setting.help)
        data = {
            "path": str(loaded.path),
            "settings": {
                key: {"value": entry.value, "source": entry.source} for key, entry in loaded.values.items()
            },
        }
        return Result("config", data, table)


def _check_url(name: str, value: str) -> None:
    """Raises UsageError, with the valid forms, for a device URL that no command could open."""
    from contextlib import suppress

    from tagid.errors import MissingExtraError
    from tagid.motion.urls import open_motion
    from tagid.radar.urls import parse_radar_url

    if name == "radar.url":
        parse_radar_url(value)
    elif name == "motion.url":
        # A package that a device needs may be installed later.
        with suppress(MissingExtraError):
            open_motion(value)
