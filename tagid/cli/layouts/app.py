"""`tagid layouts`: the enrolled identities, and the group of commands about layouts.

One file per command; new commands are added to `PARTS` only.
"""

from __future__ import annotations

from typing import Annotated, Any

import typer

from tagid.cli.common.frame import Terminal, group_command
from tagid.cli.layouts import check, design, files, reflector, show
from tagid.result import Result

PARTS = (design, reflector, show, files, check)
"""Modules with a `register(group)`, in the order of the help text."""


def register(app: typer.Typer) -> None:
    """Add the group."""
    group = typer.Typer()
    app.add_typer(group, name="layouts")

    @group_command(group, "layouts")
    def layouts(
        terminal: Terminal,
        history: Annotated[bool, typer.Option("--history", help="Every change ever made.")] = False,
        remove: Annotated[str | None, typer.Option("--remove", help="Remove this layout or object.")] = None,
    ) -> Result:
        """List, design, draw, exchange and check the layouts; without a command, list those enrolled.

        Example: tagid layouts --history
        """
        from rich.table import Table
        from rich.text import Text

        from tagid.cli.common.imaging import open_registry

        registry = open_registry()
        if remove:
            version = registry.remove(remove, "tagid layouts --remove")
            line = Text(f"{remove} removed; its history is kept (registry version {version})")
            return Result("layouts", {"removed": remove, "registry_version": version}, line)
        if history:
            changes = registry.history()
            table = Table("version", "time (UTC)", "change", "kind", "name", "source", box=None)
            for change in changes:
                table.add_row(
                    str(change.version),
                    change.time_utc,
                    change.action,
                    change.kind,
                    change.name,
                    change.source,
                )
            rows: list[dict[str, Any]] = [
                {
                    "version": c.version,
                    "time_utc": c.time_utc,
                    "action": c.action,
                    "kind": c.kind,
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

    for part in PARTS:
        part.register(group)
