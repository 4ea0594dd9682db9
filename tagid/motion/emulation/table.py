"""Emulated turntables: a plate with its true angle, and the Comxim and Revopoint commands that turn it."""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections import deque
from enum import Enum
from typing import Final

from tagid.errors import UsageError


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
        earlier = (corner for corner in reversed(corners) if corner[0] <= moment_s)
        since, angle, speed = next(earlier, corners[0])
        return {
            "angle_rad": math.radians(angle + speed * max(0.0, moment_s - since)),
            "moving": bool(self.speed_deg_s),
            "still_since_s": self.still_since_s,
        }


_COMMAND: Final = re.compile(r"CT\+([A-Z]+)\(([-0-9.,]*)\)")
_UNKNOWN, _OUT_OF_RANGE, _BUSY = 80, 81, 82
SECONDS_A_TURN: Final = 20.0


class Steps(Enum):
    """When a table takes a command to turn by an angle: no document says what a turning one does with it."""

    ALWAYS = "always"
    AT_REST = "at rest"
    NONE = "never"


class _TableCore(ABC):
    """An emulated table; its commands end in a semicolon. Times are seconds of one clock.

    Args:
        rate_error: relative amount by which it turns slower than commanded.
    """

    def __init__(self, rate_error: float, now_s: float) -> None:
        if not abs(rate_error) < 1:
            raise UsageError(f"the rate error is {rate_error}", "Give less than 1, e.g. 0.02 for 2 %.")
        self.table = TurningTable(now_s)
        self._rate_error = rate_error
        self._buffer = ""

    def handle(self, data: bytes, now_s: float) -> bytes:
        out = self.advance(now_s)
        self._buffer = (self._buffer + data.decode("ascii", "ignore"))[-256:]
        while ";" in self._buffer:
            text, self._buffer = self._buffer.split(";", 1)
            out += self._answer(text)
        return out

    def advance(self, now_s: float) -> bytes:
        self.table.advance(now_s)
        return b""

    @abstractmethod
    def _answer(self, text: str) -> bytes:
        """Obey a command, without its semicolon."""


class ComximCore(_TableCore):
    """An emulated table; see `_TableCore` for other arguments.

    Args:
        fail: error code in its answer to a command to turn; None for none.
        backwards: whether its motor turns opposite to the manufacturer's documents.
        steps: when it takes a command to turn by an angle.

    Attributes:
        ends_at: when the current step ends; None while it turns without end, or rests.
    """

    baud = 115200

    def __init__(
        self,
        rate_error: float = 0.03,
        now_s: float = 0.0,
        fail: int | None = None,
        backwards: bool = False,
        steps: Steps = Steps.ALWAYS,
    ) -> None:
        super().__init__(rate_error, now_s)
        self._fail = fail
        self.steps = steps
        self._sense = -1 if backwards else 1
        self._speed, self._way, self._ack, self._events = 1, -1, False, False
        self.ends_at: float | None = None

    def advance(self, now_s: float) -> bytes:
        """Advance the time; the end of a step is reported as an event."""
        super().advance(now_s)
        if self.ends_at is not None and now_s >= self.ends_at:
            self.ends_at = None
            self.table.turn(0.0)
            return b"CR+EVENT=TB_END;" if self._events else b""
        return b""

    def _answer(self, text: str) -> bytes:
        command = _COMMAND.search(text)
        if command is None:
            return _error(_UNKNOWN)
        name, arguments = command.groups()
        try:
            values = [float(part) for part in arguments.split(",") if part]
        except ValueError:
            return _error(_OUT_OF_RANGE)
        first = values[0] if values else 0.0
        speed = 360 / (SECONDS_A_TURN * self._speed * (1 + self._rate_error))
        if name == "GETOFFSETANGLE":
            return f"OffsetAngle= {self.table.angle_deg % 360:+.2f}".encode() + b"\xb0;CR+OK;"
        if name == "SETSPEED":
            if first < 1:
                return _error(_OUT_OF_RANGE)
            self._speed = int(first)
        elif name == "SETDIR":
            # 0 is left, clockwise from above (docs/motion.md).
            self._way = 1 if first else -1
        elif name in ("RUN", "TRUNSINGLE") and self._fail is not None:
            return _error(self._fail)
        elif name == "TRUNSINGLE" and (len(values) != 2 or self.steps is Steps.NONE):
            return _error(_UNKNOWN)
        elif name == "TRUNSINGLE" and self.table.speed_deg_s and self.steps is Steps.AT_REST:
            return _error(_BUSY)
        elif name == "RUN":
            self.ends_at = None
            self.table.turn(self._way * speed * self._sense)
        elif name == "SETSTOP":
            self.ends_at = None
            self.table.turn(0.0)
        elif name == "TRUNSINGLE":
            self.table.turn((1 if first else -1) * speed * self._sense)
            self.ends_at = self.table.now_s + values[1] / speed
        elif name in ("ACK", "EVENT"):
            self._ack = bool(first) if name == "ACK" else self._ack
            self._events = bool(first) if name == "EVENT" else self._events
        elif name not in ("STARTUP", "SETMODE"):
            return _error(_UNKNOWN)
        return b"CR+OK;" if self._ack else b""


def _error(code: int) -> bytes:
    return f"CR+ERR={code};".encode()


_TEXT: Final = re.compile(r"\+(CT|QT),([A-Z]+)(?:=(-?[0-9.]+))?")
_NO_COMMAND, _NO_VALUE = "001", "007"


class RevopointCore(_TableCore):
    """An emulated dual-axis table; see `_TableCore`."""

    baud = 0

    def __init__(self, rate_error: float = 0.02, now_s: float = 0.0) -> None:
        super().__init__(rate_error, now_s)
        self._period_s = 35.0

    def _answer(self, text: str) -> bytes:
        command = _TEXT.search(text)
        if command is None:
            return f"+FAIL,ERR={_NO_COMMAND};".encode()
        kind, name, value = command[1], command[2], command[3]
        number = float(value) if value and re.fullmatch(r"-?\d+(\.\d+)?", value) else None
        if kind == "QT" and name == "CHANGEANGLE":
            return f"+DATA={self.table.angle_deg % 360:.2f};".encode()
        if kind == "CT" and name == "TURNSPEED" and number is not None and 17.5 <= number <= 90:
            self._period_s = number
        elif kind == "CT" and name == "TURNCONTINUE" and number in (1, -1):
            # Positive is clockwise from above (docs/motion.md).
            self.table.turn(-number * 360 / (self._period_s * (1 + self._rate_error)))
        elif kind == "CT" and name == "STOP":
            self.table.turn(0.0)
        else:
            return f"+FAIL,ERR={_NO_VALUE if kind == 'CT' else _NO_COMMAND};".encode()
        return b"+OK;"
