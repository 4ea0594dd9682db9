"""The steps in their order, what each needs, and which is next."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from tagid.commissioning.bench import Bench
from tagid.commissioning.card import read_card
from tagid.commissioning.link import watch_link
from tagid.commissioning.result import verdict, write_result
from tagid.commissioning.room import watch_room
from tagid.commissioning.rows import Level, StepReport
from tagid.commissioning.target import measure_target
from tagid.commissioning.turning import measure_turning
from tagid.errors import UsageError


@dataclass(frozen=True)
class Step:
    """One step of the commissioning.

    Attributes:
        name: as the command line takes it.
        title: for people.
        prepare: what the person does first; empty for nothing.
        run: measures and reports.
        turns: whether the table turns, which moves a device if one is configured.
    """

    name: str
    title: str
    prepare: str
    run: Callable[[Bench], StepReport]
    turns: bool = False


STEPS: Final = (
    Step("link", "Link", "", watch_link),
    Step(
        "room", "Empty room", "Clear the table, switch it off, and keep everybody out of the beam", watch_room
    ),
    Step(
        "target",
        "Reference target",
        "Put the reference target on the table and measure its distance",
        measure_target,
    ),
    Step(
        "turning",
        "Turning",
        "Put the test card on the table, with its print upwards, and switch the table on",
        measure_turning,
        turns=True,
    ),
    Step("card", "Test card", "", read_card, turns=True),
    Step("result", "Result", "", write_result),
)


def step_named(name: str) -> Step:
    """The step of a name. Raises UsageError."""
    for step in STEPS:
        if step.name == name:
            return step
    raise UsageError(f"there is no step {name[:40]!r}", f"Use {', '.join(step.name for step in STEPS)}.")


def reports_by_title(bench: Bench) -> list[tuple[str, StepReport]]:
    """The title and report of every step that was done. Raises StorageError, ConfigError."""
    return [(step_named(name).title, report) for name, report in bench.reports().items()]


def next_step(bench: Bench) -> Step:
    """The first step that does not stand; the last one if all do. Raises StorageError, ConfigError."""
    reports = bench.reports()
    return next((step for step in STEPS if verdict(reports, step.name).level is Level.FAIL), STEPS[-1])


def run_step(step: Step, bench: Bench) -> StepReport:
    """Run a step and store its report; the raised errors are those of the step."""
    report = step.run(bench)
    bench.keep(report)
    return report


def goes_on(step: Step, bench: Bench) -> Step | None:
    """The step after one that has passed, if it is the next to be done and nobody has to prepare it.

    Raises StorageError, ConfigError.
    """
    following = next_step(bench)
    is_after = STEPS.index(following) == STEPS.index(step) + 1
    return following if is_after and not following.prepare else None
