"""What a page of results was made with."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]


def commit() -> str:
    """The commit that is checked out, with "+" where tracked files differ from it; `TAGID_COMMIT` where the
    sources are not a checkout."""
    if "TAGID_COMMIT" in os.environ:
        return os.environ["TAGID_COMMIT"]

    def git(*words: str) -> str:
        return subprocess.run(["git", "-C", ROOT, *words], capture_output=True, text=True, check=True).stdout

    changed = git("status", "--porcelain", "--untracked-files=no")
    return f"{git('rev-parse', '--short=10', 'HEAD').strip()}{'+' if changed else ''}"


def made_with(seeds: str) -> list[str]:
    """Lines of a page: command, commit, machine and date, and the seeds as given."""
    return [
        f"Command: `python {' '.join(sys.argv)}`. Commit: {commit()}.",
        f"Machine: {platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}.",
        f"Date: {datetime.now(UTC):%Y-%m-%d}. Seeds: {seeds}.",
    ]


def method(docstring: str | None) -> list[str]:
    """Lines of a page: what a script says of its method, between its first line and its command."""
    return str(docstring).split("\n\n", 1)[1].split("    python tests")[0].strip().splitlines()


def page(title: str, seeds: str, docstring: str | None) -> list[str]:
    """Lines with which a page begins: its title, what it was made with, and the method of its script."""
    return [f"# {title}", "", *made_with(seeds), "", *method(docstring), ""]


def publish(lines: list[str], folder: Path | None, name: str) -> None:
    """Print a page, and write it to a folder, if there is one."""
    text = "\n".join(lines) + "\n"
    print(text)
    if folder:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
