"""The common interface of everything that turns the object: free-running tables and commanded devices.

A device either measures its angle (its readings are then a Track, stamped with the host's clock) or leaves it
to the period in the scans; no caller needs to know which.
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
    """What turns the object stopped, or was stopped because it was no longer safe; says the cause."""

    code = "motion_stopped"


class PausedError(MotionStoppedError):
    """This program was paused while something turned: it was stopped, and its angle is lost."""


class Motion(Protocol):
    """What turns the object."""

    @property
    def moves(self) -> bool:
        """Whether `start` sets something in motion, so that a person has to agree first."""
        ...

    @property
    def measures(self) -> bool:
        """Whether it gives a Track; otherwise `resolve` finds the angles in the scans."""
        ...

    @property
    def nominal_s(self) -> float | None:
        """Seconds per turn as far as known beforehand."""
        ...

    @property
    def direction(self) -> int:
        """+1 counter-clockwise from above, -1 clockwise."""
        ...

    def start(self) -> None:
        """Begin to turn; nothing where it turns by itself. Raises DeviceError and its kinds."""
        ...

    def check(self) -> None:
        """Raise what has stopped the motion since `start`: MotionStoppedError, DeviceError."""
        ...

    def track(self) -> Track | None:
        """The readings so far; None if the device measures nothing."""
        ...

    def stop(self) -> None:
        """Stop turning and let go of the device; safe to call twice, and before `start`."""
        ...

    def needed_seconds(self) -> float | None:
        """Seconds to record, None where only the data can tell."""
        ...

    def finished(self, samples: Sequence[NDArray[Any]] | NDArray[Any], times_s: Sequence[float]) -> bool:
        """Whether the scans so far (one array a scan) cover a full turn and the overlap that is needed."""
        ...

    def resolve(
        self, samples: NDArray[Any], times_s: NDArray[np.floating], clock_sigma_s: float = 0.0
    ) -> Angles:
        """Angle and sigma of every scan from the scans alone. Raises DataError if they cannot tell."""
        ...
