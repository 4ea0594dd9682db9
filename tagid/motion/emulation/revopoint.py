"""A Revopoint dual-axis table as seen on its characteristic: `+CT,` commands and `+QT,` queries."""

from __future__ import annotations

import re
from typing import Final

from tagid.motion.emulation.table import TurningTable, check_rate_error

_TEXT: Final = re.compile(r"\+(CT|QT),([A-Z]+)(?:=(-?[0-9.]+))?")
_UNKNOWN, _OUT_OF_RANGE = "001", "007"


class RevopointCore:
    """An emulated table; times are seconds of one clock.

    Args:
        rate_error: relative amount by which it turns slower than commanded.
        now_s: time at the start.
    """

    baud = 0

    def __init__(self, rate_error: float = 0.02, now_s: float = 0.0) -> None:
        check_rate_error(rate_error)
        self.table = TurningTable(now_s)
        self._rate_error = rate_error
        self._period_s = 35.0
        self._buffer = ""

    def advance(self, now_s: float) -> bytes:
        """Advance the time; the table sends nothing unprompted."""
        self.table.advance(now_s)
        return b""

    def handle(self, data: bytes, now_s: float) -> bytes:
        """Process received bytes; return the answers."""
        self.advance(now_s)
        self._buffer = (self._buffer + data.decode("ascii", "ignore"))[-256:]
        out = b""
        while ";" in self._buffer:
            text, self._buffer = self._buffer.split(";", 1)
            out += self._answer(text).encode()
        return out

    def _answer(self, text: str) -> str:
        found = _TEXT.search(text)
        if found is None:
            return f"+FAIL,ERR={_UNKNOWN};"
        kind, name, value = found[1], found[2], found[3]
        number = float(value) if value and re.fullmatch(r"-?\d+(\.\d+)?", value) else None
        if kind == "QT" and name == "CHANGEANGLE":
            return f"+DATA={self.table.angle_deg % 360:.2f};"
        if kind == "CT" and name == "TURNSPEED" and number is not None and 17.5 <= number <= 90:
            self._period_s = number
        elif kind == "CT" and name == "TURNCONTINUE" and number in (1, -1):
            # Positive is clockwise from above (docs/motion.md).
            self.table.turn(-number * 360 / (self._period_s * (1 + self._rate_error)))
        elif kind == "CT" and name == "STOP":
            self.table.turn(0.0)
        else:
            return f"+FAIL,ERR={_OUT_OF_RANGE if kind == 'CT' else _UNKNOWN};"
        return "+OK;"
