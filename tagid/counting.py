"""Numbers of things in sentences, and names that were meant."""

from __future__ import annotations

from collections.abc import Iterable


def counted(count: int, thing: str) -> str:
    """A number with its noun, which takes an s unless there is one.

    >>> counted(1, "view"), counted(0, "view"), counted(2, "recording")
    ('1 view', '0 views', '2 recordings')
    """
    return f"{count} {thing}" if count == 1 else f"{count} {thing}s"


def meant(name: str, names: Iterable[str]) -> str:
    """The question for the name that is nearest to an unknown one, with a blank after it; "" if none is near.

    >>> meant("helmet120", ["helmet-120", "mine-01"]), meant("x", ["helmet-120"])
    ('Did you mean helmet-120? ', '')
    """
    from difflib import get_close_matches

    return "".join(f"Did you mean {near}? " for near in get_close_matches(name[:80], list(names), 1))


def runs(numbers: Iterable[int]) -> str:
    """Ascending numbers in words, of many the first ten runs.

    >>> runs([20, 21, 22, 40])
    '20 to 22, 40'
    """
    ends: list[list[int]] = []
    for number in numbers:
        if ends and number == ends[-1][1] + 1:
            ends[-1][1] = int(number)
        else:
            ends.append([int(number), int(number)])
    words = [str(first) if first == last else f"{first} to {last}" for first, last in ends[:10]]
    return ", ".join(words) + ", ..." * (len(ends) > 10)
