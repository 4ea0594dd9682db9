"""What a page of results was made with."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

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
