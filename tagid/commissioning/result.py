"""Step 6, the result: the steps as one rig profile."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, Final

from tagid.commissioning.bench import STEP_NAMES, Bench, reported
from tagid.commissioning.rows import Level, Row, StepReport
from tagid.config import data_folder
from tagid.errors import ConfigError
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

    Args:
        reports: of the steps that were done, by their names.
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
