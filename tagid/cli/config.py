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
        value: Annotated[str | None, typer.Argument(help="Its new value.")] = None,
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
            path = change_file(name, value)
            text = f"{name} = {value}" if value is not None else f"{name} reset to its default"
            return Result("config", {"path": str(path), name: value}, Text(f"{text} ({path})"))
        loaded = load_config()
        if action == "path":
            return Result("config", {"path": str(loaded.path)}, Text(str(loaded.path)))
        if action != "list":
            raise UsageError(f"unknown action {action!r}", "Use list, set, unset or path.")
        table = Table(box=None)
        # Names are to be copied, so they are never cut; long values continue on the next line.
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
