"""Shared by the commands of `tagid motion`: the selected device, and a table of its properties."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from tagid.config import load_config
from tagid.errors import UsageError
from tagid.secret import MotionUrl

if TYPE_CHECKING:
    from rich.table import Table

    from tagid.motion.driven import DrivenMotion

Url = Annotated[
    MotionUrl | None,
    typer.Argument(
        help="roomba+serial:///dev/ttyUSB1, roomba+ble://NAME, ...; default: motion.url.",
        parser=MotionUrl,
        metavar="[URL]",
    ),
]


def driven(url: MotionUrl | None, stopping: bool = False) -> DrivenMotion:
    """The device of a URL or of the configuration. Raises UsageError if it is not a commanded device.

    With `stopping` it is only to be stopped, which no file of the user may prevent.
    """
    from tagid.motion.driven import DrivenMotion
    from tagid.motion.urls import EXAMPLES, open_motion

    if url is None or not stopping:
        url = load_config({"motion.url": url}, tolerant=stopping)["motion.url"]
    device = open_motion(url, stopping)
    if not isinstance(device, DrivenMotion):
        raise UsageError(
            f"{url} is not a commanded device",
            f"Give one of {', '.join(name for name in EXAMPLES if '+' in name)}.",
        )
    return device


def facts_table(facts: dict[str, Any]) -> Table:
    """Two columns."""
    from rich.table import Table

    table = Table(box=None, show_header=False)
    for key, value in facts.items():
        shown = ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else value
        shown = f"{shown:.4g}" if isinstance(shown, float) else str(shown)
        table.add_row(key.replace("_", " "), shown)
    return table
