"""The program `tagid-firmware`: from a bare ESP32 to a bridge that answers, and a radar that is set up."""

from __future__ import annotations

import sys

import typer

from firmware_tools.cli import build, flash, p440, provision, selftest, verify
from tagid.cli.common.frame import serve

app = typer.Typer(
    name="tagid-firmware",
    help="Build, flash, provision and try the Bluetooth bridge; set up a P440.",
    epilog="In this order: build, flash, provision, verify, selftest.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for part in (build, flash, provision, verify, selftest, p440):
    part.register(app)


def main() -> None:
    """Entry point."""
    sys.exit(serve(app))
