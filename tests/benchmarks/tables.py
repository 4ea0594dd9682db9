"""Tables of a benchmark: printed, and written into a page of docs/results/ or a CSV file beside it.

The text of a page between `<!-- NAME -->` and `<!-- end NAME -->` belongs to the benchmark of that name,
which replaces it as a whole, so that no figure is typed by hand.
"""

from __future__ import annotations

import csv
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tagid.proportion import wilson

LONG = 17
"""A table of more rows is a CSV file, and the page shows a part of it."""
Row = Sequence[object]


@dataclass(frozen=True, eq=False)
class Table:
    """One table of a benchmark.

    Attributes:
        columns, rows: headings, one text of them with " | " between, and cells.
        note: paragraphs above it: the condition, what the columns mean.
        name: of its CSV file after the benchmark's name, where a benchmark has several.
        shown: rows that a page shows of a long table; none of them where it is not given.
        below: paragraphs below it.
        whole: whether the page shows all of it, however long it is.
    """

    columns: Sequence[str]
    rows: Sequence[Row]
    note: str = ""
    name: str = ""
    shown: Callable[[Row], bool] | None = None
    below: str = ""
    whole: bool = False

    @property
    def headings(self) -> Sequence[str]:
        return self.columns.split(" | ") if isinstance(self.columns, str) else self.columns

    @property
    def long(self) -> bool:
        """Whether it is a CSV file."""
        return len(self.rows) > LONG and not self.whole

    def markdown(self, rows: Sequence[Row] | None = None, link: str = "") -> str:
        """The table, or these rows of it and a link to all, between its notes."""
        some = self.rows if rows is None else rows
        lines = [markdown(self.headings), "|" + "---|" * len(self.headings), *map(markdown, some)]
        parts = [self.note, "\n".join(lines) if some else "", link, self.below]
        return "\n\n".join(part.strip() for part in parts if part.strip())

    def on_page(self, file: str) -> str:
        """What the page shows: all of a short table, and of a long one the rows for the page and a link."""
        if not self.long:
            return self.markdown()
        some = [] if self.shown is None else [row for row in self.rows if self.shown(row)]
        return self.markdown(some, f"All {len(self.rows)} rows: [{file}]({file}).")


def markdown(cells: Iterable[object]) -> str:
    """One line of a markdown table."""
    return "| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |"


def write(page: Path, name: str, title: str, made: Sequence[str], tables: Sequence[Table]) -> None:
    """Replace the block of a benchmark in a page, or add it at the end; long tables become CSV files."""
    parts = ["\n".join(made)]
    for table in tables:
        file = "-".join(filter(None, (name, table.name))) + ".csv"
        parts.append(table.on_page(file))
        if table.long:
            with (page.parent / file).open("w", encoding="utf-8", newline="") as out:
                out.write(f"# {' '.join(made)}\n")
                csv.writer(out, lineterminator="\n").writerows([table.headings, *table.rows])
    text = page.read_text(encoding="utf-8") if page.exists() else f"# {title}\n"
    block = f"<!-- {name} -->\n" + "\n\n".join(parts) + f"\n<!-- end {name} -->"
    there = re.compile(rf"<!-- {re.escape(name)} -->\n.*?<!-- end {re.escape(name)} -->", re.DOTALL)
    if there.search(text):
        text = there.sub(lambda _: block, text)
    else:
        text = f"{text.rstrip()}\n\n## {title}\n\n{block}\n"
    page.write_text(text, encoding="utf-8")


def grouped(results: Mapping[Any, Any], key: Callable[[Any], Any]) -> dict[Any, list[Any]]:
    """The results by a key of their jobs, in order."""
    groups = defaultdict(list)
    for job, result in results.items():
        groups[key(job)].append(result)
    return dict(groups)


def column(some: Iterable[Mapping[str, Any]], name: str) -> np.ndarray:
    """One member of some results."""
    return np.array([item[name] for item in some], dtype=float)


def interval(values: np.ndarray, digits: int) -> str:
    """Mean and half-width of the 95 % interval (1.96 standard errors), "-" where nothing is known."""
    known = values[np.isfinite(values)]
    if len(known) == 0:
        return "-"
    if len(known) == 1:
        return f"{known[0]:.{digits}f}"
    half = 1.96 * known.std(ddof=1) / np.sqrt(len(known))
    return f"{known.mean():.{digits}f} ± {half:.{digits}f}"


def rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def share(count: int, total: int) -> str:
    """Per cent with the 95 % Wilson interval."""
    if total == 0:
        return "-"
    sure = wilson(count / total, total)
    return f"{100 * count / total:.1f} ({100 * sure.low:.1f}..{100 * sure.high:.1f})"


def counted(count: int, total: int) -> str:
    """A count with the 95 % Wilson interval of its rate, per cent."""
    if total == 0:
        return "-"
    sure = wilson(count / total, total)
    return f"{count} ({100 * sure.low:.0f} to {100 * sure.high:.0f})"
