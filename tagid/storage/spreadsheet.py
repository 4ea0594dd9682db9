"""Cells of the CSV files that tagid writes, safe to open in a spreadsheet.

A spreadsheet runs a cell that begins with =, +, - or @ as a formula, and file names and labels are untrusted
(OWASP, "CSV Injection").
"""

from __future__ import annotations

from typing import Any, Final

from tagid.errors import visible

FORMULA_STARTS: Final = ("=", "+", "-", "@")


def cell(value: Any) -> Any:
    """A value for `csv.writer`: control characters are removed, and an apostrophe precedes a formula's start.

    Booleans become true and false; numbers and None are unchanged.

    >>> cell("=1+1"), cell(-1.5), cell(True)
    ("'=1+1", -1.5, 'true')
    """
    if isinstance(value, bool):
        return str(value).lower()
    if not isinstance(value, str):
        return value
    text = visible(value)
    return f"'{text}" if text.lstrip().startswith(FORMULA_STARTS) else text
