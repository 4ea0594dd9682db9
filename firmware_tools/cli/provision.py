"""`tagid-firmware provision`: install firmware and configuration on a board."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from firmware_tools.cli import shared
from tagid.cli.frame import Terminal, command
from tagid.result import Result

Pin = Annotated[int | None, typer.Option(help="Pin number, if not the chip's default.", show_default=False)]


@command("provision")
def provision(
    terminal: Terminal,
    name: Annotated[str, typer.Option("--name", help="Advertised name, up to 20 characters.")],
    chip: Annotated[str, typer.Option("--chip", help="esp32 or esp32c3: sets the pins.")] = "esp32c3",
    passkey: Annotated[
        str | None,
        typer.Option("--passkey", help="Six digits; random if omitted.", show_default=False),
    ] = None,
    baud: Annotated[
        int | None, typer.Option("--baud", help="Robot's baud rate; default 115200.", show_default=False)
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option("--config", help="JSON file with further keys (docs/bridge.md).", show_default=False),
    ] = None,
    port: shared.PortOption = None,
    build: shared.BuildFolder = None,
) -> Result:
    """Write the firmware and its configuration; identical files are kept.

    Example: tagid-firmware provision --name robot-7 --chip esp32c3
    """
    from firmware_tools import provision as provisioning
    from firmware_tools.board import open_board
    from firmware_tools.boards import choose_port
    from firmware_tools.cli.shared import load_build

    given = {"name": name, "baud": baud, "passkey": passkey}
    wanted = provisioning.make_config(chip, given, config)
    random = wanted["passkey"] is None and not _open_on_purpose(config)
    if random:
        wanted = provisioning.make_config(chip, {**given, "passkey": provisioning.new_passkey()}, config)
    made = load_build(build, terminal)
    chosen = choose_port(port)
    total = sum(len(data) for data in made.files.values())
    with open_board(chosen) as board, terminal.progress("writing", total) as advance:
        done = provisioning.provision(board, made, wanted, advance)
    data = {
        "port": chosen,
        "firmware": made.version,
        "python": asdict(done.python),
        "written": done.written,
        "kept": done.kept,
        "config": done.config,
    }
    key = wanted["passkey"]
    text = f"{name}: firmware {made.version}, {len(done.written)} files written, {len(done.kept)} kept; " + (
        f"pass-key {key}" if key else "open to anyone"
    )
    notes = ["write the pass-key on the board's label: it is not shown again"] if random else []
    if key is None:
        notes.append("without a pass-key anyone within range can drive the robot")
    notes.append(f"next: tagid-firmware selftest {name}" + (f" --passkey {key}" if key else ""))
    return Result("provision", data, text, messages=tuple(notes))


def _open_on_purpose(path: Path | None) -> bool:
    """Whether the file itself contains `"passkey": null`."""
    import json

    return path is not None and "passkey" in json.loads(path.read_text(encoding="utf-8"))
