"""`tagid radar find`: which radars are there, on serial ports and in the network."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from tagid.cli.common.frame import Terminal, command
from tagid.config import load_config
from tagid.errors import EXIT_DEVICE, EXIT_OK
from tagid.result import Result


def register(group: typer.Typer) -> None:
    """Add the command."""

    @command(group, "radar find")
    def find(
        terminal: Terminal,
        address: Annotated[
            list[str] | None,
            typer.Option("--address", help="Ask HOST[:PORT] instead of radar.addresses; repeatable."),
        ] = None,
        ask: Annotated[
            list[str] | None,
            typer.Option("--ask", help="Ask this radar URL, too, e.g. a UART adapter's; repeatable."),
        ] = None,
    ) -> Result:
        """Look for radars on serial ports and at the configured addresses; takes up to 3 seconds.

        Example: tagid radar find
        """
        from rich.console import Group

        from tagid.cli.common.urls import to_copy
        from tagid.radar.discovery import WHERE_TO_LOOK, addresses_from, discover
        from tagid.report.radar import found_table

        wanted = {"radar.addresses": ",".join(address)} if address else {}
        config = load_config(wanted)
        found = discover(addresses_from(config["radar.addresses"]), tuple(ask or ()))
        data: dict[str, Any] = {"radars": [radar.to_dict() for radar in found.radars], "asked": found.asked}
        if found.radars:
            code = EXIT_OK if any(radar.status for radar in found.radars) else EXIT_DEVICE
        else:
            code = EXIT_DEVICE
        errors = tuple(
            {"code": "device", "message": f"{radar.url}: {radar.problem}", "remedy": radar.remedy}
            for radar in found.radars
            if radar.problem
        )
        if not found.radars:
            message = f"no radar answered at {', '.join(found.asked) or 'any address'}, none is on a USB port"
            errors = ({"code": "device", "message": message, "remedy": WHERE_TO_LOOK},)
        status = "success" if not errors else "partial" if code == EXIT_OK else "error"
        answering = [radar.url for radar in found.radars if radar.status]
        urls = to_copy(answering, "tagid config set radar.url {}")
        human = Group(found_table(found.radars), urls) if found.radars else None
        return Result("radar find", data, human, status, code, errors=errors)  # type: ignore[arg-type]
