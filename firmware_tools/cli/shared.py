"""Options shared by several commands of `tagid-firmware`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tagid.cli.frame import Terminal

if TYPE_CHECKING:
    from firmware_tools.build import Build

PortOption = Annotated[
    str | None,
    typer.Option("--port", help="The board's serial port; default: the only board.", show_default=False),
]
BuildFolder = Annotated[
    Path | None,
    typer.Option(
        "--build", help="Folder of a build; if omitted, the firmware is built now.", show_default=False
    ),
]


def load_build(folder: Path | None, terminal: Terminal) -> Build:
    """The build in a folder, or a new one."""
    from firmware_tools.build import compile_firmware, read_build

    if folder is not None:
        return read_build(folder)
    with terminal.progress("building", None) as advance:
        return compile_firmware(advance)
