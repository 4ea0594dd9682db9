"""Options of device URLs and emulated scenes as typed values: numbers are bounded where they come in."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Final, overload

from tagid.errors import UsageError

MAX_SEED: Final = 2**53
"""Largest seed: beyond it, a number in a URL is not read exactly."""


class Query(ABC):
    """Options by name; each is taken once, and `done` rejects the remaining ones.

    Attributes:
        given: options not yet taken.
    """

    given: dict[str, str]

    @abstractmethod
    def wrong(self, why: str) -> UsageError:
        """The error that names the given text and why it is wrong."""

    @overload
    def number(self, name: str, default: float, low: float, high: float) -> float: ...

    @overload
    def number(self, name: str, default: None, low: float, high: float) -> float | None: ...

    def number(self, name: str, default: float | None, low: float, high: float) -> float | None:
        """A number within bounds; the default if it is not given. Raises UsageError."""
        text = self.given.pop(name, None)
        return default if text is None else self.checked(name, text, low, high)

    def whole(self, name: str, default: int, low: int, high: int) -> int:
        """A whole number within bounds; the default if it is not given. Raises UsageError."""
        value = self.number(name, float(default), low, high)
        if not value.is_integer():
            raise self.wrong(f"{name} is {value:g}, not a whole number")
        return int(value)

    def checked(self, name: str, text: str, low: float, high: float) -> float:
        """The number in a text, finite and within bounds. Raises UsageError."""
        try:
            value = float(text)
        except ValueError:
            raise self.wrong(f"{name} is {text[:50]!r}, not a number") from None
        if not (math.isfinite(value) and low <= value <= high):
            raise self.wrong(f"{name} is {text[:50]}, expected {low:g} to {high:g}")
        return value

    def text(self, name: str, default: str | None = None) -> str | None:
        """A text."""
        return self.given.pop(name, default)

    def done(self) -> None:
        """Raise UsageError for an option that was not taken."""
        if self.given:
            raise self.wrong(f"option {min(self.given)[:50]!r} is unknown")


def parse_point(option: str, text: str) -> tuple[float, float]:
    """Two numbers, e.g. X,Y in metres, from the text of an option. Raises UsageError.

    >>> parse_point("--centre", "0.004,-0.002")
    (0.004, -0.002)
    """
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        x = y = math.nan
    if not (math.isfinite(x) and math.isfinite(y)):
        raise UsageError(
            f"{option} is {text[:80]!r}, not two numbers", f"Give metres, e.g. {option} 0.11,-0.02."
        )
    return x, y
