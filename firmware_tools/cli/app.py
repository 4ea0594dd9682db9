"""The program `tagid-firmware`: builds and installs the bridge on an ESP32, and configures a P440."""

from __future__ import annotations

import typer

from tagid.cli.frame import commands_of, run_program

app = typer.Typer(
    name="tagid-firmware",
    help="Build, flash, provision and test the Bluetooth bridge; configure a P440.",
    epilog="In this order: build, flash, provision, verify, selftest.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for part in ("build", "flash", "provision", "verify", "selftest", "p440"):
    for declared in commands_of(f"firmware_tools.cli.{part}"):
        declared.add_to(app)


def main() -> None:
    """Entry point."""
    run_program(app)
