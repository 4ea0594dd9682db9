"""Writes the section of an attacker into docs/results/robustness.md, from its last run with --page."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.benchmarks.provenance import ROOT, made_with
from tests.benchmarks.tables import Table, write

PAGE = ROOT / "docs" / "results" / "robustness.md"


@dataclass(frozen=True)
class Section:
    """What one attacker has to report.

    Attributes:
        title: heading, the same in every run.
        text: what was attacked, and what would be a fault.
        seeds: of the run.
        columns, rows: the table.
    """

    title: str
    text: str
    seeds: str
    columns: Sequence[str]
    rows: Sequence[Sequence[object]]


def write_section(section: Section) -> None:
    """Put a section with its command, commit, machine and date into the page, in place of an older one."""
    table = Table(section.columns, section.rows, section.text)
    write(PAGE, Path(sys.argv[0]).stem, section.title, made_with(section.seeds), [table])
