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


def write_result(bench: Bench) -> StepReport:
    """Write the profile of the rig, if every step passed.

    Raises:
        ConfigError: a step is missing, or measured no value. StorageError: the profile cannot be written.
    """
    reports = {name: bench.report(name) for name in MEASURING}
    missing = [name for name, report in reports.items() if report is None]
    if missing:
        raise ConfigError(f"not done yet: {', '.join(missing)}", f"Do the step {missing[0]} next.")
    rows = [_verdict(report) for report in reports.values() if report is not None]
    if any(row.level is Level.FAIL for row in rows):
        return reported("result", rows)
    profile = _profile(bench, [report for report in reports.values() if report is not None])
    path = write_profile(profile, data_folder())
    rows.append(Row("profile", Level.PASS, text=str(path)))
    return reported("result", rows)


def _verdict(report: StepReport) -> Row:
    failed = [row.name for row in report.rows if row.level is Level.FAIL]
    if not failed:
        return Row(report.step, Level.PASS, text=report.date_utc)
    return Row(
        report.step,
        Level.FAIL,
        text=f"failed: {', '.join(failed)}",
        advice=f"Repeat the step {report.step}.",
        code=report.step,
    )


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
