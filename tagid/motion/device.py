"""The common interface of all motion devices: free-running tables and commanded devices.

A device either measures its angle (its readings form a Track with host timestamps) or leaves it to the period
in the scans; callers need not distinguish the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tagid.angles.views import Angles
from tagid.errors import DeviceError
from tagid.metadata import Track


class MotionStoppedError(DeviceError):
    """The device stopped, or was stopped because motion was no longer safe; the message gives the cause."""

    code = "motion_stopped"


class PausedError(MotionStoppedError):
    """This program was paused during motion: the device was stopped, and its angle is lost."""


class Motion(Protocol):
    """Interface of a motion device."""

    @property
    def moves(self) -> bool:
        """Whether `start` starts motion, so that a person has to confirm first."""

    @property
    def measures(self) -> bool:
        """Whether it provides a Track; otherwise `resolve` finds the angles in the scans."""

    @property
    def nominal_s(self) -> float | None:
        """Seconds per turn, as far as known in advance."""

    @property
    def direction(self) -> int:
        """+1 counter-clockwise from above, -1 clockwise."""

    def start(self) -> None:
        """Start turning; no effect if it turns by itself. Raises DeviceError and its subclasses."""

    def check(self) -> None:
        """Raise the error that stopped the motion since `start`: MotionStoppedError, DeviceError."""

    def track(self) -> Track | None:
        """The readings so far; None if the device measures nothing."""

    def stop(self) -> None:
        """Stop turning and release the device; safe to call twice, and before `start`."""

    def needed_seconds(self) -> float | None:
        """Seconds to record; None if only the data can determine it."""

    def finished(self, samples: Sequence[NDArray[Any]] | NDArray[Any], times_s: Sequence[float]) -> bool:
        """Whether the scans so far (one array per scan) cover a full turn and the required overlap."""

    def resolve(
        self, samples: NDArray[Any], times_s: NDArray[np.floating], clock_sigma_s: float = 0.0
    ) -> Angles:
        """Angle and sigma of every scan from the scans alone. Raises DataError if that is not possible."""
