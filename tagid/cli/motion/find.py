"""`tagid motion find`: robots and tables on serial ports and over Bluetooth."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from tagid.cli.common.frame import Terminal, command
from tagid.errors import EXIT_DEVICE, EXIT_OK, TagidError, UsageError
from tagid.result import Problem, Result


def register(group: typer.Typer) -> None:
    """Add the command."""

    @command(group, "motion find")
    def find(
        terminal: Terminal,
        seconds: Annotated[float, typer.Option("--seconds", help="Listening time, s.")] = 4.0,
        bluetooth: Annotated[bool, typer.Option("--ble/--no-ble", help="Scan for Bluetooth devices.")] = True,
        hci: Annotated[str | None, typer.Option("--hci", help="Another Bluetooth controller.")] = None,
    ) -> Result:
        """Find robots and tables, without sending anything to them.

        Example: tagid motion find
        """
        from rich.console import Group
        from rich.table import Table

        from tagid.cli.common.urls import to_copy
        from tagid.motion.discovery import bluetooth_devices, serial_devices

        if not 0.1 <= seconds <= 60:
            raise UsageError(f"--seconds is {seconds}", "Give 0.1 to 60.")
        found = serial_devices()
        errors: tuple[Problem, ...] = ()
        notes: tuple[str, ...] = ()
        if bluetooth:
            try:
                found += bluetooth_devices(seconds, hci)
            except TagidError as error:
                if found:
                    # Devices were found, so the command succeeded; that Bluetooth was not searched is a note.
                    notes = (f"Bluetooth was not searched: {error.message}. {error.remedy}".strip(),)
                else:
                    errors = (Problem.of(error),)
        if not found and not errors:
            message = "no robot or table was found"
            remedy = (
                "Connect its cable, or power the bridge; a free-running table does not need to be found: "
                "use --motion free."
            )
            errors = (Problem("device", message, remedy),)
        table = Table("where", "what", "signal", box=None)
        for one in found:
            table.add_row(one.where, one.what, "" if one.signal_dbm is None else f"{one.signal_dbm} dBm")
        urls = to_copy([one.url for one in found if one.url], "tagid motion info {}")
        data = {"devices": [asdict(one) for one in found]}
        human = Group(table, urls) if found else None
        code = EXIT_OK if found else EXIT_DEVICE
        return Result("motion find", data, human, exit_code=code, messages=notes, errors=errors)
