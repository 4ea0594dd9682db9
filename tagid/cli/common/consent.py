"""Confirmation before anything moves: the prompt shared by all commands that move a device.

Scripts pass --yes; without it and without a terminal, nothing moves.
"""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from tagid.errors import CaptureInterrupted, UsageError

Yes = Annotated[
    bool, typer.Option("--yes", "-y", help="Let the robot or table move without asking.", show_default=False)
]


def agree(what: str, yes: bool) -> None:
    """Return if the movement is confirmed.

    Args:
        what: what will move and how, for the prompt.
        yes: whether --yes was given.

    Raises:
        UsageError: no terminal to ask on. CaptureInterrupted: the user declined.
    """
    if yes:
        return
    if not sys.stdin.isatty():
        raise UsageError(
            f"{what}: no terminal to confirm on", "Make sure that nothing is in the way, then add --yes."
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
        agree(f"{motion_url} will turn {way}, {motion.nominal_s:.0f} s per turn", yes)
