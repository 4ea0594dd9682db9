"""Writes the section of an attacker into docs/results/robustness.md, from its last run with --page."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from tests.benchmarks.provenance import ROOT, made_with
from tests.benchmarks.tables import Table, write

PAGE = ROOT / "docs" / "results" / "robustness.md"


def write_section(
    title: str, text: str, seeds: str, columns: Sequence[str], rows: Sequence[Sequence[object]]
) -> None:
    """Put what was attacked, with the command, commit, machine and date, in place of the older section."""
    write(PAGE, Path(sys.argv[0]).stem, title, made_with(seeds), [Table(columns, rows, text)])
