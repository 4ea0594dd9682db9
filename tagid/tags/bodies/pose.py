"""Where a body stands on the turntable."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Pose:
    """Where a body stands on the turntable.

    Attributes:
        centre_m: (x, y) of its own centre in the turntable's frame, m.
        turn_rad: its turn counter-clockwise about that centre, rad; 0 for a body of revolution.
    """

    centre_m: tuple[float, float] = (0.0, 0.0)
    turn_rad: float = 0.0

    @property
    def centre(self) -> complex:
        """The centre as x + jy, m."""
        return complex(*self.centre_m)
