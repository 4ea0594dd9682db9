"""The program `tagid-firmware`: builds and installs the bridge on an ESP32, and configures a P440."""

from __future__ import annotations

import typer

from firmware_tools.cli import build, flash, p440, provision, selftest, verify
from tagid.cli.common.frame import run_program

app = typer.Typer(
    name="tagid-firmware",
    help="Build, flash, provision and test the Bluetooth bridge; configure a P440.",
    epilog="In this order: build, flash, provision, verify, selftest.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for part in (build, flash, provision, verify, selftest, p440):
    part.register(app)


def main() -> None:
    """Entry point."""
    run_program(app)
