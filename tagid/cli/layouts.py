"""`tagid layouts`: list, draw, check, exchange and remove layouts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli import enrolling
from tagid.cli.enrolling import rate_in_words
from tagid.cli.frame import Terminal, command
from tagid.cli.options import METRES
from tagid.cli.outputs import check_drawing, check_new
from tagid.counting import counted
from tagid.errors import FileFormatError, LayoutConflictError, UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from tagid.enrolling.layout_file import Entries
    from tagid.enrolling.registry import Registry, RegistryContents, Restored
    from tagid.result import Drawn
    from tagid.tags.bodies.signature import Signature
    from tagid.tags.layouts.layout import Layout


@command("layouts", is_group=True)
def layouts(
    terminal: Terminal,
    history: Annotated[bool, typer.Option("--history", help="List all changes.")] = False,
    remove: Annotated[str | None, typer.Option(hidden=True)] = None,
) -> Result:
    """List, design, draw, exchange and check layouts; without a command, list the enrolled ones.

    Example: tagid layouts --history
    """
    if remove:  # until 0.3: `layouts remove`
        return _removed("layouts", remove)
    return _history() if history else _list()


@command("layouts remove")
def remove(
    terminal: Terminal,
    name: Annotated[str, typer.Argument(help="Name of the layout or object.")],
    yes: enrolling.Yes = False,
) -> Result:
    """Remove a layout, or an object with its layout; `tagid layouts undo` restores it.

    Example: tagid layouts remove helmet-7
    """
    enrolling.agree(terminal, f"{name} will no longer be read.", f"Remove {name}?", yes)
    return _removed("layouts remove", name)


def _removed(command: str, name: str) -> Result:
    from tagid.operate.workplace import open_registry

    version = open_registry().remove(name, "tagid layouts remove")
    line = f"{name} removed; its history is kept (registry version {version})"
    return Result(command, {"removed": name, "registry_version": version}, line)


def _history() -> Result:
    from tagid.operate.workplace import open_registry
    from tagid.report.table import Table

    registry = open_registry()
    heads = ("version", "command", "time (UTC)", "change", "kind", "name", "source")
    table = Table(*heads, wraps=("name", "source"))
    names = ("version", "command", "time_utc", "action", "kind", "name", "source")
    rows = [{name: getattr(change, name) for name in names} for change in registry.history()]
    for row in rows:
        time = row["time_utc"][:19].replace("T", " ")
        table.add_row(*map(str, (row | {"time_utc": time}).values()))
    return Result("layouts", {"registry_version": registry.version, "history": rows}, table)


def _list() -> Result:
    from tagid.operate.workplace import open_registry
    from tagid.report.table import Table

    registry = open_registry()
    version, layouts = registry.snapshot()
    table = Table("layout", "kind", "reflectors", "radius mm", "symmetry", "label")
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


@command("layouts show")
def show(
    terminal: Terminal,
    name: Annotated[str, typer.Argument(help="Name of the layout.")],
    file: Annotated[
        Path | None, typer.Option(help="Read it from this TOML file instead of the registry.")
    ] = None,
    png: Annotated[Path | None, typer.Option(help="Write the plan with dimensions.")] = None,
    svg: Annotated[Path | None, typer.Option(help="Write the plan with dimensions.")] = None,
    template: Annotated[Path | None, typer.Option(help="Write a 1:1 template, .pdf or .svg.")] = None,
    paper: Annotated[str, typer.Option(help="Paper of a PDF template: a4, a3, letter.")] = "a4",
    surface_radius: Annotated[
        float | None,
        typer.Option(parser=METRES, help="Radius of the surface that the strip wraps around, metres."),
    ] = None,
) -> Result:
    """Draw a layout, or the test card of `tagid commission` (test-card).

    Example: tagid layouts show helmet-120 --template helmet-120.pdf
    """
    from rich.text import Text

    from tagid.enrolling.layout_file import read_layouts
    from tagid.files import write_bytes
    from tagid.operate.workplace import open_registry
    from tagid.report import layout_sheet
    from tagid.report.drafting import to_png, to_svg
    from tagid.report.pdf import to_pdf
    from tagid.tags.layouts.test_card import NAME, test_card

    if name == NAME and file is None:
        layout = test_card()
    elif file is None:
        layout = open_registry().get(name)
    else:
        from_file = {layout.name: layout for layout in read_layouts(file)}
        if name not in from_file:
            raise UsageError(
                f"{file} contains no layout {name[:80]!r}", f"It contains {', '.join(from_file)}."
            )
        layout = from_file[name]
    check_drawing("--png", png, (".png",))
    check_drawing("--svg", svg, (".svg",))
    check_drawing("--template", template, (".pdf", ".svg"))
    plan = layout_sheet.plan(layout)
    written = []
    for path, content in ((png, to_png), (svg, to_svg)):
        if path is not None:
            write_bytes(path, content(plan))
            written.append(str(path))
    if template is not None:
        if template.suffix.lower() == ".pdf":
            write_bytes(template, to_pdf(layout_sheet.template(layout, surface_radius, paper), paper))
        else:
            whole = layout_sheet.stacked(layout_sheet.template(layout, surface_radius))
            write_bytes(template, to_svg(whole))
        written.append(str(template))
    lines: list[Drawn] = [layout_sheet.in_terminal(layout), Text(f"{layout.name}  {layout.label}", "bold")]
    for number, ((x, y), h) in enumerate(zip(layout.positions, layout.heights, strict=True), 1):  # type: ignore[arg-type]
        high = f"  height {h * 1e3:6.1f}" if any(layout.heights) else ""  # type: ignore[arg-type]
        lines.append(f"  {number}  x {x * 1e3:7.1f}  y {y * 1e3:7.1f} mm{high}")
    lines += [f"written  {path}" for path in written]
    return Result("layouts show", {"layout": layout.to_dict(), "written": written}, lines)


@command("layouts sheet")
def sheet(
    terminal: Terminal,
    file: Annotated[Path, typer.Argument(help="PDF file to write.")],
    names: Annotated[list[str] | None, typer.Argument(help="Layouts; default: all.")] = None,
    paper: Annotated[str, typer.Option(help="Paper: a4, a3, letter.")] = "a4",
) -> Result:
    """Write one PDF with picture, name and 1:1 template of every enrolled layout.

    Example: tagid layouts sheet tags.pdf
    """
    from tagid.files import write_bytes
    from tagid.operate.workplace import open_registry
    from tagid.report import layout_sheet
    from tagid.report.drafting import room
    from tagid.report.pdf import to_pdf

    check_drawing("FILE", file, (".pdf",))
    registry = open_registry()
    layouts = [registry.get(name) for name in names] if names else registry.layouts()
    if not layouts:
        raise UsageError("no layout is enrolled", "Enroll one with `tagid enroll` or `tagid layouts import`.")
    drawings = layout_sheet.overview(layouts, *room(paper))
    for layout in layouts:
        drawings += layout_sheet.template(layout, None, paper)
    write_bytes(file, to_pdf(drawings, paper))
    data = {"path": str(file), "layouts": [layout.name for layout in layouts]}
    return Result("layouts sheet", data, f"{counted(len(layouts), 'layout')} in {file}")


@command("layouts export")
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
    from tagid.enrolling.layout_file import write_layouts
    from tagid.files import resolved
    from tagid.operate.workplace import open_registry

    check_new(file, force)
    file = resolved(file)
    registry = open_registry()
    contents = registry.contents()
    signatures = [signature for signature in contents.signatures if not names or signature.name in names]
    layouts = [layout for layout in contents.layouts if not names or layout.name in names]
    for name in names or []:
        if name not in {layout.name for layout in layouts} | {signature.name for signature in signatures}:
            registry.get(name)  # raises an error that lists the existing names
    write_layouts(layouts, file, signatures)
    data = {
        "path": str(file),
        "layouts": [layout.name for layout in layouts],
        "signatures": [{"kind": signature.kind, "name": signature.name} for signature in signatures],
    }
    line = f"{_count(layouts, signatures)} written to {file}"
    return Result("layouts export", data, line)


@command("layouts import")
def import_(
    terminal: Terminal,
    files: Annotated[list[Path], typer.Argument(help="TOML or JSON files, or other registries (.sqlite).")],
    force: Annotated[
        bool, typer.Option("--force", help="Replace entries, and accept layouts that can be confused.")
    ] = False,
    yes: enrolling.Yes = False,
    dry_run: enrolling.DryRun = False,
) -> Result:
    """Enroll the layouts, bodies and objects of files: all of them, or none if one conflicts.

    The nearest other layout to each and the expected confusion rate are shown first; on a terminal,
    nothing is stored before you confirm.

    Example: tagid layouts import tags.toml
    """
    from tagid.operate.workplace import open_registry
    from tagid.tags.bodies.signature_file import to_bytes

    layouts_of_files: dict[str, Layout] = {}
    signatures: dict[tuple[str, str], Signature] = {}
    for file in files:
        entries = _entries_of(file)
        for signature in entries.signatures:
            twin = signatures.setdefault((signature.kind, signature.name), signature)
            if to_bytes(twin) != to_bytes(signature):
                raise FileFormatError(
                    f"{file}: the {signature.kind} {signature.name} differs from that of another file",
                    "Omit one of the files.",
                )
        for layout in entries.layouts:
            known = layouts_of_files.setdefault(layout.name, layout)
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
        list(layouts_of_files.values()),
        source,
        enrolling.Wish(force, yes, dry_run),
        list(signatures.values()),
    )
    version = before if stored.version is None else stored.version
    read = _count(list(layouts_of_files.values()), list(signatures.values()))
    line = f"{read} read, {version - before} changes, registry version {version}"
    data = {
        "layouts": list(layouts_of_files),
        "signatures": [{"kind": kind, "name": name} for kind, name in signatures],
        "changes": version - before,
        "registry_version": version,
        "stored": stored.version is not None,
        **stored.data,
    }
    return stored.result("layouts import", data, [line])


@command("layouts undo")
def undo(
    terminal: Terminal,
    to: Annotated[
        int | None, typer.Option(help="The version to restore; default: undo the last change.")
    ] = None,
    yes: enrolling.Yes = False,
) -> Result:
    """Undo the last command that changed the registry, or all changes since a version.

    Repeat it to undo earlier commands; `tagid layouts redo` reverts an undo.

    Example: tagid layouts undo
    Example: tagid layouts undo --to 4
    """
    if to is not None:
        enrolling.agree(terminal, f"Version {to} is restored.", "Undo every change since it?", yes)
    return _restored("layouts undo", "undone", lambda registry: registry.undo(to))


@command("layouts redo")
def redo(terminal: Terminal) -> Result:
    """Redo the last undone change.

    Example: tagid layouts redo
    """
    return _restored("layouts redo", "redone", lambda registry: registry.redo())


def _restored(name: str, verb: str, step: Callable[[Registry], Restored]) -> Result:
    """The registry after an undo or redo, with what changed."""
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
        "signatures": [{"kind": signature.kind, "name": signature.name} for signature in contents.signatures],
    }
    return Result(name, data, "\n".join(lines))


def _count(layouts: Sequence[Layout], signatures: Sequence[Signature]) -> str:
    parts = [f"{len(layouts)} layouts"]
    for kind, plural in (("body", "bodies"), ("object", "objects")):
        number = sum(signature.kind == kind for signature in signatures)
        parts += [f"{number} {kind if number == 1 else plural}"] if number else []
    return ", ".join(parts)


def _check_signatures(new: dict[tuple[str, str], Signature], contents: RegistryContents) -> None:
    """Raise LayoutConflictError if another body or object has the name of a new one."""
    from tagid.tags.bodies.signature_file import to_bytes

    for signature in contents.signatures:
        other = new.get((signature.kind, signature.name))
        if other is not None and to_bytes(other) != to_bytes(signature):
            raise LayoutConflictError(
                f"a different {signature.kind} named {signature.name} is already enrolled",
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


@command("layouts check")
def check(terminal: Terminal) -> Result:
    """Check the registry: how far readings tell every pair apart.

    Example: tagid layouts check
    """
    from tagid.enrolling.enrollment import neighbour
    from tagid.operate.workplace import open_registry
    from tagid.reading.alike import Conditions
    from tagid.report.table import Table

    registry = open_registry()
    version, enrolled = registry.snapshot()
    lost = [change for change in registry.history() if change.entry is None]
    remarks = [
        f"version {c.version} ({c.action} {c.name}) cannot be read, so it cannot be restored" for c in lost
    ]
    basis = enrolling.basis()
    conditions = Conditions(height_weight=basis.height_weight)
    pairs, nested = [], []
    for a, b in combinations(enrolled, 2):
        pair = neighbour(a, b, basis)
        if a.size == b.size:
            pairs.append((a.name, pair.compared(a, b, conditions)))
        elif pair.distance.nested:
            nested.append(sorted((a, b), key=lambda layout: layout.size))
    pairs.sort(key=lambda pair: pair[1].distance.rms_m)
    bad = [pair for pair in pairs if pair[1].confusable]
    table = Table("pair", "RMS mm", "worst mm", "not told apart", "remark", wraps=("remark",))
    for name, other in pairs[: max(10, len(bad))]:
        distance = other.distance
        remark = "CONFUSABLE" if other.confusable else ""
        table.add_row(
            f"{name} - {other.name}",
            f"{distance.rms_m * 1e3:.1f}",
            f"{distance.worst_m * 1e3:.1f}",
            rate_in_words(other.unresolved),
            remark + (", as its mirror image" if other.mirrored else ""),
        )
    for part, whole in nested[:10]:
        table.add_row(f"{part.name} - {whole.name}", "-", "-", "-", f"{part.name} is a part of {whole.name}")
    data = {
        "layouts": len(enrolled),
        "registry_version": version,
        "pairs": [
            {
                "a": name,
                "b": other.name,
                "rms_m": other.distance.rms_m,
                "worst_m": other.distance.worst_m,
                "confusion_rate": other.unresolved,
                "confusable": other.confusable,
                "mirrored": other.mirrored,
            }
            for name, other in pairs
        ],
        "damaged_versions": [change.version for change in lost],
        "nested": [{"part": part.name, "of": whole.name} for part, whole in nested],
    }
    if nested:
        remarks.append(
            f"{counted(len(nested), 'layout')} inside a larger one. This is allowed: the reader counts "
            "reflectors. But if the larger one loses a reflector, the smaller one may be named; avoid "
            "such pairs on objects that could be mixed up."
        )
    if not bad:
        alone = f"{len(enrolled)} layouts, no two with the same number of reflectors"
        return Result("layouts check", data, table if pairs or nested else alone, messages=tuple(remarks))
    error = LayoutConflictError(
        f"{counted(len(bad), 'pair')} of layouts could be confused: they leave more readings "
        "without a name than enrolling allows",
        "Remove one of each pair with `tagid layouts remove NAME`, or move a reflector.",
    )
    return Result.from_error("layouts check", error, data, table, tuple(remarks))
