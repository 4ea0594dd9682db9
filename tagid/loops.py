"""The compiled inner loops: which there are, and whether those installed are of this program.

All are optional. Where no compiler was present at installation, or a loop was built from older source, numpy
does the same, several times as slowly; `tagid doctor` says so.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

LOOPS = {
    "tagid.imaging._kernel": 4,
    "tagid.imaging.ats._field": 1,
    "tagid.reading._evidence": 4,
    "tagid.reading._sets": 4,
    "tagid.reading._sheet": 2,
}
"""Modules, and the number of their arguments' version (`ARGUMENTS` in their source)."""


def loop(name: str) -> Any:
    """A compiled module; None where it is missing or of other arguments than this program's."""
    try:
        module = import_module(name)
    except ImportError:  # no compiler at installation
        return None
    return module if getattr(module, "ARGUMENTS", 0) == LOOPS[name] else None


def unusable() -> tuple[str, ...]:
    """Names of the loops that are missing or outdated."""
    return tuple(name for name in LOOPS if loop(name) is None)
