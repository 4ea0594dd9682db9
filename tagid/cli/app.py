"""The `tagid` program: its commands, and the last handler for invalid command lines.

It imports no numerics, so that `tagid --help` is fast.
"""

from __future__ import annotations

import gc
import os
from typing import Annotated

import typer

from tagid import __version__
from tagid.cli.common.frame import run_program
from tagid.cli.common.lazy import Entry, lazy_group
from tagid.constants import BLAS_THREADS

COMMANDS = {
    "plan": Entry(
        "tagid.cli.plan",
        "Plan a recording: SNR, clipping, time, centring, and the probability that the tag is named.",
    ),
    "scan": Entry("tagid.cli.scan", "Record one revolution of the object, image it and name it."),
    "station": Entry(
        "tagid.cli.station",
        "Serve a web page with a Scan button, live image, answer, health and history.",
    ),
    "identify": Entry("tagid.cli.identify", "Name the object in one or more captures."),
    "enroll": Entry(
        "tagid.cli.enroll",
        "Enrol a layout from coordinates, a file or captures of the real object, or an untagged body.",
    ),
    "history": Entry(
        "tagid.cli.history", "List the identifications made on this computer, newest first, or export them."
    ),
    "report": Entry("tagid.cli.report", "Identify many captures: write a page, tables and a test report."),
    "reconstruct": Entry("tagid.cli.reconstruct", "Reconstruct an image from a capture."),
    "join": Entry(
        "tagid.cli.volume",
        "Join captures of one object from several antenna heights into one capture with antenna positions.",
    ),
    "show": Entry(
        "tagid.cli.show",
        "Draw range profile, scans over time and spectrum of a recording, and print its statistics.",
    ),
    "import": Entry("tagid.cli.transfer", "Convert another tool's recording to a capture file."),
    "export": Entry(
        "tagid.cli.transfer",
        "Write a capture as NPZ, MATLAB (.mat), P440 recording (.out, .prd), MRM-RET log (.csv) or .h5.",
    ),
    "recover": Entry(
        "tagid.cli.transfer", "Create a capture file from the journal of an interrupted recording."
    ),
    "simulate": Entry(
        "tagid.cli.simulate",
        "Simulate a capture of a rotating scene, or of an object with a response file.",
    ),
    "doctor": Entry("tagid.cli.doctor", "Check ports, radar, disk, layouts and versions."),
    "config": Entry("tagid.cli.config", "Show or change the stored settings."),
    "layouts": Entry(
        "tagid.cli.layouts.app",
        "List, design, draw, exchange and check layouts; without a command, list the enrolled ones.",
    ),
    "bodies": Entry(
        "tagid.cli.bodies",
        "List, draw and check enrolled bodies and objects; without a command, list them.",
    ),
    "emulate": Entry(
        "tagid.cli.emulate.app", "Emulate a device on a real network, serial or Bluetooth interface."
    ),
    "radar": Entry(
        "tagid.cli.radar.app", "Find, query, configure, monitor and calibrate the radar, and record scans."
    ),
    "motion": Entry("tagid.cli.motion.app", "Find, query, rotate, stop and calibrate robots and turntables."),
}
"""Every command, in the order of the help, with the first sentence of its help text."""

app = typer.Typer(
    name="tagid",
    cls=lazy_group(COMMANDS),
    help="Read the identity of a tagged object from radar scans taken while it rotates.",
    epilog="Try it without a radar: tagid scan --demo",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


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
    # Importing makes tens of thousands of objects that all stay: looking through them for garbage again and
    # again costs a tenth of a short command.
    gc.set_threshold(20_000, 20, 20)
    # The matrices are small, the compiled kernel has threads of its own, and a BLAS thread that waits for
    # another keeps its core busy: on a busy computer two of them made a command five times slower.
    for name in BLAS_THREADS:
        os.environ.setdefault(name, "1")
    run_program(app)
