"""Tables whose angle is polled: the common part of the Comxim and Revopoint drivers.

An angle is timestamped midway between query and answer; half of that interval is its uncertainty.
"""

from __future__ import annotations

import math
import re
import time
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, Final

from tagid import hostclock
from tagid.errors import DeviceRejectedError, DeviceTimeoutError
from tagid.motion.device import MotionStoppedError
from tagid.motion.driven import AngleReading, DrivenMotion
from tagid.motion.links import ByteLink

POLL_S: Final = 0.05
ANSWER_S: Final = 1.0
_STALL_S: Final = 3.0
_SLICE_S: Final = 0.1
GUARD_S: Final = 0.35
"""Maximum time without a heartbeat to the helper process that stops the table."""
PAUSE_S: Final = 3.0
"""Maximum time between two queries; an answer alone may take ANSWER_S, twice."""
_SLOW_S: Final = 0.06
_PATIENCE_S: Final = 0.5
"""An answer slower than _SLOW_S is discarded, unless none was faster for this time."""
_LONGEST_ANSWER: Final = 512
_RESOLUTION_RAD: Final = math.radians(0.1)


class PolledTable(DrivenMotion):
    """A table over a byte link with answers that end in a semicolon.

    Args:
        direction: +1 counter-clockwise from above, -1 clockwise.
        nominal_s: seconds per turn as set; real rates differ.
        turns: turns to record; None for one plus the overlap.
    """

    prefix: str
    """What a command begins with."""
    accepted: str
    """Text of the answer to a command that is obeyed, within `accepted_s`."""
    accepted_s = ANSWER_S
    angle_query: bytes
    angle_name: str
    """What the angle follows in its answer, and an equals sign."""

    def __init__(
        self,
        open_link: Callable[[], ByteLink],
        name: str,
        direction: int,
        nominal_s: float,
        turns: float | None = None,
    ) -> None:
        super().__init__(f"the table at {name}", direction, nominal_s, scale_sigma=0.005, turns=turns)
        self.target = name
        self.reversed = False
        self._open_link = open_link
        self._running = False
        self._buffer = b""
        self._last_deg: float | None = None
        self._turned_deg = 0.0
        self._moved = self._looked = 0.0
        self._last_answer_s = 0.0

    @property
    def commanded(self) -> int:
        """The direction to command, as in the manufacturer's documents: +1 counter-clockwise from above."""
        return -self.direction if self.reversed else self.direction

    @abstractmethod
    def _set_going(self) -> None:
        """Command it to turn, with its speed and direction."""

    def _command(self, text: str) -> None:
        """Send a command, and wait until the table accepts it."""
        self.forget()
        self.link().write(f"{self.prefix}{text};".encode())
        self.answer(self.accepted, self.accepted_s)

    def _ask_angle(self) -> float:
        """Its angle, degrees."""
        self.link().write(self.angle_query)
        text = self.answer(self.angle_name)
        match = re.search(re.escape(self.angle_name) + r"\s*=\s*([+-]?\d+(?:\.\d+)?)", text)
        if match is None:
            raise DeviceRejectedError(f"{self.name} answers {text[:40]!r}", "Check the device type.")
        return float(match[1])

    @abstractmethod
    def _tell_stop(self) -> None:
        """Command it to stop."""

    def link(self) -> ByteLink:
        if self._link is None:
            self._link = self._open_link()
            self._buffer = b""
        return self._link

    def answer(self, wanted: str, timeout: float = ANSWER_S) -> str:
        """The next answer that contains a text, without its semicolon; others (events, echoes) are skipped.

        Raises:
            DeviceRejectedError: the table reports an error. DeviceTimeoutError: no matching answer arrived.
        """
        deadline = time.monotonic() + timeout
        while True:
            while b";" in self._buffer:
                part, self._buffer = self._buffer.split(b";", 1)
                # The degree sign of some tables is not UTF-8; only ASCII is needed.
                text = part.decode("ascii", "ignore").strip()
                if "ERR=" in text or "FAIL" in text:
                    # The guardian's halt may have caused this answer.
                    self._beat()
                    code = text.rpartition("=")[2].strip()
                    raise DeviceRejectedError(
                        f"{self.name} reports error {code}",
                        "Switch it off and on; see its manual for the code.",
                    )
                if wanted in text:
                    return text
            remaining_s = deadline - time.monotonic()
            if remaining_s <= 0:
                raise DeviceTimeoutError(
                    f"{self.name} does not answer", "Switch it on; check its connection and its type."
                )
            self._beat()
            self._buffer = (self._buffer + self.link().read(min(remaining_s, _SLICE_S)))[-_LONGEST_ANSWER:]

    def _beat(self) -> None:
        """Send a heartbeat to the helper process, which may have stopped the table already during a halt."""
        if self._running:
            self.link().beat()

    def forget(self) -> None:
        """Discard answers to earlier requests."""
        deadline = time.monotonic() + ANSWER_S
        while self.link().read(0.02) and time.monotonic() < deadline:
            self._beat()
        self._buffer = b""

    def _begin(self) -> None:
        self._last_deg, self._turned_deg = None, 0.0
        self.link().arm(GUARD_S)
        self._running = True
        self._set_going()
        self._looked = self._moved = time.monotonic()

    def _poll(self) -> list[AngleReading]:
        time.sleep(POLL_S)
        self._beat()
        away_s = time.monotonic() - self._looked
        if away_s > PAUSE_S:
            raise self._paused(away_s)
        self._looked = time.monotonic()
        if time.monotonic() - self._moved > _STALL_S:
            raise MotionStoppedError(
                f"nothing turns: {self.name} reports no new angle for {_STALL_S:g} s",
                "Check whether it is blocked or overloaded.",
            )
        asked = hostclock.now_ns()
        degrees = self._ask_angle()
        answered = hostclock.now_ns()
        if (answered - asked) * 1e-9 > _SLOW_S and time.monotonic() - self._last_answer_s < _PATIENCE_S:
            # The time within that interval at which the table sampled its angle is unknown.
            return []
        self._last_answer_s = time.monotonic()
        if self._last_deg is not None:
            step = (degrees - self._last_deg + 180) % 360 - 180
            if abs(step) > 1e-6:
                self._moved = time.monotonic()
            self._turned_deg += step
        self._last_deg = degrees
        spread = 0.5 * (answered - asked) * 1e-9 * 2 * math.pi / self.nominal_s / math.sqrt(3)
        sigma = math.hypot(_RESOLUTION_RAD / math.sqrt(12), spread)
        # The sign that tables report is not documented consistently; the commanded direction is used.
        angle = self.direction * math.radians(abs(self._turned_deg))
        return [((asked + answered) // 2, angle, sigma)]

    def _halt(self) -> None:
        if self._link is None or not self._running:
            return
        self._running = False
        self._tell_stop()
        self._link.disarm()

    def _connect_and_halt(self) -> None:
        self.link()
        self._tell_stop()

    def describe(self) -> dict[str, Any]:
        try:
            self.link()
            return {"device": self.name, "kind": self.kind, "angle_deg": self._ask_angle()}
        finally:
            self._close()

    def _facts(self) -> dict[str, Any]:
        return {"stamp_sigma_s": 0.005, "table": self.target, "reversed": self.reversed}
