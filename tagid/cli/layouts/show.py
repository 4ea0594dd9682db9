"""`tagid layouts show`: a layout on the terminal, as a dimensioned drawing, or as a printable template."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tagid.cli.common.frame import Terminal, command
from tagid.cli.common.outputs import check_drawing
from tagid.errors import UsageError
from tagid.result import Result


def register(app: typer.Typer) -> None:
    """Add the command."""

    @command(app, "layouts show")
    def show(
        terminal: Terminal,
        name: Annotated[str, typer.Argument(help="Name of the layout.")],
        file: Annotated[
            Path | None, typer.Option("--file", help="Read it from this TOML file instead of the registry.")
        ] = None,
        png: Annotated[Path | None, typer.Option("--png", help="Write the plan with dimensions.")] = None,
        svg: Annotated[Path | None, typer.Option("--svg", help="Write the plan with dimensions.")] = None,
        template: Annotated[
            Path | None, typer.Option("--template", help="Write a 1:1 template, .pdf or .svg.")
        ] = None,
        paper: Annotated[
            str, typer.Option("--paper", help="Paper of a PDF template: a4, a3, letter.")
        ] = "a4",
        surface_radius: Annotated[
            float | None,
            typer.Option(
                "--surface-radius", help="Radius of the surface that the strip wraps around, metres."
            ),
        ] = None,
    ) -> Result:
        """Draw a layout.

        Example: tagid layouts show helmet-120 --template helmet-120.pdf
        """
        from rich.console import Group
        from rich.text import Text

        from tagid.enrolling.layout_file import read_layouts
        from tagid.files import write_bytes
        from tagid.operate.workplace import open_registry
        from tagid.report import layout_sheet
        from tagid.report.drafting import to_pdf, to_png, to_svg

        if file is None:
            layout = open_registry().get(name)
        else:
            found = {one.name: one for one in read_layouts(file)}
            if name not in found:
                raise UsageError(
                    f"{file} contains no layout {name[:80]!r}", f"It contains {', '.join(found)}."
                )
            layout = found[name]
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
        lines = [Text(layout_sheet.in_terminal(layout)), Text(f"{layout.name}  {layout.label}", "bold")]
        for number, ((x, y), h) in enumerate(zip(layout.positions, layout.heights, strict=True), 1):  # type: ignore[arg-type]
            high = f"  height {h * 1e3:6.1f}" if any(layout.heights) else ""  # type: ignore[arg-type]
            lines.append(Text(f"  {number}  x {x * 1e3:7.1f}  y {y * 1e3:7.1f} mm{high}"))
        lines += [Text(f"written  {path}") for path in written]
        return Result("layouts show", {"layout": layout.to_dict(), "written": written}, Group(*lines))
