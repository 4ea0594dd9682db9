"""The body of an emulated turntable: a plate, its true angle, and its angle history."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque

from tagid.errors import UsageError


def check_rate_error(rate_error: float) -> None:
    """Raises UsageError unless a table with this relative error of its speed turns forwards."""
    if not abs(rate_error) < 1:
        raise UsageError(f"the rate error is {rate_error}", "Give less than 1, e.g. 0.02 for 2 %.")


class TurningTable:
    """A plate that turns at the last commanded speed; times are seconds of one clock."""

    def __init__(self, now_s: float = 0.0) -> None:
        self.now_s = now_s
        self.angle_deg = 0.0
        self.speed_deg_s = 0.0
        self.still_since_s = now_s
        self.blocked = False
        """Whether the plate is blocked, regardless of the motor's commands."""
        self._corners: deque[tuple[float, float, float]] = deque([(now_s, 0.0, 0.0)], maxlen=1000)

    def advance(self, now_s: float) -> None:
        """Advance the time."""
        if now_s > self.now_s:
            self.angle_deg += self.speed_deg_s * (now_s - self.now_s)
            self.now_s = now_s

    def turn(self, speed_deg_s: float) -> None:
        """Turn at this speed from now on; counter-clockwise from above is positive, 0 stops it."""
        speed_deg_s = 0.0 if self.blocked else speed_deg_s
        if self.speed_deg_s and not speed_deg_s:
            self.still_since_s = self.now_s
        self.speed_deg_s = speed_deg_s
        self._corners.append((self.now_s, self.angle_deg, speed_deg_s))

    def state(self, moment_s: float) -> dict[str, float | int | bool]:
        """True angle at a given time, and whether it turns."""
        corners = list(self._corners)
        place = bisect_right([corner[0] for corner in corners], moment_s) - 1
        since, angle, speed = corners[max(place, 0)]
        return {
            "angle_rad": math.radians(angle + speed * max(0.0, moment_s - since)),
            "moving": bool(self.speed_deg_s),
            "still_since_s": self.still_since_s,
        }
