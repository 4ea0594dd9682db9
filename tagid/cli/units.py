"""Types of options that take a number in a unit: `--axis-distance 1.0`, `100cm` or `1000mm`."""

from __future__ import annotations

from collections.abc import Callable

import typer

from tagid.query import UNITS, quantity


def _in(unit: str) -> Callable[[str | float], float]:
    """The parser of an option whose value is in a unit; the help shows it as a float."""

    def number(text: str | float) -> float:
        try:
            return quantity(text, unit) if isinstance(text, str) else text
        except ValueError:
            raise typer.BadParameter(
                f"{str(text)[:40]!r} is not a number, in {unit} or with its unit: {', '.join(UNITS[unit])}."
            ) from None

    number.__name__ = "float"
    return number


METRES = _in("m")
MILLIMETRES = _in("mm")
SECONDS = _in("s")
PICOSECONDS = _in("ps")
NANOSECONDS = _in("ns")
