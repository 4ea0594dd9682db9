"""A Roomba as a turntable: it turns in place at one of its speed steps and stops on any anomaly.

Speed, duration and time without data are limited here, and the robot is always left in Passive mode.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any, Final

from tagid.errors import DeviceRejectedError, DeviceTimeoutError
from tagid.motion.device import MotionStoppedError
from tagid.motion.driven import AngleReading, DrivenMotion
from tagid.motion.links import ByteLink
from tagid.motion.roomba.client import FAREWELL, OpenInterface, RobotStatus, StreamDecoder
from tagid.motion.roomba.messages import FRAME_S, Mode, Packet
from tagid.motion.roomba.odometry import WHEEL_BASE_MM, SpinOdometry

SPEED_STEP_MM_S: Final = 28.5
"""Step of the wheels' speed (seen on Create 2 robots): 13.9 deg/s per step when turning in place."""
MAX_STEP: Final = 3
"""41.7 deg/s, 8.6 s per turn: as fast as possible without an object on top sliding."""
DEAD_MAN_S: Final = 0.35
_FEED_S: Final = 0.05
_SILENCE_S: Final = 0.4
_STARVED_S: Final = 0.1
_STALL_S: Final = 1.5
_LOW_CHARGE: Final = 0.08
_HOT_C: Final = 60
HALT: Final = bytes(4) + FAREWELL
"""For a stop that may interrupt an unknown command: zeros complete it and are not an opcode."""

WATCHED: Final = (
    Packet.BUMPS_AND_DROPS,
    Packet.CLIFF_LEFT,
    Packet.CLIFF_FRONT_LEFT,
    Packet.CLIFF_FRONT_RIGHT,
    Packet.CLIFF_RIGHT,
    Packet.CHARGER,
    Packet.MODE,
    Packet.LEFT_ENCODER,
    Packet.RIGHT_ENCODER,
)
"""23 bytes per frame: fits into 15 ms even at 19200 baud (28 bytes)."""
WATCHED_FAST: Final = (*WATCHED, Packet.TEMPERATURE, Packet.CHARGE, Packet.CAPACITY)
"""31 bytes per frame, for 115200 baud."""


def step_period_s(step: int, wheel_base_mm: float = WHEEL_BASE_MM) -> float:
    """Seconds per turn at a speed step.

    >>> [round(step_period_s(step), 1) for step in (1, 2, 3)]
    [25.9, 13.0, 8.6]
    """
    return math.pi * wheel_base_mm / (step * SPEED_STEP_MM_S)


class Roomba(DrivenMotion):
    """A robot on the floor with the object on top.

    Args:
        open_link: opens the link; called by `start` and `describe`.
        name: name of the robot in messages.
        step: speed step, 1..3.
        direction: +1 counter-clockwise from above, -1 clockwise.
        wheel_base_mm: effective wheel base.
        scale_sigma: relative standard deviation of the wheel base.
        calibrated: whether it was calibrated.
        fast: 115200 baud, which allows battery data in every frame.
        turns: turns to record; None for one and the overlap needed.
        max_seconds: maximum duration of the motion, s.
    """

    kind = "roomba"
    stops_by = "lift it; a dropped wheel stops it, its buttons do not"
    warning = "If its cable is disconnected nothing stops it: then lift it, because its buttons do not work"

    def __init__(
        self,
        open_link: Callable[[], ByteLink],
        name: str,
        *,
        step: int,
        direction: int,
        wheel_base_mm: float,
        scale_sigma: float,
        calibrated: bool,
        fast: bool,
        turns: float | None,
        max_seconds: float,
    ) -> None:
        nominal_s = step_period_s(step, wheel_base_mm)
        super().__init__(f"the robot at {name}", direction, nominal_s, scale_sigma, turns, max_seconds)
        self.target = name
        self._step, self._wheel_base_mm, self._calibrated, self._fast = step, wheel_base_mm, calibrated, fast
        self.first_angle_s: float | None = None
        """Seconds from `start` to the first angle."""
        self._open_link = open_link
        self._oi: OpenInterface
        self._decoder: StreamDecoder | None = None
        self._driven = False
        self._driving = threading.Lock()
        """Held while a drive command is written; none may follow the stop sequence."""

    def describe(self) -> dict[str, Any]:
        """Battery, charger, predicted motion, and the calibration of its wheel base."""
        try:
            status = self._interface().wake()
        finally:
            self._close()
        periods_s = [step_period_s(step, self._wheel_base_mm) for step in range(1, MAX_STEP + 1)]
        return {
            "robot": self.target,
            **asdict(status),
            "mode": status.mode.name.lower(),
            "wheel_base_mm": self._wheel_base_mm,
            "wheel_base_sigma": self.scale_sigma,
            "calibrated": self._calibrated,
            "seconds_a_turn": [round(period_s, 2) for period_s in periods_s],
        }

    def _connect_and_halt(self) -> None:
        """Stop the robot and leave it in Passive mode."""
        oi = self._interface()
        oi.link.write(HALT)
        oi.wake()
        oi.leave()

    def _interface(self) -> OpenInterface:
        if self._link is None:
            self._link = self._open_link()
            self._oi = OpenInterface(self._link)
        return self._oi

    def _begin(self) -> None:
        asked = time.monotonic()
        oi = self._interface()
        self._fit_to_turn(oi.wake())
        oi.link.arm(DEAD_MAN_S)
        self._driven = True
        oi.safe()
        oi.stream(WATCHED_FAST if self._fast else WATCHED)
        self._decoder = oi.decoder
        self._odometry = SpinOdometry(self.direction, self._wheel_base_mm)
        self._fed = self._heard = self._moved = self._looked = time.monotonic()
        self._counts = (0, 0)
        while not (first := self._poll()):
            pass
        self._readings = first
        self._spin(round(self._step * SPEED_STEP_MM_S))
        self.first_angle_s = time.monotonic() - asked

    def _fit_to_turn(self, status: RobotStatus) -> None:
        if status.on_charger:
            raise DeviceRejectedError(f"{self.name} is on its charger", "Remove it from the charger.")
        if status.wheel_dropped:
            raise DeviceRejectedError(f"{self.name} has a dropped wheel", "Place it on the floor.")
        if status.charge is not None and status.charge < _LOW_CHARGE:
            raise DeviceRejectedError(
                f"the battery of {self.name} is at {status.charge:.0%}", "Charge it for an hour."
            )
        if status.temperature_c > _HOT_C:
            raise DeviceRejectedError(
                f"the battery of {self.name} has {status.temperature_c} degC", "Let it cool."
            )

    def _poll(self) -> list[AngleReading]:
        oi = self._interface()
        oi.link.beat()
        now = time.monotonic()
        away = now - self._looked
        if away > DEAD_MAN_S:
            raise self._paused(away)
        if away > _STARVED_S:
            # This process did not read the link; the robot was not silent.
            self._heard += away
            self._moved += away
        self._looked = now
        if now - self._fed >= _FEED_S:
            # Repeated regularly: these writes keep the dead-man from stopping the wheels.
            self._spin(round(self._step * SPEED_STEP_MM_S) if self._readings else 0)
            self._fed = now
        readings: list[AngleReading] = []
        for stamp, values in oi.frames(0.02):
            self._watch(values)
            angle = self._odometry.add(values[Packet.LEFT_ENCODER], values[Packet.RIGHT_ENCODER])
            readings.append((stamp, angle, self._odometry.sigma_rad))
        now = time.monotonic()
        if readings:
            self._heard = now
        if now - self._looked > _STARVED_S:
            # Paused while it read: the next poll says so, or that it was short.
            return readings
        if now - self._heard > _SILENCE_S:
            raise DeviceTimeoutError(
                f"{self.name} has been silent for {_SILENCE_S} s: the link is lost",
                "Then check the connector or the distance.",
            )
        if self._odometry.counts != self._counts or not self._readings:
            self._counts, self._moved = self._odometry.counts, now
        elif now - self._moved > _STALL_S:
            raise MotionStoppedError(
                f"nothing turns: the wheels of {self.name} do not move",
                "Check whether they are blocked; then try again.",
            )
        return readings

    def _watch(self, values: dict[int, int]) -> None:
        """Raise the error that must stop the motion; a cause precedes its consequence (return to Passive)."""
        bits = values[Packet.BUMPS_AND_DROPS]
        capacity = values.get(Packet.CAPACITY, 0)
        cliffs = any(values[packet] for packet in range(Packet.CLIFF_LEFT, Packet.CLIFF_RIGHT + 1))
        mode = values[Packet.MODE] - self._interface().mode_offset
        for wrong, cause, remedy in (
            (bits & 0b1100, "has a dropped wheel", "Place it on level ground."),
            (cliffs, "detects a cliff", "Move it away from the edge, or clean its cliff sensors."),
            (bits & 0b0011, "was bumped", "Clear its surroundings."),
            (values[Packet.CHARGER] & 3, "was put on a charger", "Remove it from the charger."),
            (mode != Mode.SAFE, "left Safe mode", "One of its safety sensors caused this; try again."),
            (
                capacity and values[Packet.CHARGE] < 0.5 * _LOW_CHARGE * capacity,
                "has an empty battery",
                "Charge it.",
            ),
            (values.get(Packet.TEMPERATURE, 0) > _HOT_C, "has a hot battery", "Let it cool."),
        ):
            if wrong:
                raise MotionStoppedError(f"{self.name} {cause} and was stopped", remedy)

    def _halt(self) -> None:
        if self._link is None or not self._driven:
            return
        with self._driving:
            self._driven = False
        # If the robot does not confirm, its guardian stays armed and acts when the link is closed.
        self._oi.leave()
        self._oi.link.disarm()

    def _spin(self, speed_mm_s: int) -> None:
        """Turn in place, unless the stop sequence has begun: a drive command must not follow it."""
        with self._driving:
            if self._driven:
                self._interface().spin(self.direction, speed_mm_s)

    def _facts(self) -> dict[str, Any]:
        return {
            "robot": self.target,
            "wheel_base_mm": self._wheel_base_mm,
            "calibrated": self._calibrated,
            "step": self._step,
            "step_s": FRAME_S,
            "bytes_dropped": self._decoder.dropped if self._decoder else 0,
            "first_angle_s": self.first_angle_s,
        }
