"""`tagid radar find`: find radars on serial ports and in the network."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from tagid.cli.common.frame import Terminal, command
from tagid.config import load_config
from tagid.errors import EXIT_DEVICE, EXIT_OK
from tagid.result import Problem, Result


def register(group: typer.Typer) -> None:
    """Add the command."""

    @command(group, "radar find")
    def find(
        terminal: Terminal,
        address: Annotated[
            list[str] | None,
            typer.Option("--address", help="Query HOST[:PORT] instead of radar.addresses; repeatable."),
        ] = None,
        ask: Annotated[
            list[str] | None,
            typer.Option("--ask", help="Also query this radar URL, e.g. of a UART adapter; repeatable."),
        ] = None,
    ) -> Result:
        """Find radars on serial ports and at the configured addresses; takes up to 3 seconds.

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
        errors = tuple(
            Problem("device", f"{radar.url}: {radar.problem}", radar.remedy)
            for radar in found.radars
            if radar.problem
        )
        if not found.radars:
            message = f"no radar replied at {', '.join(found.asked) or 'any address'} or on a USB port"
            errors = (Problem("device", message, WHERE_TO_LOOK),)
        answering = [radar.url for radar in found.radars if radar.status]
        urls = to_copy(answering, "tagid config set radar.url {}")
        human = Group(found_table(found.radars), urls) if found.radars else None
        code = EXIT_OK if answering else EXIT_DEVICE
        return Result("radar find", data, human, exit_code=code, errors=errors, completed=len(answering))
