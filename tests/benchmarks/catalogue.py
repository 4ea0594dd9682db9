"""Every benchmark: what it measures, how long it takes, what it needs, and the page that shows it."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Benchmark:
    """One benchmark.

    Attributes:
        name: as it is typed.
        summary: what it measures, one line.
        minutes: about so many of one core.
        page: of docs/results/, with the heading `title`.
        work: module and function, which yields tables.
        needs: names of `needs.NEEDS`.
        one_thread: whether numpy is kept to one thread.
    """

    name: str
    summary: str
    minutes: int
    page: str
    work: str
    title: str = ""
    needs: tuple[str, ...] = ()
    one_thread: bool = True


def _load() -> dict[str, Benchmark]:
    text = Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
    return {
        name: Benchmark(name, **{**entry, "needs": tuple(entry.get("needs", ()))})
        for name, entry in tomllib.loads(text).items()
    }


BENCHMARKS = _load()
"""By name, in the order of `list`."""
