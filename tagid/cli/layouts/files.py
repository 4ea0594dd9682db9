"""`tagid layouts export`, `import` and `undo`: layouts in files, and the registry's way back."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli.common import enrolling
from tagid.cli.common.frame import Terminal, command
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.tags.layouts.layout import Layout


def register(app: typer.Typer) -> None:
    """Add the commands."""

    @command(app, "layouts export")
    def export(
        terminal: Terminal,
        file: Annotated[Path, typer.Argument(help="TOML file to write.")],
        names: Annotated[list[str] | None, typer.Argument(help="Layouts; all where none is named.")] = None,
    ) -> Result:
        """Write enrolled layouts to a TOML file.

        Example: tagid layouts export tags.toml
        """
        from rich.text import Text

        from tagid.cli.common.imaging import open_registry
        from tagid.tags.layouts.layout_file import write_layouts

        registry = open_registry()
        chosen = [registry.get(name) for name in names] if names else registry.layouts()
        write_layouts(chosen, file)
        data = {"path": str(file), "layouts": [layout.name for layout in chosen]}
        return Result("layouts export", data, Text(f"{len(chosen)} layouts written to {file}"))

    @command(app, "layouts import")
    def import_(
        terminal: Terminal,
        files: Annotated[
            list[Path], typer.Argument(help="TOML or JSON files, or other registries (.sqlite).")
        ],
        force: Annotated[
            bool, typer.Option("--force", help="Replace layouts, and accept some that can be confused.")
        ] = False,
        yes: enrolling.Yes = False,
        dry_run: enrolling.DryRun = False,
    ) -> Result:
        """Enrol the layouts of files: all of them, or none where one is in conflict.

        The nearest other layout of each and the expected rate of confusion are shown first; at a terminal you
        are asked before anything is stored.

        Example: tagid layouts import tags.toml
        """
        from rich.text import Text

        from tagid.cli.common.imaging import open_registry
        from tagid.errors import FileFormatError

        found: dict[str, Layout] = {}
        for file in files:
            for layout in _layouts_of(file):
                known = found.setdefault(layout.name, layout)
                if known.to_dict() != layout.to_dict():
                    raise FileFormatError(
                        f"{file}: {layout.name} differs from that of another file", "Rename one of them."
                    )
        source = f"file {', '.join(f.name for f in files)}"[:200]
        registry = open_registry()
        before = registry.version
        stored = enrolling.store_family(
            terminal, registry, list(found.values()), source, enrolling.Wish(force, yes, dry_run)
        )
        version = before if stored.version is None else stored.version
        line = f"{len(found)} layouts read, {version - before} changes, registry version {version}"
        data = {
            "layouts": list(found),
            "changes": version - before,
            "registry_version": version,
            "stored": stored.version is not None,
            **stored.data,
        }
        return stored.result("layouts import", data, [Text(line)])

    @command(app, "layouts undo")
    def undo(
        terminal: Terminal,
        to: Annotated[
            int | None, typer.Option("--to", help="Back to this version; the last change is undone without.")
        ] = None,
    ) -> Result:
        """Take the last change of the registry back, or all since a version; again brings it back.

        Example: tagid layouts undo --to 4
        """
        from rich.text import Text

        from tagid.cli.common.imaging import open_registry

        registry = open_registry()
        version = registry.go_back(to)
        names = [layout.name for layout in registry.layouts()]
        line = Text(f"{len(names)} layouts are enrolled again, registry version {version}")
        return Result("layouts undo", {"registry_version": version, "layouts": names}, line)


def _layouts_of(file: Path) -> list[Layout]:
    """Layouts of a file or of another registry, which is only read."""
    from tagid.files import read_bytes
    from tagid.tags.layouts.layout_file import MAX_BYTES, read_layouts
    from tagid.tags.layouts.registry import Registry

    if file.suffix.lower() in (".sqlite", ".db") and read_bytes(file, 16 * MAX_BYTES):
        return Registry(file).layouts()
    return read_layouts(file)
