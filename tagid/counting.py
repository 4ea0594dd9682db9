"""Numbers of things in sentences."""

from __future__ import annotations


def counted(count: int, thing: str) -> str:
    """A number with its noun, which takes an s unless there is one.

    >>> counted(1, "view"), counted(0, "view"), counted(2, "recording")
    ('1 view', '0 views', '2 recordings')
    """
    return f"{count} {thing}" if count == 1 else f"{count} {thing}s"
