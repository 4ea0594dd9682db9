"""`tagid layouts`: the enrolled identities, and the group of commands about layouts.

One file per command; new commands are added to `COMMANDS` only.
"""

from __future__ import annotations

from typing import Annotated, Any

import typer

from tagid.cli.common.frame import Terminal, group_command
from tagid.cli.common.lazy import Entry, lazy_group
from tagid.result import Result

COMMANDS = {
    "design": Entry(
        "tagid.cli.layouts.design",
        "Design the layouts that a radar distinguishes best at any orientation of the object.",
    ),
    "capacity": Entry(
        "tagid.cli.layouts.design",
        "Compute how many identities an object can carry at a given error rate.",
    ),
    "reflector": Entry(
        "tagid.cli.layouts.reflector",
        "Create files for a reflector: a solid for a 3-D printer and foil, or a net to cut and fold at 1:1.",
    ),
    "show": Entry("tagid.cli.layouts.show", "Draw a layout."),
    "export": Entry("tagid.cli.layouts.files", "Write enrolled layouts, bodies and objects to a TOML file."),
    "import": Entry(
        "tagid.cli.layouts.files",
        "Enrol the layouts, bodies and objects of files: all of them, or none if one conflicts.",
    ),
    "undo": Entry(
        "tagid.cli.layouts.files",
        "Undo the last command that changed the registry, or all changes since a version.",
    ),
    "redo": Entry("tagid.cli.layouts.files", "Redo the last undone change."),
    "check": Entry("tagid.cli.layouts.check", "Check the registry: how far readings tell every pair apart."),
}
"""Every command of the group, in the order of the help, with the first sentence of its help text."""


def register(app: typer.Typer) -> None:
    """Add the group."""
    group = typer.Typer(cls=lazy_group(COMMANDS))
    app.add_typer(group, name="layouts")

    @group_command(group, "layouts")
    def layouts(
        terminal: Terminal,
        history: Annotated[bool, typer.Option("--history", help="List all changes.")] = False,
        remove: Annotated[str | None, typer.Option("--remove", help="Remove this layout or object.")] = None,
    ) -> Result:
        """List, design, draw, exchange and check layouts; without a command, list the enrolled ones.

        Example: tagid layouts --history
        """
        if remove:
            return _removed(remove)
        if history:
            return _history()
        return _list()


def _removed(name: str) -> Result:
    from rich.text import Text

    from tagid.operate.workplace import open_registry

    version = open_registry().remove(name, "tagid layouts --remove")
    line = Text(f"{name} removed; its history is kept (registry version {version})")
    return Result("layouts", {"removed": name, "registry_version": version}, line)


def _history() -> Result:
    from rich.table import Table

    from tagid.operate.workplace import open_registry

    registry = open_registry()
    table = Table(box=None)
    for heading in ("version", "command", "time (UTC)", "change", "kind"):
        table.add_column(heading, no_wrap=True)
    # Long names and sources continue on the next line, nothing is cut.
    table.add_column("name", overflow="fold")
    table.add_column("source", overflow="fold")
    rows: list[dict[str, Any]] = []
    for one in registry.history():
        time = one.time_utc[:19].replace("T", " ")
        table.add_row(str(one.version), str(one.command), time, one.action, one.kind, one.name, one.source)
        rows.append(
            {
                "version": one.version,
                "command": one.command,
                "time_utc": one.time_utc,
                "action": one.action,
                "kind": one.kind,
                "name": one.name,
                "source": one.source,
            }
        )
    return Result("layouts", {"registry_version": registry.version, "history": rows}, table)


def _list() -> Result:
    from rich.table import Table

    from tagid.operate.workplace import open_registry

    registry = open_registry()
    version, layouts = registry.snapshot()
    table = Table("layout", "kind", "reflectors", "radius mm", "symmetry", "label", box=None)
    for layout in layouts:
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
        "registry_version": version,
        "layouts": [layout.to_dict() for layout in layouts],
    }
    return Result("layouts", data, table)
