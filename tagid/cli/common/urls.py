"""Device URLs as they are printed: each alone on its line, to be copied, with the command that takes it."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.text import Text


def to_copy(urls: Sequence[str], command: str) -> Text:
    """The URLs, one to a line, and the next command with the first of them in the place of {}.

    Lines are not wrapped, so that a URL is copied whole.
    """
    from rich.text import Text

    lines = [*urls, "next: " + next_command(urls[0], command)] if urls else []
    return Text("\n".join(lines), no_wrap=True, overflow="ignore")


def next_command(url: str, command: str) -> str:
    """A command with a URL in the place of {}, quoted for a shell where that is needed.

    >>> next_command("roomba+serial:///dev/ttyUSB1?step=2", "tagid motion info {}")
    "tagid motion info 'roomba+serial:///dev/ttyUSB1?step=2'"
    """
    return command.format(shlex.quote(url))
