"""`tagid layouts reflector`: a printable or foldable reflector, and its radar cross-section."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli.common.frame import Terminal, command
from tagid.cli.common.outputs import check_new
from tagid.errors import UsageError
from tagid.result import Result

if TYPE_CHECKING:
    from rich.console import RenderableType

    from tagid.report.reflector_sheet import CrossSection

KINDS = ("octahedron",)
_MADE = (".stl", ".svg", ".pdf")
_TOLD = (".csv", ".png")


def register(app: typer.Typer) -> None:
    """Add the command."""

    @command(app, "layouts reflector")
    def reflector(
        terminal: Terminal,
        kind: Annotated[str, typer.Option("--kind", help="octahedron.")] = "octahedron",
        size: Annotated[float, typer.Option("--size", help="From tip to tip, millimetres.")] = 40.0,
        out: Annotated[
            list[Path] | None,
            typer.Option("--out", "-o", help="A .stl solid, or a .svg or .pdf net; repeatable."),
        ] = None,
        rcs: Annotated[
            list[Path] | None,
            typer.Option("--rcs", help="Compute its radar cross-section: .csv table, .png plot; repeatable."),
        ] = None,
        paper: Annotated[str, typer.Option("--paper", help="Paper of a PDF: a4, a3, letter.")] = "a4",
        force: Annotated[bool, typer.Option("--force", help="Overwrite existing files.")] = False,
    ) -> Result:
        """Create files for a reflector: a solid for a 3-D printer and foil, or a net to cut and fold at 1:1.

        Example: tagid layouts reflector --size 40 --out r.stl --out r.pdf --rcs r.csv --rcs r.png
        """
        from rich.console import Group
        from rich.text import Text

        from tagid.files import write_bytes
        from tagid.report import reflector_sheet as sheets
        from tagid.report.drafting import to_pdf, to_svg

        if kind not in KINDS:
            raise UsageError(f"there is no reflector {kind[:40]!r}", f"Use {', '.join(KINDS)}.")
        made, told = list(out or ()), list(rcs or ())
        if not made and not told:
            raise UsageError("nothing to write", "Give --out r.stl, r.svg or r.pdf, or --rcs r.csv or r.png.")
        for paths, known, option in ((made, _MADE, "--out"), (told, _TOLD, "--rcs")):
            for path in paths:
                if path.suffix.lower() not in known:
                    raise UsageError(f"{option} {path}: unknown suffix", f"Use {', '.join(known)}.")
                check_new(path, force)
        size_m = size * 1e-3
        sheets.check_size(size_m)
        for path in made:
            suffix = path.suffix.lower()
            if suffix == ".stl":
                write_bytes(path, sheets.to_stl(size_m))
            elif suffix == ".svg":
                write_bytes(path, to_svg(sheets.sheet(size_m)))
            else:
                write_bytes(path, to_pdf([sheets.sheet(size_m)], paper))
        edge = size / 2**0.5
        lines: list[RenderableType] = [
            Text(f"octahedron, size {size:g} mm from tip to tip, edge {edge:.1f} mm")
        ]
        solved = sheets.cross_section(size_m) if told else None
        if solved is not None:
            for path in told:
                content = sheets.to_csv(solved).encode() if path.suffix == ".csv" else sheets.to_png(solved)
                write_bytes(path, content)
            lines += [_table(solved), Text(f"source: {solved.source}")]
        written = [str(path) for path in (*made, *told)]
        lines += [Text(f"written  {path}") for path in written]
        data = {
            "kind": kind,
            "size_mm": size,
            "edge_mm": edge,
            "written": written,
            "rcs_dbsm": None if solved is None else _levels(solved),
        }
        return Result("layouts reflector", data, Group(*lines))


def _levels(solved: CrossSection) -> dict[str, object]:
    return {
        "source": solved.source,
        "frequency_hz": solved.frequency_hz.tolist(),
        "aspect_deg": solved.aspect_deg.tolist(),
        "vertical": solved.vertical.tolist(),
        "horizontal": solved.horizontal.tolist(),
    }


def _table(solved: CrossSection) -> RenderableType:
    from rich.table import Table

    table = Table("GHz", "vertical dBsm", "horizontal dBsm, towards a tip", "at 45 degrees", box=None)
    half = len(solved.aspect_deg) // 2
    for i, frequency in enumerate(solved.frequency_hz):
        across = solved.horizontal[i]
        table.add_row(
            f"{frequency / 1e9:.1f}",
            f"{solved.vertical[i].mean():.1f}",
            f"{across[0]:.1f}",
            f"{across[half]:.1f}",
        )
    return table
