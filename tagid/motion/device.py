"""The common interface of everything that turns the object: free-running tables and commanded devices.

A device either measures its angle (its readings are then a Track, stamped with the host's clock) or leaves it
to the period in the scans; no caller needs to know which.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError, DeviceError
from tagid.motion.angles import Angles


class MotionStoppedError(DeviceError):
    """What turns the object stopped, or was stopped because it was no longer safe; says the cause."""

    code = "motion_stopped"


class PausedError(MotionStoppedError):
    """This program was paused while something turned: it was stopped, and its angle is lost."""


@dataclass(frozen=True, eq=False)
class Track:
    """Angles as a device measured them.

    Attributes:
        host_time_ns: (readings,) int64 when the reading reached this computer, ns since the epoch.
        angles_rad: (readings,) object angle since the start, counter-clockwise from above, rad.
        sigma_rad: (readings,) standard deviation of an angle but for a common factor, rad.
        info: `kind`; `scale_sigma`, the relative standard deviation of a factor common to all angles;
            `step_s`, the device's own time between readings, where it is even; whatever else is known.
    """

    host_time_ns: NDArray[np.int64]
    angles_rad: NDArray[np.float64]
    sigma_rad: NDArray[np.float64]
    info: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.host_time_ns)
        for name in ("host_time_ns", "angles_rad", "sigma_rad"):
            value = getattr(self, name)
            if value.shape != (n,) or not np.isfinite(value).all():
                raise DataError(f"{name} of a motion track has shape {value.shape}, expected ({n},), finite")

    def __len__(self) -> int:
        return len(self.host_time_ns)

    @classmethod
    def of(cls, readings: Sequence[tuple[int, float, float]], info: dict[str, Any]) -> Track:
        """A track of (host_time_ns, angle_rad, sigma_rad)."""
        return cls(
            np.array([r[0] for r in readings], dtype=np.int64),
            np.array([r[1] for r in readings], dtype=np.float64),
            np.array([r[2] for r in readings], dtype=np.float64),
            dict(info),
        )


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
        """The readings so far; None where the device measures nothing."""
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
        """Angle and sigma of every scan from the scans alone. Raises DataError where they cannot tell."""
        ...
