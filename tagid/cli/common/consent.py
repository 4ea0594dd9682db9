"""The confirmation that every command asks for before it moves something.

Scripts confirm with --yes; without it and without a terminal nothing moves.
"""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from tagid.errors import CaptureInterrupted, UsageError

Yes = Annotated[
    bool, typer.Option("--yes", "-y", help="Let the robot or table move without asking.", show_default=False)
]


def warning_of(motion: object) -> str:
    """What does not stop a device by itself; "" where something always does."""
    return str(getattr(motion, "warning", ""))


def agree(what: str, yes: bool, warning: str = "") -> None:
    """Return where it may move.

    Args:
        what: what will move and how, for the prompt.
        yes: whether --yes was given.
        warning: what does not stop it by itself; shown before the question, and also where --yes was given.

    Raises:
        UsageError: no terminal to ask on. CaptureInterrupted: the user declined.
    """
    if warning:
        typer.echo(f"{warning}.", err=True)
    if yes:
        return
    if not sys.stdin.isatty():
        raise UsageError(
            f"{what}, and there is no terminal to confirm it on",
            "Make sure that its surroundings are free, then add --yes.",
        )
    try:
        agreed = typer.confirm(f"{what}. Is the area clear?", default=False, err=True)
    except typer.Abort:
        agreed = False
    if not agreed:
        raise CaptureInterrupted("declined: nothing was moved")


def agree_to(motion_url: str, yes: bool) -> None:
    """Ask before moving the device of a URL, if it moves on command. Raises as `agree`, and UsageError."""
    from tagid.motion.urls import open_motion

    motion = open_motion(motion_url)
    if motion.moves and motion.nominal_s is not None:
        way = "clockwise" if motion.direction < 0 else "counter-clockwise"
        agree(f"{motion_url} will turn {way}, {motion.nominal_s:.0f} s per turn", yes, warning_of(motion))
