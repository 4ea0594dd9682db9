"""`tagid-firmware build`: compile the firmware."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tagid.cli.frame import Terminal, command
from tagid.result import Result


@command("build")
def build(
    terminal: Terminal,
    out: Annotated[Path, typer.Option("--out", help="Folder to write.")] = Path("build/bridge"),
) -> Result:
    """Compile the bridge's firmware with mpy-cross, with a manifest of hashes.

    Example: tagid-firmware build --out build/bridge
    """
    from rich.table import Table

    from firmware_tools.build import compile_firmware, write_build

    with terminal.progress("building", None) as advance:
        made = compile_firmware(advance)
    write_build(made, out)
    table = Table("file", "bytes", "sha256", box=None)
    for name, content in made.files.items():
        table.add_row(name, str(len(content)), made.hashes[name][:16])
    data = {"folder": str(out), **made.manifest()}
    note = f"firmware {made.version} is in {out}; next: tagid-firmware flash IMAGE"
    return Result("build", data, table, messages=(note,))
