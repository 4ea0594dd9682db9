"""`tagid layouts export`, `import` and `undo`: exchange layouts as files, and revert the registry."""

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
        names: Annotated[list[str] | None, typer.Argument(help="Names of layouts; default all.")] = None,
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
            bool, typer.Option("--force", help="Replace existing layouts, and accept confusable ones.")
        ] = False,
        yes: enrolling.Yes = False,
        dry_run: enrolling.DryRun = False,
    ) -> Result:
        """Enrol the layouts of files: all of them, or none if one conflicts.

        The nearest other layout to each and the expected confusion rate are shown first; on a terminal,
        nothing is stored before you confirm.

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
                        f"{file}: {layout.name} differs from the one in another file", "Rename one of them."
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
            int | None, typer.Option("--to", help="Version to go back to; default: undo the last change.")
        ] = None,
    ) -> Result:
        """Undo the registry's last change, or all since a version; a second undo redoes it.

        Example: tagid layouts undo --to 4
        """
        from rich.text import Text

        from tagid.cli.common.imaging import open_registry

        registry = open_registry()
        version = registry.go_back(to)
        names = [layout.name for layout in registry.layouts()]
        line = Text(f"{len(names)} layouts are enrolled now, registry version {version}")
        return Result("layouts undo", {"registry_version": version, "layouts": names}, line)


def _layouts_of(file: Path) -> list[Layout]:
    """Layouts of a file or of another registry, which is only read."""
    from tagid.files import read_bytes
    from tagid.tags.layouts.layout_file import MAX_BYTES, read_layouts
    from tagid.tags.layouts.registry import Registry

    if file.suffix.lower() in (".sqlite", ".db") and read_bytes(file, 16 * MAX_BYTES):
        return Registry(file).layouts()
    return read_layouts(file)
