"""The `tagid` program: its commands, and the last handler for invalid command lines.

It imports no numerics, so that `tagid --help` is fast.
"""

from __future__ import annotations

import gc
import os
from dataclasses import dataclass
from typing import Annotated, Any

import typer
import typer.core
import typer.main

from tagid._version import __version__
from tagid.cli.frame import commands_of, run_program
from tagid.constants import BLAS_THREADS


@dataclass(frozen=True)
class CommandEntry:
    """A command or a group, imported when it is called: `tagid --help` costs no imports.

    Attributes:
        help: one line, the first sentence of the command's help text.
        modules: of `tagid.cli` that declare it; none for that of its name.
    """

    help: str
    modules: tuple[str, ...] = ()

    def loaded(self, name: str) -> Any:
        """The command or the group of this name, as click takes it."""
        single = typer.Typer(pretty_exceptions_enable=False, rich_markup_mode=None)
        group = typer.Typer(help=self.help, no_args_is_help=True, rich_markup_mode=None)
        for module in self.modules or (name,):
            for declared in commands_of(f"tagid.cli.{module}"):
                if declared.is_group:
                    group.info.no_args_is_help = False
                if declared.name == name and not declared.is_group:
                    declared.add_to(single)
                elif declared.name.partition(" ")[0] == name:
                    declared.add_to(group)
        if not single.registered_commands:
            single.add_typer(group, name=name)
        return typer.main.get_group(single).commands[name]


COMMANDS = {
    "plan": CommandEntry(
        "Plan a recording: SNR, clipping, time, centring, and the probability that the tag is named."
    ),
    "scan": CommandEntry("Record one revolution of the object, image it and name it."),
    "commission": CommandEntry(
        "Measure a rig step by step, from the link to the test card, and write its profile."
    ),
    "station": CommandEntry("Serve a web page with a Scan button, live image, answer, health and history."),
    "identify": CommandEntry("Name the object in one or more captures."),
    "enroll": CommandEntry(
        "Enroll a layout from coordinates, a file or captures of the real object, or an untagged body."
    ),
    "history": CommandEntry("List the identifications made on this computer, newest first, or export them."),
    "report": CommandEntry("Identify many captures: write a page, tables and a test report."),
    "reconstruct": CommandEntry("Reconstruct an image from a capture."),
    "join": CommandEntry(
        "Join captures of one object from several antenna heights into one capture with antenna positions.",
        ("transfer",),
    ),
    "show": CommandEntry(
        "Draw range profile, scans over time and spectrum of a recording, and print its statistics."
    ),
    "import": CommandEntry("Convert another tool's recording to a capture file.", ("transfer",)),
    "export": CommandEntry(
        "Write a capture as NPZ, MATLAB (.mat), P440 recording (.out, .prd), MRM-RET log (.csv) or .h5.",
        ("transfer",),
    ),
    "recover": CommandEntry(
        "Create a capture file from the journal of an interrupted recording.", ("transfer",)
    ),
    "simulate": CommandEntry("Simulate a capture of a rotating scene, or of an object with a response file."),
    "doctor": CommandEntry("Check ports, radar, disk, layouts and versions.", ("config",)),
    "config": CommandEntry("Show or change the stored settings."),
    "layouts": CommandEntry(
        "List, design, draw, exchange and check layouts; without a command, list the enrolled ones.",
        ("layouts", "layouts_design"),
    ),
    "bodies": CommandEntry("List, draw and check enrolled bodies and objects; without a command, list them."),
    "emulate": CommandEntry("Emulate a device on a real network, serial or Bluetooth interface."),
    "radar": CommandEntry(
        "Find, query, configure, monitor and calibrate the radar, and record scans.",
        ("radar", "radar_calibrate"),
    ),
    "motion": CommandEntry("Find, query, rotate, stop and calibrate robots and turntables."),
}
"""Every command, in the order of the help."""


class _Lazy(typer.core.TyperGroup):
    """The commands of the table, of which a wrong name is told the nearest."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        names: dict[str, Any] = dict.fromkeys(COMMANDS)
        self.commands = names

    def list_commands(self, ctx: Any) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name in COMMANDS and self.commands[cmd_name] is None:
            self.commands[cmd_name] = COMMANDS[cmd_name].loaded(cmd_name)
        return self.commands.get(cmd_name)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, entry.help) for name, entry in COMMANDS.items()])


app = typer.Typer(
    name="tagid",
    cls=_Lazy,
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
