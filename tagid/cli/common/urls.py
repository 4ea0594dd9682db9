"""Printed device URLs: each on its own line, for copying, with the next command."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.text import Text


def to_copy(urls: Sequence[str], command: str) -> Text:
    """The URLs, one per line, and the next command with the first of them in place of {}.

    Lines are not wrapped, so that a URL can be copied completely.
    """
    from rich.text import Text

    lines = [*urls, "next: " + next_command(urls[0], command)] if urls else []
    return Text("\n".join(lines), no_wrap=True, overflow="ignore")


def next_command(url: str, command: str) -> str:
    """A command with a URL in place of {}, quoted for a shell if necessary.

    >>> next_command("roomba+serial:///dev/ttyUSB1?step=2", "tagid motion info {}")
    "tagid motion info 'roomba+serial:///dev/ttyUSB1?step=2'"
    """
    return command.format(shlex.quote(url))
