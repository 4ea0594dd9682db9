"""A free-running table with a magnet, and a Hall sensor on the bridge: one timestamped pulse per turn.

`index+ble://NAME`: a pulse is independent of the object's symmetry, and two pulses are exactly one turn.
"""

from __future__ import annotations

import math
import struct
import threading
import time
from collections.abc import Callable
from typing import Any, Final

from tagid import hostclock
from tagid.errors import DeviceRejectedError
from tagid.motion.ble import BleAddress, BridgeLink, ble_address
from tagid.motion.bridge.protocol import Event, IndexPulse, Op
from tagid.motion.driven import AngleReading, DrivenMotion
from tagid.motion.urls import Options

_LOOK_S: Final = 0.05
_CLOCK_EVERY_S: Final = 1.0
_LONGEST_TURN_S: Final = 300.0
_TICK_TURNS: Final = 1 / 64
"""Readings per turn interpolated between two pulses, so that every scan has an angle."""


class IndexTable(DrivenMotion):
    """A free-running table that reports each full turn.

    Args:
        direction: +1 counter-clockwise from above, -1 clockwise.
        nominal_s: seconds per turn, for the progress line.
    """

    kind = "index"
    _link: BridgeLink | None = None
    moves = False
    stops_by = "switch the table off"

    def __init__(self, address: BleAddress, direction: int, nominal_s: float, turns: float | None) -> None:
        # Two pulses are exactly one turn; the angle outside them continues at the same speed.
        super().__init__(f"the index sensor at {address.target}", direction, nominal_s, 0.001, turns or 1.0)
        self._open_link: Callable[[], BridgeLink] = lambda: BridgeLink(address, self._event)
        self._pulses: list[IndexPulse] = []
        self._new = threading.Condition()
        self._offset_ns: int | None = None
        self._round_trip_ns = 1 << 62
        self._clock_at = 0.0
        self._heard = 0.0
        self._turned = 0

    def _event(self, event: Event) -> None:
        if isinstance(event, IndexPulse):
            with self._new:
                self._pulses.append(event)
                self._new.notify_all()

    def _begin(self) -> None:
        self._link = self._open_link()
        self._pulses.clear()
        self._turned = 0
        self._heard = time.monotonic()
        self._fit_clock()

    def _fit_clock(self) -> None:
        """Bridge time versus host time, from the shortest round trip so far."""
        assert self._link is not None
        asked = hostclock.now_ns()
        (uptime_us,) = struct.unpack("<Q", self._link.request(Op.TIME)[:8])
        answered = hostclock.now_ns()
        if answered - asked < self._round_trip_ns:
            self._round_trip_ns = answered - asked
            self._offset_ns = (asked + answered) // 2 - uptime_us * 1000
        self._clock_at = time.monotonic()

    def _poll(self) -> list[AngleReading]:
        if time.monotonic() - self._clock_at > _CLOCK_EVERY_S:
            self._fit_clock()
        with self._new:
            if len(self._pulses) < 2:
                self._new.wait(_LOOK_S)
            pulses = self._pulses[:2]
            if len(pulses) == 2:
                del self._pulses[0]
        if len(pulses) < 2:
            if time.monotonic() - self._heard > _LONGEST_TURN_S:
                raise DeviceRejectedError(
                    f"{self.name} sent no pulse for {_LONGEST_TURN_S:.0f} s",
                    "Check that the table turns and the magnet passes the sensor within millimetres.",
                )
            return []
        self._heard = time.monotonic()
        assert self._offset_ns is not None
        first, second = (pulse.stamp_us * 1000 + self._offset_ns for pulse in pulses)
        missed = max(1, pulses[1].number - pulses[0].number)
        steps = round(missed / _TICK_TURNS)
        begin, self._turned = self._turned, self._turned + missed
        share = [n / steps for n in range(0 if begin == 0 else 1, steps + 1)]
        # Half the best round trip, at this turn's speed.
        sigma = self._round_trip_ns / math.sqrt(12) / max(second - first, 1) * missed * 2 * math.pi
        turn = self.direction * 2 * math.pi
        return [(round(first + s * (second - first)), turn * (begin + s * missed), sigma) for s in share]

    def _halt(self) -> None:
        """Does nothing: the table is not commanded."""

    def describe(self) -> dict[str, Any]:
        try:
            self._link = self._open_link()
            info = self._link.bridge.info
            facts = {"firmware": info.version, "chip": info.chip, "flags": str(info.flags)}
            return {"device": self.name, **facts}
        finally:
            self._close()

    def _facts(self) -> dict[str, Any]:
        return {"runs_on": True, "pulses": self._turned + 1}


def open_ble(options: Options) -> IndexTable:
    """Options: rpm (nominal), direction, turns, passkey, hci, wait."""
    address = ble_address(options)
    rpm = options.number("rpm", 2.0, 0.1, 60)
    return IndexTable(address, options.direction(), 60 / rpm, options.number("turns", None, 0.01, 20))
