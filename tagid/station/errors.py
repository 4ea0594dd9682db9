"""Refusals of the station; each has a code and an HTTP status (`tagid.station.requests`)."""

from __future__ import annotations

from tagid.errors import DeviceError, TagidError, UsageError
from tagid.workers import NO_THREAD, Worker


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
    """The enrollment is not at a step that allows the action."""

    code = "enrolment"


class GuessesError(UsageError):
    """Too many pairing codes of one address wait to be compared."""

    code = "too_many_guesses"


class InterlockError(DeviceError):
    """Nothing would stop the motion if the operator is lost."""

    code = "interlock"


class OverloadedError(TagidError):
    """The system allows no further thread, or no memory."""

    code = "overloaded"


class UnexpectedError(TagidError):
    """A fault of the program."""


def begin(worker: Worker) -> None:
    """Start a thread. Raises OverloadedError."""
    try:
        worker.start()
    except RuntimeError as error:
        raise reported(error) from error


def reported(error: BaseException) -> TagidError:
    """Any exception as an error that can be shown."""
    if isinstance(error, TagidError):
        return error
    if isinstance(error, MemoryError) or str(error) == NO_THREAD:
        return OverloadedError(
            "the computer has no memory or thread left",
            "End other programs, or raise the limits on processes and memory.",
        )
    return UnexpectedError(f"unexpected {type(error).__name__}: {error}", "This is a bug in tagid.")
