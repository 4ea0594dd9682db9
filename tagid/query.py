"""Options of device URLs and emulated scenes as typed values: numbers are bounded where they come in."""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from typing import Final, overload

from tagid.errors import UsageError

MAX_SEED: Final = 2**53
"""Largest seed: beyond it, a number in a URL is not read exactly."""

UNITS: Final = {
    "m": {"m": 1.0, "cm": 100.0, "mm": 1000.0},
    "mm": {"mm": 1.0, "cm": 0.1, "m": 1e-3},
    "s": {"s": 1.0, "ms": 1000.0, "min": 1 / 60},
    "ps": {"ps": 1.0, "ns": 1e-3},
    "ns": {"ns": 1.0, "ps": 1000.0},
}
"""How many of each unit make one of the unit in which a value is stored."""
_NUMBER_AND_UNIT = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*([a-z]+)\s*")


def quantity(text: str, unit: str) -> float:
    """A number in a unit, from text that may state another unit of its kind.

    Raises ValueError for other text.

    >>> quantity("100cm", "m"), quantity("0.35", "m"), quantity("8 ns", "ps")
    (1.0, 0.35, 8000.0)
    """
    stated = _NUMBER_AND_UNIT.fullmatch(text)
    if stated and stated[2] in UNITS.get(unit, {}):
        return float(stated[1]) / UNITS[unit][stated[2]]
    return float(text)


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
    """Two lengths, m, from the text of an option. Raises UsageError.

    >>> parse_point("--centre", "0.004,-2mm")
    (0.004, -0.002)
    """
    try:
        x, y = (quantity(part, "m") for part in text.split(","))
    except ValueError:
        x = y = math.nan
    if not (math.isfinite(x) and math.isfinite(y)):
        raise UsageError(
            f"{option} is {text[:80]!r}, not two numbers", f"Give metres, e.g. {option} 0.11,-0.02."
        )
    return x, y
