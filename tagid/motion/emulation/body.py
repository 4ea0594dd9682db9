"""The body of an emulated robot: wheels with quantised speeds and slip, encoders, and a heading.

Encoder counts and true heading are independent, as on a real floor.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass

import numpy as np

from tagid.errors import UsageError
from tagid.motion.roomba.device import SPEED_STEP_MM_S
from tagid.motion.roomba.odometry import MM_PER_COUNT, WHEEL_BASE_MM

_TICK_S = 2e-3
_HISTORY_S = 30.0


@dataclass(frozen=True)
class BodySettings:
    """Parameters of a robot.

    Attributes:
        wheel_base_mm: true distance between the wheels.
        slip: fraction of a wheel's travel that does not turn the robot.
        slip_noise: standard deviation of the slow slip variation (correlation time 1 s).
        encoder_noise: standard deviation of a count, counts.
        imbalance: relative excess speed of the right wheel.
        first_count: initial count of both encoders (near 32767 they wrap soon).
        lag_s: time constant of the motors.
        blocked: whether the wheels cannot turn.
    """

    wheel_base_mm: float = WHEEL_BASE_MM
    slip: float = 0.0
    slip_noise: float = 0.0
    encoder_noise: float = 0.3
    imbalance: float = 0.0
    first_count: int = 0
    lag_s: float = 0.03
    blocked: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        if not 100 <= self.wheel_base_mm <= 1000:
            raise UsageError(f"the wheel base is {self.wheel_base_mm} mm", "Give 100 to 1000 mm.")
        spreads = (self.slip_noise, self.encoder_noise, self.lag_s)
        if not 0 <= self.slip < 0.9 or not all(0 <= value < math.inf for value in spreads):
            raise UsageError("slip, noise or lag is out of range", "Give 0 or more, slip < 0.9.")


def real_speed(commanded_mm_s: float) -> float:
    """The speed that the wheels actually take: the nearest step, 0 below half of one."""
    return math.copysign(round(abs(commanded_mm_s) / SPEED_STEP_MM_S) * SPEED_STEP_MM_S, commanded_mm_s)


class Body:
    """Two wheels and a heading; times are seconds of the caller's clock and never run backwards."""

    def __init__(self, settings: BodySettings | None = None, now_s: float = 0.0) -> None:
        self.settings = settings or BodySettings()
        self._rng = np.random.default_rng(self.settings.seed)
        self._now = now_s
        self._wanted = (0.0, 0.0)
        self._speed = [0.0, 0.0]
        self._way = [0.0, 0.0]
        self._slip = 0.0
        self._rate_rad_s = 0.0
        self.heading_rad = 0.0
        """True heading, counter-clockwise from above, not wrapped."""
        self.still_since_s: float = now_s
        """Time at which the wheels last came to rest."""
        self._times: deque[float] = deque([now_s])
        self._headings: deque[float] = deque([0.0])

    def drive(self, right_mm_s: float, left_mm_s: float) -> None:
        if self.settings.blocked:
            return
        self._wanted = (
            real_speed(left_mm_s),
            real_speed(right_mm_s) * (1 + self.settings.imbalance),
        )

    @property
    def moving(self) -> bool:
        return any(self._speed)

    def advance(self, now_s: float) -> None:
        s = self.settings
        while self._now < now_s:
            step = min(_TICK_S, now_s - self._now)
            self._now += step
            if not self.moving and not any(self._wanted):
                # A robot at rest needs no steps.
                self._now = now_s
                self._rate_rad_s = 0.0
                self._note()
                return
            gain = 1 - math.exp(-step / s.lag_s) if s.lag_s else 1.0
            for wheel in (0, 1):
                self._speed[wheel] += gain * (self._wanted[wheel] - self._speed[wheel])
                if abs(self._speed[wheel]) < 3.0 and not self._wanted[wheel]:
                    self._speed[wheel] = 0.0  # static friction
                self._way[wheel] += self._speed[wheel] * step
            if not self.moving:
                self.still_since_s = self._now
            if s.slip_noise:
                self._slip += -self._slip * step + s.slip_noise * math.sqrt(2 * step) * self._rng.normal()
            turned = (self._speed[1] - self._speed[0]) * step / s.wheel_base_mm
            turned *= 1 - s.slip - self._slip
            self.heading_rad += turned
            self._rate_rad_s = turned / step if self.moving else 0.0
            self._note()

    def _note(self) -> None:
        self._times.append(self._now)
        self._headings.append(self.heading_rad)
        while self._times[0] < self._now - _HISTORY_S:
            self._times.popleft()
            self._headings.popleft()

    def heading_at(self, time_s: float) -> float:
        """True heading at a time within the last 30 s, rad; later times extrapolate the current rotation."""
        times = self._times
        if time_s >= times[-1]:
            return self._headings[-1] + self._rate_rad_s * (time_s - times[-1])
        right = bisect_right(times, time_s)
        if right == 0:
            return self._headings[0]
        share = (time_s - times[right - 1]) / (times[right] - times[right - 1])
        return self._headings[right - 1] + share * (self._headings[right] - self._headings[right - 1])

    def ways_mm(self) -> tuple[float, float]:
        """Distance rolled by the left and right wheel, forwards positive, mm."""
        return self._way[0], self._way[1]

    def encoders(self) -> tuple[int, int]:
        counts = []
        for way in self._way:
            noise = self.settings.encoder_noise * self._rng.normal() if self.moving else 0.0
            count = self.settings.first_count + math.floor(way / MM_PER_COUNT + noise)
            counts.append(((count + 32768) & 0xFFFF) - 32768)
        return counts[0], counts[1]
