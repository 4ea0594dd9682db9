"""Refusals of the station; each has a code and an HTTP status (`tagid.station.web`)."""

from __future__ import annotations

from tagid.errors import UsageError


class BusyError(UsageError):
    """A scan or a report is running."""

    code = "busy"


class NoSuchItemError(UsageError):
    """There is no such entry, report or file."""

    code = "not_found"


class NotOperatorError(UsageError):
    """Another browser operates the station, or no browser does."""

    code = "not_operator"


class EnrolmentError(UsageError):
    """The enrolment is not at a step that allows the action."""

    code = "enrolment"
