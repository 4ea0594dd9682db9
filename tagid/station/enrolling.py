"""Enrolling an object at the station: its captures, what disagrees, the proposal, storing and undoing.

One enrollment at a time. Its captures are ordinary scans of the station; after each one all captures so far
are measured by the same code as in `tagid enroll`. Thread-safe: captures are added by the thread of their
scan.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from tagid.enrolling.enrollment import Basis
from tagid.enrolling.registry import Registry
from tagid.errors import RegistryError, TagidError, UsageError
from tagid.pipeline.enrollment import (
    LayoutProposal,
    Measured,
    Prepared,
    Sighted,
    SignatureProposal,
    measure,
    propose_layout,
    propose_signature,
    sight,
)
from tagid.station.errors import EnrolmentError, reported
from tagid.storage.spreadsheet import FORMULA_STARTS
from tagid.tags.layouts.layout import Layout

if TYPE_CHECKING:
    from tagid.capture import Capture
    from tagid.pipeline.answer import Identification
    from tagid.pipeline.settings import ImagingSettings

NEEDED = 3
"""Captures before an object can be enrolled: fewer do not determine the scatter of its positions."""
MOST = 8
"""Captures of one enrollment; each keeps its scans in memory."""
_TRIAL = ((0.1, 0.0), (-0.1, 0.0))


@dataclass(frozen=True)
class Subject:
    """What is enrolled: name, kind ("helmet", "container" or "other") and a description, which may be empty.

    Raises UsageError for an invalid name, kind or label.
    """

    name: str
    kind: str = "other"
    label: str = ""

    def __post_init__(self) -> None:
        Layout(self.name, _TRIAL, self.kind, label=self.label)  # type: ignore[arg-type]
        if self.label.lstrip().startswith(FORMULA_STARTS):
            raise UsageError(
                f"the label begins with {self.label.lstrip()[0]!r}", "Begin it with a letter or digit."
            )


@dataclass(frozen=True, eq=False)
class Taken:
    """A capture of the enrollment.

    Attributes:
        number: counts the captures of the enrollment.
        answer: how it was read: an object that is not enrolled is unknown.
        sighted: its reflectors; None if they cannot be determined, and why not in `error`.
    """

    number: int
    path: Path
    answer: Identification
    sighted: Sighted | None
    error: TagidError | None = None


@dataclass(frozen=True)
class Stored:
    """An enrolled object, the registry version after that, and whether it has positions for a template."""

    name: str
    registry_version: int
    has_layout: bool


@dataclass(frozen=True, eq=False)
class EnrolmentState:
    """State of the enrollment.

    Attributes:
        subject: what is enrolled; None if there is no enrollment.
        captures: of the object, the oldest first.
        measuring: whether captures are being measured now.
        trouble: what disagrees between the captures; None if nothing does.
        measured: the result of measuring; None before there is one.
        proposal: what would be stored; None if something disagrees or captures are missing.
        stored: the last enrolled object, until the next enrollment begins.
        undone: name of the object whose enrollment was just undone; empty if none.
    """

    subject: Subject | None = None
    captures: tuple[Taken, ...] = ()
    measuring: bool = False
    trouble: TagidError | None = None
    measured: Measured | None = None
    proposal: LayoutProposal | SignatureProposal | None = None
    stored: Stored | None = None
    undone: str = ""


class Enrolling:
    """The enrollment of one object after another; `state` is the newest state."""

    def __init__(self, registry: Callable[[], Registry], imaging: Callable[[], ImagingSettings]) -> None:
        self._registry = registry
        self._imaging = imaging
        self._lock = threading.Lock()
        self.state = EnrolmentState()
        self._count = 0
        self._begun = 0

    def describe(self, subject: Subject) -> None:
        """Begin an enrollment, or change the name, kind or label of the current one.

        Raises RegistryError if the name is taken, EnrolmentError while captures are measured.
        """
        contents = self._registry().contents()
        taken = {layout.name for layout in contents.layouts}
        taken |= {signature.name for signature in contents.signatures if signature.kind == "object"}
        if subject.name in taken:
            raise RegistryError(
                f"an object named {subject.name} is already enrolled",
                "Choose another name, or remove the old entry with `tagid layouts remove`.",
            )
        with self._alone() as before:
            if before.subject is None:
                self._count = 0
                self._begun += 1
                self.state = EnrolmentState(subject)
            else:
                self.state = replace(before, subject=subject, proposal=None)
                self._measure()

    def cancel(self) -> None:
        """End the enrollment; the files of its captures are kept. Raises EnrolmentError while measuring."""
        with self._alone():
            self.state = EnrolmentState()

    def expect(self) -> tuple[str, Callable[[Path, Capture, Identification], None]]:
        """The note of the next capture, and what to call with its file, itself with angles, and its answer.

        Raises EnrolmentError if no capture can be added.
        """
        state = self.state
        if state.subject is None:
            raise EnrolmentError("no enrollment was begun", "Enter the name of the object first.")
        if state.measuring:
            raise _busy()
        if len(state.captures) >= MOST:
            raise EnrolmentError(f"there are {MOST} captures already", "Remove one that disagrees.")
        note = f"enrolling {state.subject.name}, capture {self._count + 1}"
        return note, partial(self._add, self._begun)

    def _add(self, begun: int, path: Path, capture: Capture, answer: Identification) -> None:
        """Add a recorded capture with its angles, and measure; errors become the state's trouble.

        A capture of an enrollment that was ended while it was recorded is of another object and not added.
        """
        with self._alone(wait=True) as before:
            if before.subject is None or begun != self._begun:
                return
            self._count += 1
            self.state = replace(before, measuring=True)
            taken = self._sighted(Prepared(f"capture {self._count}", capture), path, answer)
            self.state = replace(self.state, captures=(*before.captures, taken))
            self._measure()

    def _sighted(self, prepared: Prepared, path: Path, answer: Identification) -> Taken:
        try:
            return Taken(self._count, path, answer, sight(prepared, self._imaging()))
        except TagidError as error:
            return Taken(self._count, path, answer, None, error)

    def drop(self, number: int) -> None:
        """Remove a capture from the enrollment, and measure the others; its file is kept.

        Raises EnrolmentError if there is no such capture, or while measuring.
        """
        with self._alone() as before:
            kept = tuple(capture for capture in before.captures if capture.number != number)
            if len(kept) == len(before.captures):
                raise EnrolmentError(f"there is no capture {number}", "Reload the page.")
            self.state = replace(before, captures=kept)
            self._measure()

    def store(self, force: bool = False) -> Stored:
        """Enroll the object; by force despite a conflict, and in place of an entry of the same name.

        Raises:
            EnrolmentError: something disagrees, or captures are missing.
            LayoutConflictError, RegistryError: it is too close to another, or its name is taken.
            StorageError: the registry cannot be written.
        """
        with self._alone() as before:
            proposal = before.proposal
            if proposal is None or before.subject is None:
                raise EnrolmentError(
                    "the object is not ready to be enrolled", "Record the captures that are missing."
                )
            error = proposal.taken or proposal.conflict
            if error is not None and not force:
                raise error
            source = f"station, {len(before.captures)} captures"
            if isinstance(proposal, LayoutProposal):
                _, version = proposal.store(self._registry(), source, force)
            else:
                version = proposal.store(self._registry(), source, force)
            done = Stored(before.subject.name, version, isinstance(proposal, LayoutProposal))
            self.state = EnrolmentState(stored=done)
            return done

    def undo(self) -> None:
        """Undo the last enrollment of the station.

        Raises EnrolmentError if there is none, or if the registry was changed since.
        """
        with self._alone() as before:
            done = before.stored
            if done is None:
                raise EnrolmentError("there is no enrollment to undo")
            registry = self._registry()
            changed = EnrolmentError(
                "the registry was changed since",
                f"Remove the entry with `tagid layouts remove {done.name}`.",
            )
            if registry.version != done.registry_version:
                raise changed
            if done.name not in registry.undo().removed:
                # Another program changed the registry at this moment: restore what was just undone.
                registry.redo()
                raise changed
            self.state = EnrolmentState(undone=done.name)

    def _measure(self) -> None:
        """Measure the captures and compare the result with the registry; the lock is held."""
        state = self.state
        self.state = replace(state, measuring=True, trouble=None, measured=None, proposal=None)
        result = replace(state, measuring=False, trouble=None, measured=None, proposal=None)
        try:
            result = self._measured(result)
        except TagidError as error:
            result = replace(result, trouble=error)
        except Exception as error:
            logging.getLogger("tagid").debug("measuring", exc_info=True)
            result = replace(result, trouble=reported(error))
        finally:
            self.state = result

    def _measured(self, state: EnrolmentState) -> EnrolmentState:
        subject = state.subject
        if subject is None or not state.captures:
            return state
        bad = next((capture for capture in state.captures if capture.sighted is None), None)
        if bad is not None and bad.error is not None:
            raise bad.error
        imaging = self._imaging()
        usable = [capture.sighted for capture in state.captures if capture.sighted is not None]
        measured = measure(subject.name, usable, imaging)
        if len(usable) < NEEDED:
            return replace(state, measured=measured)
        contents = self._registry().contents()
        proposal: LayoutProposal | SignatureProposal
        if measured.estimate is not None:
            layout = replace(measured.estimate.layout, kind=subject.kind, label=subject.label)
            proposal = propose_layout(contents, layout, measured, Basis(imaging.direction_known))
        else:
            assert measured.joint is not None
            signature = replace(measured.joint.signature, label=subject.label[:200])
            proposal = propose_signature(contents, signature)
        return replace(
            state, measured=measured, proposal=proposal, trouble=proposal.taken or proposal.conflict
        )

    @contextmanager
    def _alone(self, wait: bool = False) -> Iterator[EnrolmentState]:
        """Hold the lock. Raises EnrolmentError if captures are being measured, unless it waits."""
        if not self._lock.acquire(blocking=wait):
            raise _busy()
        try:
            yield self.state
        finally:
            if self.state.measuring:
                self.state = replace(self.state, measuring=False)
            self._lock.release()


def _busy() -> EnrolmentError:
    return EnrolmentError("the captures are being measured", "Wait a few seconds.")
