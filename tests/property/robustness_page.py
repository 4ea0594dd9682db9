"""Writes docs/results/robustness.md: one section for each attacker, from its last run with --page."""

from __future__ import annotations

import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "results" / "robustness.md"
_TITLE = """# Robustness

Long runs of attackers against the program, each with what it counted. Every command writes its own section
when it is given `--page`. The parsers under coverage-guided fuzzing have [a page of their own](fuzzing.md).

- Command: that of each section, such as `python tests/property/attack_signals.py --tries 500`
- Commit: that of each section; a plus marks changes that were not committed
- Machine: that of each section
- Date: that of each section
- Seeds: those of each section
"""


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
    page = PAGE.read_text() if PAGE.exists() else _TITLE
    others = [part for part in re.split(r"^(?=## )", page, flags=re.M)[1:] if part.strip()]
    others = [part for part in others if not part.startswith(f"## {section.title}\n")]
    parts = sorted([*others, _rendered(section)])
    PAGE.write_text("\n".join([_TITLE, *(part.rstrip() + "\n" for part in parts)]))


def _rendered(section: Section) -> str:
    script = Path(sys.argv[0]).resolve().relative_to(ROOT)
    words = shlex.join(["python", str(script), *(word for word in sys.argv[1:] if word != "--page")])
    lines = [
        f"## {section.title}\n",
        f"- Command: `{words}`",
        f"- Commit: {_commit()}",
        f"- Machine: {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, "
        f"numpy {numpy.__version__}",
        f"- Date: {datetime.now(UTC):%Y-%m-%d}",
        f"- Seeds: {section.seeds}\n",
        f"{section.text}\n",
        f"| {' | '.join(section.columns)} |",
        f"|{'---|' * len(section.columns)}",
        *(f"| {' | '.join(map(str, row))} |" for row in section.rows),
    ]
    return "\n".join(lines) + "\n"


def _commit() -> str:
    """The commit, with a plus where the program or the attackers differ from it."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True).stdout.strip()

    changed = git("status", "--porcelain", "--", "tagid", "tests")
    return f"{git('rev-parse', '--short=10', 'HEAD')}{'+' if changed else ''}"
