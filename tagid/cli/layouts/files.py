"""`tagid layouts export`, `import`, `undo` and `redo`: the registry in files, and undoing changes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli.common import enrolling
from tagid.cli.common.frame import Terminal, command
from tagid.cli.common.outputs import check_new
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.enrolling.layout_file import Entries
    from tagid.enrolling.registry import Registry, RegistryContents, Restored
    from tagid.tags.bodies.signature import Signature
    from tagid.tags.layouts.layout import Layout


def register(app: typer.Typer) -> None:
    """Add the commands."""

    @command(app, "layouts export")
    def export(
        terminal: Terminal,
        file: Annotated[Path, typer.Argument(help="TOML file to write.")],
        names: Annotated[
            list[str] | None, typer.Argument(help="Layouts, bodies or objects; default: all.")
        ] = None,
        force: Annotated[bool, typer.Option("--force", help="Overwrite an existing file.")] = False,
    ) -> Result:
        """Write enrolled layouts, bodies and objects to a TOML file.

        Example: tagid layouts export tags.toml
        """
        from rich.text import Text

        from tagid.enrolling.layout_file import write_layouts
        from tagid.files import resolved
        from tagid.operate.workplace import open_registry

        check_new(file, force)
        file = resolved(file)
        registry = open_registry()
        contents = registry.contents()
        signatures = [one for one in contents.signatures if not names or one.name in names]
        layouts = [one for one in contents.layouts if not names or one.name in names]
        for name in names or []:
            if name not in {layout.name for layout in layouts} | {one.name for one in signatures}:
                registry.get(name)  # raises an error that lists the existing names
        write_layouts(layouts, file, signatures)
        data = {
            "path": str(file),
            "layouts": [layout.name for layout in layouts],
            "signatures": [{"kind": one.kind, "name": one.name} for one in signatures],
        }
        line = f"{_count(layouts, signatures)} written to {file}"
        return Result("layouts export", data, Text(line))

    @command(app, "layouts import")
    def import_(
        terminal: Terminal,
        files: Annotated[
            list[Path], typer.Argument(help="TOML or JSON files, or other registries (.sqlite).")
        ],
        force: Annotated[
            bool, typer.Option("--force", help="Replace entries, and accept layouts that can be confused.")
        ] = False,
        yes: enrolling.Yes = False,
        dry_run: enrolling.DryRun = False,
    ) -> Result:
        """Enrol the layouts, bodies and objects of files: all of them, or none if one conflicts.

        The nearest other layout to each and the expected confusion rate are shown first; on a terminal,
        nothing is stored before you confirm.

        Example: tagid layouts import tags.toml
        """
        from rich.text import Text

        from tagid.errors import FileFormatError
        from tagid.operate.workplace import open_registry
        from tagid.tags.bodies.signature_file import to_bytes

        found: dict[str, Layout] = {}
        signatures: dict[tuple[str, str], Signature] = {}
        for file in files:
            entries = _entries_of(file)
            for one in entries.signatures:
                twin = signatures.setdefault((one.kind, one.name), one)
                if to_bytes(twin) != to_bytes(one):
                    raise FileFormatError(
                        f"{file}: the {one.kind} {one.name} differs from that of another file",
                        "Omit one of the files.",
                    )
            for layout in entries.layouts:
                known = found.setdefault(layout.name, layout)
                if known.to_dict() != layout.to_dict():
                    raise FileFormatError(
                        f"{file}: {layout.name} differs from the one in another file", "Rename one of them."
                    )
        source = f"file {', '.join(f.name for f in files)}"[:200]
        registry = open_registry()
        contents = registry.contents()
        before = contents.version
        if not force:
            _check_signatures(signatures, contents)
        stored = enrolling.store_family(
            terminal,
            registry,
            list(found.values()),
            source,
            enrolling.Wish(force, yes, dry_run),
            list(signatures.values()),
        )
        version = before if stored.version is None else stored.version
        read = _count(list(found.values()), list(signatures.values()))
        line = f"{read} read, {version - before} changes, registry version {version}"
        data = {
            "layouts": list(found),
            "signatures": [{"kind": kind, "name": name} for kind, name in signatures],
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
            int | None,
            typer.Option("--to", help="The version to restore; default: undo the last change."),
        ] = None,
    ) -> Result:
        """Undo the last command that changed the registry, or all changes since a version.

        Repeat it to undo earlier commands; `tagid layouts redo` reverts an undo.

        Example: tagid layouts undo
        Example: tagid layouts undo --to 4
        """
        return _restored("layouts undo", "undone", lambda registry: registry.undo(to))

    @command(app, "layouts redo")
    def redo(terminal: Terminal) -> Result:
        """Redo the last undone change.

        Example: tagid layouts redo
        """
        return _restored("layouts redo", "redone", lambda registry: registry.redo())


def _restored(name: str, verb: str, step: Callable[[Registry], Restored]) -> Result:
    """The registry after an undo or redo, with what changed."""
    from rich.text import Text

    from tagid.operate.workplace import open_registry

    registry = open_registry()
    done = step(registry)
    contents = registry.contents()
    parts = [
        f"{word} {', '.join(names)}"
        for word, names in (("removed", done.removed), ("added", done.added), ("restored", done.changed))
        if names
    ]
    lines = [
        f"{verb}: {done.undone}",
        f"  {'; '.join(parts) or 'no difference'}",
        f"{_count(contents.layouts, contents.signatures)} enrolled now, registry version {done.version}",
    ]
    data = {
        "registry_version": done.version,
        verb: done.undone,
        "added": list(done.added),
        "removed": list(done.removed),
        "restored": list(done.changed),
        "layouts": [layout.name for layout in contents.layouts],
        "signatures": [{"kind": one.kind, "name": one.name} for one in contents.signatures],
    }
    return Result(name, data, Text("\n".join(lines)))


def _count(layouts: Sequence[Layout], signatures: Sequence[Signature]) -> str:
    """The number of entries as text."""
    parts = [f"{len(layouts)} layouts"]
    for kind, plural in (("body", "bodies"), ("object", "objects")):
        number = sum(one.kind == kind for one in signatures)
        parts += [f"{number} {kind if number == 1 else plural}"] if number else []
    return ", ".join(parts)


def _check_signatures(new: dict[tuple[str, str], Signature], contents: RegistryContents) -> None:
    """Raise LayoutConflictError if another body or object has the name of a new one."""
    from tagid.errors import LayoutConflictError
    from tagid.tags.bodies.signature_file import to_bytes

    for one in contents.signatures:
        other = new.get((one.kind, one.name))
        if other is not None and to_bytes(other) != to_bytes(one):
            raise LayoutConflictError(
                f"a different {one.kind} named {one.name} is already enrolled",
                "Remove one of them, or import with --force; nothing was stored.",
            )


def _entries_of(file: Path) -> Entries:
    """Entries of a file or of another registry (opened read-only)."""
    from tagid.enrolling.layout_file import MAX_BYTES, Entries, read_entries
    from tagid.enrolling.registry import Registry
    from tagid.files import read_bytes

    if file.suffix.lower() in (".sqlite", ".db") and read_bytes(file, 16 * MAX_BYTES):
        contents = Registry(file).contents()
        return Entries(tuple(contents.layouts), tuple(contents.signatures))
    return read_entries(file)
