"""What the pages of a commissioning say, in whatever form."""

from __future__ import annotations

from collections.abc import Sequence

from tagid.commissioning.rows import StepReport
from tagid.rig import RigProfile


def heading(reports: Sequence[tuple[str, StepReport]], profile: RigProfile | None) -> tuple[str, str]:
    """(head line, sentence about the rig or nothing) of a page."""
    passed = all(report.passed for _, report in reports) and profile is not None
    head = "The rig is commissioned" if passed else "The rig is not commissioned yet"
    return head, "" if profile is None else f"Rig of {profile.day}, radar {profile.radar.serial}."


def plain(text: str) -> str:
    """A sentence without the marks around commands and settings."""
    return text.replace("`", "")
