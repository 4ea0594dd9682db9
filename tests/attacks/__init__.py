"""Attacks on the whole program, one function for each finding, run by `python -m tests.benchmarks attacks`.

Each module holds the attacks on one part. An attack uses real processes, sockets and devices at full size and
returns a figure; the short test that guards the same fault in `make test` is named beside it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final


@dataclass(frozen=True)
class Outcome:
    """What an attack came to.

    Attributes:
        figure: what was counted or measured, e.g. "answered 40 of 40".
        held: whether the program behaved as it should.
    """

    figure: str
    held: bool


@dataclass(frozen=True)
class Attack:
    """An attack.

    Attributes:
        finding: short name, e.g. "F8" or "field 18"; with a letter where a finding has several attacks.
        title: the fault, one line.
        before: the figure before it was mended.
        test: the test that guards it, e.g. "tests/e2e/test_station_faults.py::test_name".
        run: the attack; its argument is an empty folder.
    """

    finding: str
    title: str
    before: str
    test: str
    run: Callable[[Path], Outcome]


ATTACKS: Final[list[Attack]] = []


def attack(
    finding: str, title: str, *, before: str, test: str
) -> Callable[[Callable[[Path], Outcome]], Callable[[Path], Outcome]]:
    """Register a function as the attack for a finding, see `Attack`."""

    def register(run: Callable[[Path], Outcome]) -> Callable[[Path], Outcome]:
        ATTACKS.append(Attack(finding, title, before, test, run))
        return run

    return register
