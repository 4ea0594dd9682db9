"""Confirmation before a command moves a device or replaces what took long to make.

Scripts confirm with --yes or --force; without it and without a terminal nothing is moved or replaced.
"""

from __future__ import annotations

from typing import Annotated

import typer

from tagid.cli.common.prompts import can_ask, confirm
from tagid.errors import CaptureInterrupted, StorageError, UsageError
from tagid.secret import MotionUrl

Yes = Annotated[
    bool,
    typer.Option("--yes", "-y", help="Move the robot or table without confirmation.", show_default=False),
]


def warning_of(motion: object) -> str:
    """Events that do not stop a device automatically; "" if every event does."""
    return str(getattr(motion, "warning", ""))


def agree(what: str, yes: bool, warning: str = "") -> None:
    """Return if the device may move.

    Args:
        what: the device and its movement, for the prompt.
        yes: whether --yes was given.
        warning: events that do not stop it automatically; shown even with --yes.

    Raises:
        UsageError: no terminal to ask on. CaptureInterrupted: the user declined.
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
            warning_of(motion),
        )


def agree_to_replace(what: str, how: str) -> None:
    """Return if the user, on a terminal, agrees to replace what is there.

    Args:
        what: states what is there, e.g. "report holds a report".
        how: remedy without a terminal.

    Raises:
        StorageError: no terminal to ask on. CaptureInterrupted: the user declined.
    """
    if not can_ask():
        raise StorageError(what, how)
    if not confirm(f"{what}. Replace it?", default=False):
        raise CaptureInterrupted("declined: nothing was replaced", how)
