"""The steps in their order, what each needs, which is next, and their result: one rig profile."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

from tagid.commissioning.bench import STEP_NAMES, Bench, reported
from tagid.commissioning.card import read_card
from tagid.commissioning.link import watch_link
from tagid.commissioning.room import watch_room
from tagid.commissioning.rows import Level, Row, StepReport
from tagid.commissioning.target import measure_target
from tagid.commissioning.turning import measure_turning
from tagid.config import data_folder
from tagid.errors import ConfigError, UsageError
from tagid.rig import Radar, RigProfile, write_profile

MEASURING: Final = STEP_NAMES[:-1]
"""Steps that the profile is made of, in their order."""
_USES: Final = {
    "target": ("room",),
    "turning": ("target",),
    "card": ("target", "turning"),
    "result": MEASURING,
}
"""Steps whose values a step takes: repeated later, they make it out of date."""


def write_result(bench: Bench) -> StepReport:
    """Write the profile of the rig, if every step stands.

    Raises:
        ConfigError: a step is missing, or measured no value. StorageError: the profile cannot be written.
    """
    reports = bench.reports()
    missing = [name for name in MEASURING if name not in reports]
    if missing:
        raise ConfigError(f"not done yet: {', '.join(missing)}", f"Do the step {missing[0]} next.")
    rows = [verdict(reports, name) for name in MEASURING]
    if any(row.level is Level.FAIL for row in rows):
        return reported("result", rows)
    path = write_profile(_profile(bench, [reports[name] for name in MEASURING]), data_folder())
    rows.append(Row("profile", Level.PASS, text=str(path)))
    return reported("result", rows)


def verdict(reports: Mapping[str, StepReport], name: str) -> Row:
    """Whether a step stands: it passed, later than the steps that it uses, with the radar of the link.
    `reports` are of the steps that were done, by their names.
    """
    report = reports.get(name)
    if report is None:
        return _repeat(name, "not done")
    if failed := [row.name for row in report.rows if row.level is Level.FAIL]:
        return _repeat(name, f"failed: {', '.join(failed)}")
    used = [reports[step] for step in _USES.get(name, ()) if step in reports]
    if later := [other.step for other in used if other.date_utc > report.date_utc]:
        return _repeat(name, f"older than {', '.join(later)}")
    radars = [some.facts.get("serial") for some in (report, reports.get("link")) if some is not None]
    if len({str(serial) for serial in radars if serial is not None}) > 1:
        return _repeat(name, f"of radar {radars[0]}, the link is to {radars[1]}")
    return Row(name, Level.PASS, text=report.date_utc)


def _repeat(name: str, text: str) -> Row:
    return Row(name, Level.FAIL, text=text, advice=f"Repeat the step {name}.", code=name)


def _profile(bench: Bench, reports: list[StepReport]) -> RigProfile:
    values: dict[str, Any] = {}
    facts: dict[str, Any] = {}
    for report in reports:
        values |= report.values
        facts |= report.facts
    pulse = bench.pulse()
    try:
        radar = Radar(
            int(facts["serial"]),
            str(facts["package"]),
            int(facts["antenna_mode"]),
            int(facts["transmit_gain"]),
            int(facts["integration"]),
        )
        if pulse is None:
            raise KeyError("pulse")
        now = datetime.now(UTC).isoformat(timespec="seconds")
        return RigProfile(now, radar, direction=int(facts["direction"]), pulse=pulse, **values)
    except (KeyError, TypeError) as error:
        raise ConfigError(f"the steps did not measure every value: {error}", "Repeat them.") from None


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
