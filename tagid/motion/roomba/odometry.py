"""The angle of a robot that turns in place, from the encoder counts of both wheels.

Each wheel runs on a circle with the wheel base as diameter, so the angle is the sum of both distances over
the base; their difference, ideally zero, indicates slip.
"""

from __future__ import annotations

import math
from typing import Final

MM_PER_COUNT: Final = 0.44456
"""pi * 72 mm / 508.8 counts (Create 2 OI specification, packets 43 and 44)."""
WHEEL_BASE_MM: Final = 235.0
"""Nominal (Create 2 OI specification)."""
NOMINAL_SCALE_SIGMA: Final = 0.06
"""Relative standard deviation of the effective wheel base of a robot that was not calibrated: errors up to
17 % have been reported, taken as three sigma."""
SLIP_SIGMA: Final = 0.03
"""Relative standard deviation of slip common to both wheels, which no encoder sees: up to 5 % of the distance
on a smooth floor (an assumption: no robot was measured)."""
_QUANTUM: Final = 1 / math.sqrt(12)


def wrapped_difference(now: int, before: int) -> int:
    """Difference of two 16-bit counters that may have wrapped, -32768..32767.

    >>> wrapped_difference(-32760, 32760)
    16
    """
    return ((now - before + 32768) & 0xFFFF) - 32768


class SpinOdometry:
    """Angle turned since the first reading.

    The encoders detect edges, not direction. Some firmware versions count by the commanded direction, others
    always upwards, so only the magnitude of a wheel's travel is used, with the sign of the command.

    Args:
        direction: +1 counter-clockwise from above, -1 clockwise.
        wheel_base_mm: effective wheel base.
    """

    def __init__(self, direction: int, wheel_base_mm: float = WHEEL_BASE_MM) -> None:
        self.direction = direction
        self.wheel_base_mm = wheel_base_mm
        self._last: tuple[int, int] | None = None
        self._left = 0
        self._right = 0

    @property
    def angle_rad(self) -> float:
        way = MM_PER_COUNT * (abs(self._left) + abs(self._right))
        return self.direction * way / self.wheel_base_mm

    @property
    def sigma_rad(self) -> float:
        """Standard deviation without the common scale factor: counting, plus half the wheels' disagreement.

        The common factor (wheel base and slip) is the track's `scale_sigma`.
        """
        counting = math.sqrt(2) * _QUANTUM
        disagreement = abs(abs(self._left) - abs(self._right)) / 2
        return MM_PER_COUNT * math.hypot(counting, disagreement) / self.wheel_base_mm

    @property
    def counts(self) -> tuple[int, int]:
        """Unwrapped counts of the left and the right wheel since the first reading."""
        return self._left, self._right

    def add(self, left: int, right: int) -> float:
        """Process a reading of packets 43 and 44; return the angle."""
        if self._last is not None:
            self._left += wrapped_difference(left, self._last[0])
            self._right += wrapped_difference(right, self._last[1])
        self._last = (left, right)
        return self.angle_rad
