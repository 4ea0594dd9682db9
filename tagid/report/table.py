"""Tables in a terminal, in which no name, file or command is cut."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING

from rich.measure import Measurement
from rich.table import Table as RichTable

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType, RenderResult

_ANY_WIDTH = 100_000


class Table(RichTable):
    """A table that is wider than the terminal rather than cut a word: text is wrapped at blanks only.

    Args:
        heads: of the columns; without any, there is no line of heads.
        rows: of the table; more may be added.
        wraps: heads of the columns whose text is wrapped; None: all.
    """

    def __init__(
        self,
        *heads: str,
        rows: Iterable[Sequence[RenderableType]] = (),
        wraps: Collection[str] | None = None,
    ) -> None:
        super().__init__(*heads, box=None, show_header=bool(heads))
        for column in self.columns:
            column.no_wrap = wraps is not None and column.header not in wraps
        for row in rows:
            self.add_row(*row)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        unlimited = options.update(max_width=_ANY_WIDTH)
        for column in self.columns:
            cells = [Measurement.get(console, unlimited, cell) for cell in (column.header, *column.cells)]
            column.min_width = max(cell.maximum if column.no_wrap else cell.minimum for cell in cells)
        least = Measurement.get(console, unlimited, self).minimum
        yield from super().__rich_console__(console, options.update(max_width=max(least, options.max_width)))
