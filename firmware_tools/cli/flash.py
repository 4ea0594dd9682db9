"""`tagid-firmware flash`: write MicroPython onto a board."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from firmware_tools.cli import shared
from tagid.cli.frame import Terminal, command
from tagid.result import Result


@command("flash")
def flash(
    terminal: Terminal,
    image: Annotated[Path, typer.Argument(help="MicroPython's .bin for ESP32_GENERIC or _C3.")],
    port: shared.PortOption = None,
    sha256: Annotated[
        str | None,
        typer.Option("--sha256", help="Its hash; without it IMAGE.sha256 is read.", show_default=False),
    ] = None,
    baud: Annotated[int, typer.Option("--baud", help="Baud rate for writing.")] = 460800,
    before: Annotated[
        str, typer.Option("--before", help="default-reset, usb-reset, or no-reset (BOOT held by hand).")
    ] = "default-reset",
    stub: Annotated[bool, typer.Option("--stub/--no-stub", help="Load esptool's faster helper.")] = True,
    erase: Annotated[bool, typer.Option("--erase", help="Erase everything first.")] = False,
) -> Result:
    """Write an official MicroPython image; its hash is checked before, and its content read back after.

    Example: tagid-firmware flash ESP32_GENERIC_C3-v1.27.0.bin --sha256 HASH
    """
    from firmware_tools import flash as flashing
    from firmware_tools.boards import choose_port
    from firmware_tools.image import check_image, wanted_hash
    from tagid.errors import UsageError

    if before not in ("default-reset", "usb-reset", "no-reset"):
        raise UsageError(f"--before {before!r} is unknown", "Give default-reset, usb-reset or no-reset.")
    checked = check_image(image, wanted_hash(image, sha256))
    connection = flashing.Connection(choose_port(port), baud, before, stub)
    with terminal.progress("flashing", len(checked.data)) as advance:
        done = flashing.flash(checked, connection, advance, erase)
    data = {
        "port": connection.port,
        "image": {"path": str(image), "sha256": checked.sha256, "micropython": checked.version},
        **asdict(done),
    }
    text = (
        f"MicroPython {checked.version or '(version unknown)'} is on the {done.chip} {done.mac}: "
        f"{done.size} bytes at {done.offset:#x}, read back and equal"
    )
    return Result("flash", data, text, messages=("next: tagid-firmware provision --name NAME",))
