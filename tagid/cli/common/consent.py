"""Nothing moves before a person agreed: the one question that every moving command asks.

A script answers with --yes; where nobody can answer, nothing moves.
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
    """Return where it may move.

    Args:
        what: what will move and how, for the question.
        yes: whether --yes was given.

    Raises:
        UsageError: nobody can be asked. CaptureInterrupted: the answer was no.
    """
    if yes:
        return
    if not sys.stdin.isatty():
        raise UsageError(
            f"{what}, and nobody is here to agree", "Look that its surroundings are free, then add --yes."
        )
    try:
        agreed = typer.confirm(f"{what}. Are its surroundings free?", default=False, err=True)
    except typer.Abort:
        agreed = False
    if not agreed:
        raise CaptureInterrupted("not agreed: nothing was moved")


def agree_to(motion_url: str, yes: bool) -> None:
    """Ask about the device of a URL, where it moves on command. Raises as `agree`, and UsageError."""
    from tagid.motion.urls import open_motion

    motion = open_motion(motion_url)
    if motion.moves and motion.nominal_s is not None:
        way = "clockwise" if motion.direction < 0 else "counter-clockwise"
        agree(f"{motion_url} will turn {way}, {motion.nominal_s:.0f} s a turn", yes)
