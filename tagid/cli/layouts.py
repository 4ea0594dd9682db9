"""`tagid layouts`: the enrolled identities."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from tagid.cli.frame import Terminal, command
from tagid.result import Result


def register(app: typer.Typer) -> None:
    """Add the command."""

    @command(app, "layouts")
    def layouts(
        terminal: Terminal,
        history: Annotated[bool, typer.Option("--history", help="Every change ever made.")] = False,
        remove: Annotated[str | None, typer.Option("--remove", help="Take this layout out.")] = None,
    ) -> Result:
        """List the enrolled layouts, their history, or take one out.

        Example: tagid layouts --history
        """
        from rich.table import Table
        from rich.text import Text

        from tagid.cli.imaging import open_registry

        registry = open_registry()
        if remove:
            version = registry.remove(remove, "tagid layouts --remove")
            line = Text(f"{remove} removed; its history stays (registry version {version})")
            return Result("layouts", {"removed": remove, "registry_version": version}, line)
        if history:
            changes = registry.history()
            table = Table("version", "time (UTC)", "change", "layout", "source", box=None)
            for change in changes:
                table.add_row(str(change.version), change.time_utc, change.action, change.name, change.source)
            rows: list[dict[str, Any]] = [
                {
                    "version": c.version,
                    "time_utc": c.time_utc,
                    "action": c.action,
                    "name": c.name,
                    "source": c.source,
                }
                for c in changes
            ]
            return Result("layouts", {"registry_version": registry.version, "history": rows}, table)
        enrolled = registry.layouts()
        table = Table("layout", "kind", "reflectors", "radius mm", "symmetry", "label", box=None)
        for layout in enrolled:
            table.add_row(
                layout.name,
                layout.kind,
                str(layout.size),
                f"{layout.radius_m * 1e3:.0f}",
                str(layout.symmetry),
                layout.label,
            )
        data = {
            "registry": str(registry.path),
            "registry_version": registry.version,
            "layouts": [layout.to_dict() for layout in enrolled],
        }
        return Result("layouts", data, table)
