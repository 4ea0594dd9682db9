"""Step 6, the result: the steps as one rig profile."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any, Final

from tagid.commissioning.bench import Bench, reported
from tagid.commissioning.rows import Level, Row, StepReport
from tagid.config import data_folder
from tagid.errors import ConfigError
from tagid.rig import Radar, RigProfile, write_profile

MEASURING: Final = ("link", "room", "target", "turning", "card")
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
    reports = [report for name in MEASURING if (report := bench.report(name)) is not None]
    missing = [name for name in MEASURING if name not in {report.step for report in reports}]
    if missing:
        raise ConfigError(f"not done yet: {', '.join(missing)}", f"Do the step {missing[0]} next.")
    rows = [verdict(bench, name) for name in MEASURING]
    if any(row.level is Level.FAIL for row in rows):
        return reported("result", rows)
    path = write_profile(_profile(bench, reports), data_folder())
    rows.append(Row("profile", Level.PASS, text=str(path)))
    return reported("result", rows)


def verdict(bench: Bench, name: str) -> Row:
    """Whether a step stands: it passed, later than the steps that it uses, with the radar of the link.

    Raises StorageError, ConfigError.
    """
    report, link = bench.report(name), bench.report("link")
    if report is None:
        return _repeat(name, "not done")
    if failed := [row.name for row in report.rows if row.level is Level.FAIL]:
        return _repeat(name, f"failed: {', '.join(failed)}")
    used = [(step, bench.report(step)) for step in _USES.get(name, ())]
    if later := [step for step, other in used if other is not None and other.date_utc > report.date_utc]:
        return _repeat(name, f"older than {', '.join(later)}")
    serial, linked = report.facts.get("serial"), None if link is None else link.facts.get("serial")
    if None not in (serial, linked) and str(serial) != str(linked):
        return _repeat(name, f"of radar {serial}, the link is to {linked}")
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
