"""What a step reports: rows, each a number with its standard error, a verdict and what to do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

from tagid.commissioning.pictures import Picture
from tagid.rig import Measured


class Level(StrEnum):
    """Verdict of a row."""

    PASS = "pass"
    NOTE = "note"
    FAIL = "fail"


@dataclass(frozen=True)
class Row:
    """One line of a report.

    Attributes:
        name: what was measured.
        level: pass, fail, or note where nothing is decided.
        value, sigma: the number and its standard error; None where there is none.
        unit: of both.
        text: the verdict in words; empty where the number says all.
        advice: what to do; empty where nothing is to be done.
        code: of a fault, for programs; empty if there is none.
    """

    name: str
    level: Level
    value: float | None = None
    sigma: float | None = None
    unit: str = ""
    text: str = ""
    advice: str = ""
    code: str = ""

    @classmethod
    def judged(
        cls,
        name: str,
        good: bool,
        value: float | None,
        sigma: float | None,
        unit: str,
        text: str,
        advice: str,
        code: str,
    ) -> Row:
        """A row that passes, or else fails with advice and code."""
        if good:
            return cls(name, Level.PASS, value, sigma, unit, text)
        return cls(name, Level.FAIL, value, sigma, unit, text, advice, code)

    @property
    def number(self) -> str:
        """Value, standard error and unit as text."""
        if self.value is None:
            return ""
        digits = 2 if self.sigma is None or self.sigma <= 0 else max(0, min(6, 1 - _exponent(self.sigma)))
        error = "" if self.sigma is None else f" +- {self.sigma:.{digits}f}"
        return f"{self.value:.{digits}f}{error} {self.unit}".rstrip()


@dataclass(frozen=True)
class StepReport:
    """The result of a step.

    Attributes:
        step: its name.
        date_utc: when it ended, ISO 8601.
        rows: lines of the report.
        values: what the profile takes from it, by the names of `tagid.rig.RigProfile`.
        facts: texts and whole numbers that the profile takes from it.
        pulse: samples of the pulse, if the step measured it; its middle is time zero.
        recording: name of the capture file; empty if there is none.
        pictures: drawings of what was measured.
    """

    step: str
    date_utc: str
    rows: tuple[Row, ...]
    values: Mapping[str, Measured] = field(default_factory=dict)
    facts: Mapping[str, str | int] = field(default_factory=dict)
    pulse: tuple[float, ...] = ()
    recording: str = ""
    pictures: tuple[Picture, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether no row failed."""
        return all(row.level is not Level.FAIL for row in self.rows)

    @property
    def faults(self) -> tuple[str, ...]:
        """Codes of the faults found."""
        return tuple(row.code for row in self.rows if row.level is Level.FAIL and row.code)

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {**asdict(self), "passed": self.passed}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> StepReport:
        """The report that `to_json` wrote. Raises KeyError, TypeError, ValueError."""
        given = {name: value for name, value in data.items() if name != "passed"}
        given["rows"] = tuple(Row(**{**row, "level": Level(row["level"])}) for row in given["rows"])
        given["values"] = {name: Measured(**value) for name, value in given["values"].items()}
        given["pulse"] = tuple(given["pulse"])
        given["pictures"] = tuple(Picture.from_json(picture) for picture in given.get("pictures", ()))
        return cls(**given)


def _exponent(value: float) -> int:
    return int(f"{value:e}".partition("e")[2])
