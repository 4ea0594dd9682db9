"""Confirmation before a command moves a device or replaces what took long to make.

Scripts confirm with --yes or --force; without it and without a terminal nothing is moved or replaced.
"""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer

from tagid import interrupts
from tagid.errors import CaptureInterrupted, StorageError, UsageError, visible
from tagid.secret import MotionUrl

_ANSWERS = {"y": True, "yes": True, "n": False, "no": False}


def can_ask() -> bool:
    """Whether standard input is a terminal."""
    return sys.stdin is not None and sys.stdin.isatty()


def confirm(question: str, default: bool) -> bool:
    """Ask on stderr until the answer is yes or no; a stop signal or the end of the input counts as no.

    An empty line is answered by `default`.
    """
    choices = "Y/n" if default else "y/N"
    while True:
        typer.echo(f"{visible(question)} [{choices}]: ", err=True, nl=False)
        try:
            answer = read_line().strip().lower()
        except (EOFError, KeyboardInterrupt):
            typer.echo(err=True)
            return False
        if not answer:
            return default
        if answer in _ANSWERS:
            return _ANSWERS[answer]
        typer.echo("Answer y or n.", err=True)


def read_line() -> str:
    """The next line of the standard input, which may be a terminal, a pipe or a file.

    No byte after the line is read. Stop signals take effect at once.

    Raises:
        EOFError: there is no further line. KeyboardInterrupt: a stop signal.
    """
    if sys.stdin is None:
        raise EOFError
    descriptor = sys.stdin.fileno()
    line = bytearray()
    while not line.endswith(b"\n"):
        interrupts.wait_readable(descriptor)
        byte = os.read(descriptor, 1)
        if not byte:
            break
        line += byte
    if not line:
        raise EOFError
    return line.decode(sys.stdin.encoding, "replace").rstrip("\r\n")


Yes = Annotated[bool, typer.Option("--yes", "-y", help="Move the robot or table without confirmation.")]


def agree(what: str, yes: bool, warning: str = "") -> None:
    """Return if the device may move; the warning, of what does not stop it, is shown even with --yes.

    Raises UsageError without a terminal to ask on, CaptureInterrupted if the user declines.
    """
    if warning:
        typer.echo(f"{warning}.", err=True)
    if yes:
        return
    if not can_ask():
        raise UsageError(
            f"{what}, and there is no terminal to confirm it on",
            "Make sure that the area around it is clear, then add --yes.",
        )
    if not confirm(f"{what}. Is the area clear?", default=False):
        raise CaptureInterrupted("declined: nothing was moved")


def agree_to(motion_url: MotionUrl, yes: bool) -> None:
    """Ask for confirmation before moving a commanded device. Raises as `agree`, and UsageError."""
    from tagid.motion.urls import open_motion

    motion = open_motion(motion_url)
    if motion.moves and motion.nominal_s is not None:
        way = "clockwise" if motion.direction < 0 else "counter-clockwise"
        agree(
            f"{motion_url} will rotate {way}, {motion.nominal_s:.0f} s per revolution",
            yes,
            str(getattr(motion, "warning", "")),
        )


def agree_to_replace(what: str, how: str) -> None:
    """Return if the user, on a terminal, agrees to replace what is there, e.g. "report holds a report".

    Raises StorageError, with the remedy `how`, without a terminal, CaptureInterrupted if the user declines.
    """
    if not can_ask():
        raise StorageError(what, how)
    if not confirm(f"{what}. Replace it?", default=False):
        raise CaptureInterrupted("declined: nothing was replaced", how)
