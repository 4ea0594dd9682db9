"""What a page of results was made with."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import version
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("TAGID_SHARED", ROOT.parent / "shared"))
"""Folder of recordings, solved responses and models beside the checkout."""


def commit() -> str:
    """The commit that is checked out, with "+" where tracked files differ from it; `TAGID_COMMIT` where the
    sources are not a checkout."""
    if "TAGID_COMMIT" in os.environ:
        return os.environ["TAGID_COMMIT"]

    def git(*words: str) -> str:
        return subprocess.run(["git", "-C", ROOT, *words], capture_output=True, text=True, check=True).stdout

    changed = git("status", "--porcelain", "--untracked-files=no")
    return f"{git('rev-parse', '--short=10', 'HEAD').strip()}{'+' if changed else ''}"


def command() -> str:
    """The command line as it is typed, without the options that write the page."""
    script = Path(sys.argv[0])
    words = [word for word in sys.argv[1:] if word != "--page"]
    if "--write" in words:
        at = words.index("--write")
        folder = at + 1 < len(words) and not words[at + 1].startswith("-")
        del words[at : at + 1 + folder]
    if script.name == "__main__.py":
        name = ".".join(script.resolve().parent.relative_to(ROOT).parts)
        return " ".join(["python -m", name, *words])
    return " ".join(["python", sys.argv[0], *words])


def machine() -> str:
    cores = f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    return f"{platform.machine()}, {cores}, Python {platform.python_version()}, numpy {version('numpy')}"


def made_with(seeds: str) -> list[str]:
    """Lines of a page: command, commit, machine and date, and the seeds as given."""
    return [
        f"Command: `{command()}`. Commit: {commit()}.",
        f"Machine: {machine()}.",
        f"Date: {datetime.now(UTC):%Y-%m-%d}. Seeds: {seeds}.",
    ]


def imported(path: Path) -> Any:
    """A module of a file that no package holds."""
    spec = spec_from_file_location(path.stem, path)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
