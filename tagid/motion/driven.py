"""Base class of commanded devices: a thread that polls and monitors, and always ends with a halt.

A driver adds three steps (begin, poll, halt); halt is run whatever error occurs in them.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tagid import hostclock
from tagid.angles.views import Angles
from tagid.errors import DataError, DeviceError, DeviceRejectedError, TagidError, UsageError
from tagid.metadata import Track
from tagid.motion.device import MotionStoppedError, PausedError
from tagid.motion.guardian import ask_to_stop
from tagid.motion.links import ByteLink
from tagid.workers import Worker

_JOIN_S: Final = 5.0
MEASURED_TURNS: Final = 1.15
"""Turns to record with measured angles: one, plus enough overlap to compare them with the period in the
scans (`find_period` needs 1.1)."""
AngleReading = tuple[int, float, float]
"""host_time_ns, angle_rad, sigma_rad."""


class DrivenMotion(ABC):
    """A device that turns on command and measures its angle.

    Args:
        name: name of the device in messages.
        direction: +1 counter-clockwise from above, -1 clockwise.
        nominal_s: seconds per turn.
        scale_sigma: relative standard deviation of a scale factor common to all its angles.
        turns: turns to record; None for one plus the overlap that scale_sigma requires.
        max_seconds: time after which the motion is stopped, s.
    """

    moves = True
    measures = True
    kind = "driven"
    target = ""
    """Its port, name or address, under which its guardian is found."""
    stops_by = "switch it off"
    """What the user does if the program can no longer stop it; follows "It may still be turning: "."""
    warning = ""
    """Conditions without an automatic stop, for the prompt before motion; "" if it always stops."""
    _link: ByteLink | None = None
    """The link while it is open."""

    def __init__(
        self,
        name: str,
        direction: int,
        nominal_s: float,
        scale_sigma: float = 0.0,
        turns: float | None = None,
        max_seconds: float = 300.0,
    ) -> None:
        self.name, self.direction, self.nominal_s = name, direction, nominal_s
        self.scale_sigma, self.max_seconds = scale_sigma, max_seconds
        # Three sigma more, so that a turn is complete even if the device overestimates its angle.
        self.turns = turns if turns is not None else MEASURED_TURNS * (1 + 3 * scale_sigma)
        self._readings: list[AngleReading] = []
        self._error: TagidError | None = None
        self._unconfirmed = False
        self._worker: Worker | None = None
        self._stopping = threading.Event()
        self._lock = threading.Lock()

    @abstractmethod
    def _begin(self) -> None:
        """Open the link, arm the emergency stop for the case that this program dies, and start the motion."""

    @abstractmethod
    def _poll(self) -> list[AngleReading]:
        """Wait briefly for readings; raise if the motion has to stop."""

    @abstractmethod
    def _halt(self) -> None:
        """Stop and verify it; no effect if nothing moves or nothing is open."""

    def _close(self) -> None:
        """Close the link."""
        link, self._link = self._link, None
        if link is not None:
            link.close()

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """The state that the device reports, as plain values; nothing moves, and the link is closed again.

        Raises DeviceError and its subclasses.
        """

    def _connect_and_halt(self) -> None:
        """Open the link, whatever the device does, and stop it. Raises DeviceError if it does not confirm."""
        raise DeviceRejectedError(f"{self.name} takes no command to stop", "Switch its table off.")

    def halt_now(self) -> None:
        """Stop it, even if another program started it: through that program's guardian if there is one.

        Raises DeviceError if it does not confirm.
        """
        if not ask_to_stop(self.target):
            self.halt_directly()

    def halt_directly(self) -> None:
        """Stop it without its guardian. Raises DeviceError if it does not confirm."""
        try:
            self._connect_and_halt()
        except DeviceError as error:
            raise type(error)(self._still_turning(error), error.remedy) from error
        finally:
            self._close()

    def _still_turning(self, cause: TagidError) -> str:
        return f"It may still be turning: {self.stops_by}. {cause.message}"

    def _facts(self) -> dict[str, Any]:
        """Metadata of a Track besides its readings."""
        return {}

    def start(self) -> None:
        """Start turning. Raises DeviceError and its subclasses; then nothing moves."""
        if self._worker is not None:
            raise UsageError(f"{self.name} is already turning", "Stop it first.")
        self._readings, self._error, self._unconfirmed = [], None, False
        self._stopping.clear()
        try:
            self._begin()
            worker = Worker(self._work, f"motion-{self.kind}", self._failed)
            try:
                worker.start()
            except RuntimeError as error:
                raise DeviceError(
                    f"the thread that drives {self.name} does not start ({error})",
                    "Free memory and processes, then try again.",
                ) from error
            self._worker = worker  # only now: `check` on another thread reports one that is not alive
        except BaseException as error:
            self._stopping.set()
            self._error = error if isinstance(error, TagidError) else None
            self._end()
            if self._unconfirmed and self._error is not None:
                raise self._error from error
            raise

    def _work(self) -> None:
        until = time.monotonic() + self.max_seconds
        while not self._stopping.is_set():
            new = self._poll()
            with self._lock:
                self._readings += new
            if time.monotonic() > until:
                raise MotionStoppedError(
                    f"{self.name} has turned for {self.max_seconds:.0f} s and was stopped",
                    "Request fewer turns, or give a larger max_seconds.",
                )
        self._safely_halt()

    def _failed(self, error: BaseException) -> None:
        """On any error the wheels must stop and the recording must be notified."""
        try:
            self._error = self._reported(error)
            if isinstance(error, PausedError) and self._readings:
                # The angle since the last reading is unknown: its uncertainty is uniform over a turn.
                with self._lock:
                    self._readings.append((hostclock.now_ns(), self._readings[-1][1], math.pi))
        finally:
            self._safely_halt()

    def _reported(self, error: BaseException) -> TagidError:
        if isinstance(error, TagidError):
            return error
        return DeviceError(f"{self.name}: {type(error).__name__}: {error}")

    def _paused(self, seconds: float) -> PausedError:
        """The error for a pause of this program."""
        return PausedError(
            f"this program was paused for {seconds:.1f} s; {self.name} was stopped and its angle is lost "
            "from then on",
            "Record again; keep this computer awake and less busy.",
        )

    def _safely_halt(self) -> None:
        try:
            self._halt()
        except Exception as error:
            logging.getLogger("tagid").debug("halt", exc_info=True)
            self._unconfirmed = True
            cause = self._error or self._reported(error)
            self._error = type(cause)(self._still_turning(cause), cause.remedy)

    def _end(self) -> None:
        self._safely_halt()
        try:
            self._close()
        except (TagidError, OSError):
            logging.getLogger("tagid").debug("closing %s", self.name, exc_info=True)

    def check(self) -> None:
        """Raise the error that stopped the motion."""
        worker = self._worker
        ended = worker is not None and not worker.alive  # asked first: the thread keeps its error, then ends
        if self._error is not None:
            raise self._error
        if ended and not self._stopping.is_set():
            raise DeviceError(f"the thread that drives {self.name} has ended", "Record again.")

    def stop(self) -> None:
        """Stop turning and close the link; safe to call twice.

        Raises:
            DeviceError: it did not confirm the stop.
        """
        before = self._error
        self._stopping.set()
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.join(_JOIN_S)
        self._end()
        unconfirmed, self._unconfirmed = self._unconfirmed, False
        if self._error is not None and (before is None or unconfirmed):
            raise self._error

    def track(self) -> Track:
        """The readings so far."""
        with self._lock:
            readings = list(self._readings)
        info = {
            "kind": self.kind,
            "direction": self.direction,
            "nominal_s": self.nominal_s,
            "scale_sigma": self.scale_sigma,
            **self._facts(),
        }
        return Track.of(readings, info)

    @property
    def turned_rad(self) -> float:
        """The newest angle, rad."""
        with self._lock:
            return self._readings[-1][1] if self._readings else 0.0

    def needed_seconds(self) -> float:
        """Duration of the requested turns at the nominal speed."""
        return self.turns * self.nominal_s

    def finished(self, samples: Sequence[NDArray[Any]] | NDArray[Any], times_s: Sequence[float]) -> bool:
        """Whether the requested turns are complete, by the device's own angle."""
        return abs(self.turned_rad) >= self.turns * 2 * math.pi

    def resolve(
        self, samples: NDArray[Any], times_s: NDArray[np.floating], clock_sigma_s: float = 0.0
    ) -> Angles:
        """Not possible from scans: the angles are measured during recording. Raises DataError."""
        raise DataError(
            f"the angles of {self.name} are measured while recording; this capture holds none",
            "Take the period from the scans: `motion.url=free`, or `motion.url=free?rpm=RPM`.",
        )
