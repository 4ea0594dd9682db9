"""`tagid motion find`: robots and tables on serial ports and over Bluetooth."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from tagid.cli.common.frame import Terminal, command
from tagid.errors import EXIT_DEVICE, EXIT_OK, TagidError, UsageError
from tagid.result import Result


def register(group: typer.Typer) -> None:
    """Add the command."""

    @command(group, "motion find")
    def find(
        terminal: Terminal,
        seconds: Annotated[float, typer.Option("--seconds", help="How long to listen.")] = 4.0,
        bluetooth: Annotated[bool, typer.Option("--ble/--no-ble", help="Listen for Bluetooth.")] = True,
        hci: Annotated[str | None, typer.Option("--hci", help="Another Bluetooth controller.")] = None,
    ) -> Result:
        """Look for robots and tables; nothing is sent to any of them.

        Example: tagid motion find
        """
        from rich.console import Group
        from rich.table import Table

        from tagid.cli.common.urls import to_copy
        from tagid.motion.discovery import bluetooth_devices, serial_devices

        if not 0.1 <= seconds <= 60:
            raise UsageError(f"--seconds is {seconds}", "Give 0.1 to 60.")
        found = serial_devices()
        errors: tuple[dict[str, str], ...] = ()
        if bluetooth:
            try:
                found += bluetooth_devices(seconds, hci)
            except TagidError as error:
                errors = ({"code": error.code, "message": error.message, "remedy": error.remedy},)
        if not found and not errors:
            message = "no robot and no table was found"
            errors = (
                {
                    "code": "device",
                    "message": message,
                    "remedy": "Plug its cable in, or power the bridge; a table that runs freely needs no "
                    "finding: --motion free.",
                },
            )
        table = Table("where", "what", "signal", box=None)
        for one in found:
            table.add_row(one.where, one.what, "" if one.signal_dbm is None else f"{one.signal_dbm} dBm")
        urls = to_copy([one.url for one in found if one.url], "tagid motion info {}")
        status = "success" if not errors else "partial" if found else "error"
        code = EXIT_OK if found else EXIT_DEVICE
        data = {"devices": [asdict(one) for one in found]}
        human = Group(table, urls) if found else None
        return Result("motion find", data, human, status, code, errors=errors)  # type: ignore[arg-type]
