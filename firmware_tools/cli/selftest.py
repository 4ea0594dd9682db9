"""`tagid-firmware selftest`: test a bridge over Bluetooth."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from tagid.cli.frame import Terminal, command
from tagid.errors import EXIT_FAILED, EXIT_OK
from tagid.result import Problem, Result

_STYLES = {"passed": "green", "failed": "bold red", "skipped": "yellow"}


@command("selftest")
def selftest(
    terminal: Terminal,
    name: Annotated[str, typer.Argument(help="Name or address of the bridge.")],
    passkey: Annotated[
        str | None, typer.Option("--passkey", help="Its six-digit pass-key.", show_default=False)
    ] = None,
    loopback: Annotated[bool, typer.Option("--loopback", help="TX and RX are connected.")] = False,
    brc: Annotated[bool, typer.Option("--brc/--no-brc", help="Pulse BRC, which wakes the robot.")] = True,
    listen: Annotated[
        float, typer.Option("--listen", min=0.1, max=60, help="Duration of the search, s.")
    ] = 5.0,
    hci: Annotated[
        str | None,
        typer.Option("--hci", help="A virtual controller instead of this computer's.", show_default=False),
    ] = None,
) -> Result:
    """Find the bridge, then test link, echo, serial line, BRC and the robot's answer. No wheel moves.

    Example: tagid-firmware selftest robot-7 --passkey 482913
    """
    from rich.table import Table

    from firmware_tools.selftest import SelftestPlan, run_selftest

    plan = SelftestPlan(name, passkey, loopback, brc, listen)
    with terminal.progress("testing", 5) as advance:
        steps = run_selftest(plan, advance, hci)
    table = Table(show_header=False, box=None)
    for step in steps:
        table.add_row(step.name, step.verdict, step.text, style=_STYLES[step.verdict])
    bad = [step for step in steps if step.verdict == "failed"]
    return Result(
        "selftest",
        {"name": name, "steps": [asdict(step) for step in steps]},
        table,
        exit_code=EXIT_FAILED if bad else EXIT_OK,
        errors=tuple(Problem("selftest", f"{step.name}: {step.text}", "See docs/bridge.md.") for step in bad),
    )
