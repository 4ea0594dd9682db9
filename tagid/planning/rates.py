"""Expected rates of the reader, interpolated from its measured tables (`rates.json`).

`tests/benchmarks/planning_rates.py` writes the file from the tables of docs/results.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources

from tagid.errors import UsageError
from tagid.proportion import wilson


@dataclass(frozen=True)
class Measured:
    """One row of a table.

    Attributes:
        body: "none", or the body that carried the tag.
        views, snr_db: of the recordings; peak per reflector over the noise of one sample of one view, dB.
        scenes: number of recordings. named, wrong: number named correctly and wrongly.
        enrolled: whether the untagged body was enrolled.
    """

    body: str
    views: int
    snr_db: float
    scenes: int
    named: int
    wrong: int
    enrolled: bool = False


@dataclass(frozen=True)
class Rate:
    """An expected rate with its 95 % interval (Wilson), 0 to 1."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, share: float, scenes: float) -> Rate:
        """The rate of a share of `scenes` recordings."""
        interval = wilson(share, scenes)
        return cls(share, interval.low, interval.high)

    def __str__(self) -> str:
        return f"{100 * self.value:.0f} % ({100 * self.low:.0f} to {100 * self.high:.0f})"


@dataclass(frozen=True)
class Expected:
    """Expected rates of a recording.

    Attributes:
        named, refused, wrong: of tags that are enrolled.
        source: the table.
        scenes: fewest recordings of the table's rows used, to which the intervals refer.
        note: how the recording lies outside the table; "" if inside.
    """

    named: Rate
    refused: Rate
    wrong: Rate
    source: str
    scenes: int
    note: str = ""


@lru_cache(maxsize=1)
def _table() -> tuple[tuple[Measured, ...], dict[str, str]]:
    data = json.loads((resources.files("tagid.planning") / "rates.json").read_text("utf-8"))
    return tuple(Measured(**row) for row in data["rows"]), dict(data["sources"])


def expected(body: str, views: int, snr_db: float, *, enrolled: bool = False) -> Expected:
    """The rates of a recording, linear in SNR between the rows of the table, dB, per reflector in one sample
    of a view.

    Views per turn beyond the largest number in the table add energy: each doubling counts as 3 dB. Between
    numbers of views the rates are linear in their logarithm. The interval is that of the row with the fewest
    scenes. Raises UsageError for a body without a table.
    """
    measured, sources = _table()
    rows = tuple(row for row in measured if row.body == body and row.enrolled == enrolled)
    if not rows:
        known = ", ".join(sorted({row.body for row in measured}))
        raise UsageError(f"no rates were measured on a {'enrolled ' * enrolled + body!r}", f"Use {known}.")
    numbers = sorted({row.views for row in rows})
    note = ""
    if views > numbers[-1]:
        snr_db += 10 * math.log10(views / numbers[-1])
        views = numbers[-1]
    elif views < numbers[0]:
        note = f"the table ends at {numbers[0]} views; with fewer views, fewer tags are named"
        views = numbers[0]
    above = next(n for n in numbers if n >= views)
    below = max(n for n in numbers if n <= views)
    weight = 0.0 if above == below else math.log(views / below) / math.log(above / below)
    first, last = _at(rows, below, snr_db), _at(rows, above, snr_db)
    named = (1 - weight) * first[0] + weight * last[0]
    wrong = (1 - weight) * first[1] + weight * last[1]
    scenes = min(first[2], last[2])
    lowest = min(row.snr_db for row in rows)
    if snr_db < lowest:
        note = f"the table ends at {lowest:g} dB; below it, fewer tags are named"
    return Expected(
        Rate.of(named, scenes),
        Rate.of(max(0.0, 1 - named - wrong), scenes),
        Rate.of(wrong, scenes),
        sources["enrolled" if enrolled else "none" if body == "none" else "bodies"],
        scenes,
        note,
    )


def _at(rows: tuple[Measured, ...], views: int, snr_db: float) -> tuple[float, float, int]:
    """Shares named and wrong at an SNR, and the fewest scenes of the rows used."""
    measured = sorted((row for row in rows if row.views == views), key=lambda row: row.snr_db)
    held = min(max(snr_db, measured[0].snr_db), measured[-1].snr_db)
    low = max((row for row in measured if row.snr_db <= held), key=lambda row: row.snr_db)
    high = min((row for row in measured if row.snr_db >= held), key=lambda row: row.snr_db)
    weight = 0.0 if low is high else (held - low.snr_db) / (high.snr_db - low.snr_db)
    shares = [
        (1 - weight) * a / low.scenes + weight * b / high.scenes
        for a, b in ((low.named, high.named), (low.wrong, high.wrong))
    ]
    return shares[0], shares[1], min(low.scenes, high.scenes)
