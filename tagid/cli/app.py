"""The `tagid` program: its commands, and the last handler for invalid command lines.

It imports no numerics, so that `tagid --help` answers at once.
"""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from tagid import __version__
from tagid.cli import (
    bodies,
    config,
    doctor,
    enroll,
    history,
    identify,
    plan,
    reconstruct,
    report,
    scan,
    show,
    simulate,
    station,
    transfer,
    volume,
)
from tagid.cli.common.frame import serve
from tagid.cli.emulate import app as emulate
from tagid.cli.layouts import app as layouts
from tagid.cli.motion import app as motion
from tagid.cli.radar import app as radar

app = typer.Typer(
    name="tagid",
    help="Read the identity of a tagged object from radar scans taken while it turns.",
    epilog="Try it without a radar: tagid scan --demo",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for part in (
    plan,
    scan,
    station,
    identify,
    enroll,
    layouts,
    bodies,
    history,
    report,
    reconstruct,
    show,
    transfer,
    volume,
    simulate,
    emulate,
    radar,
    motion,
    doctor,
    config,
):
    part.register(app)


def _print_version(value: bool) -> None:
    if value:
        typer.echo(f"tagid {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def main() -> None:
    """Entry point: run the command line, and report an invalid one in the requested format."""
    sys.exit(serve(app))
