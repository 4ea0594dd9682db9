"""Comxim turntables (also sold as Revopoint TA500) on a serial port: ASCII commands that begin with `CT+`.

`comxim+serial:///dev/ttyUSB1?speed=3`; commands are spelt as in the manufacturer's protocol, errors included.
"""

from __future__ import annotations

import math
from typing import Final

from tagid.errors import DeviceRejectedError, DeviceTimeoutError
from tagid.motion.driven import AngleReading
from tagid.motion.links import SerialLink
from tagid.motion.tables.polled import PolledTable
from tagid.motion.urls import Options

BAUD: Final = 115200
SECONDS_A_TURN: Final = 20.0
"""Seconds per turn at speed 1 (an estimate); higher numbers are slower. Give `period` if it matters."""
BOUND_S: Final = 6.0
"""Time for which a command lets the table turn, at its nominal speed; renewed at half of it, s."""
CLOCKWISE, COUNTER_CLOCKWISE = 0, 1
"""Arguments of SETDIR: 0 is left, clockwise, according to ComXim's command list as a public client quotes it
(docs/motion.md)."""
STOP: Final = b";CT+SETSTOP();"
"""For a stop that may interrupt an unknown command: the first semicolon ends it."""


class Comxim(PolledTable):
    """A Comxim table; see PolledTable. speed is its own number, 1 the fastest."""

    kind = "comxim"
    stops_by = "disconnect its power supply"
    warning = "If its cable is disconnected nothing stops it: then disconnect its power supply"
    prefix, accepted, accepted_s = "CT+", "OK", 2.0
    angle_query, angle_name = b"CT+GETOFFSETANGLE();", "OffsetAngle"
    speed = 1
    _renewed_deg: float | None = None
    """The angle at which the current step was commanded; None while a command is not renewed."""

    @property
    def _way(self) -> int:
        return CLOCKWISE if self.commanded < 0 else COUNTER_CLOCKWISE

    @property
    def step_deg(self) -> int:
        """The angle after which the table stops unless the command is renewed, degrees."""
        return max(10, min(360, round(360 * BOUND_S / self.nominal_s)))

    def _set_going(self) -> None:
        # A table that is still turning rejects the settings of a new run.
        self.link().write(b"CT+STARTUP();CT+ACK(1);CT+EVENT(1);")
        self.answer("OK", 2.0)
        for command in ("SETSTOP()", "SETMODE(0)", f"SETDIR({self._way})", f"SETSPEED({self.speed})"):
            self._command(command)
        self._renewed_deg = 0.0 if self._step(self.step_deg) else None

    def _step(self, degrees: int) -> bool:
        """Turn by an angle from here; without end, and False, if the table takes no angle."""
        try:
            self._command(f"TRUNSINGLE({self._way},{degrees})")
        except DeviceRejectedError:
            self._command("RUN()")
            return False
        return True

    def _poll(self) -> list[AngleReading]:
        readings = super()._poll()
        turned = abs(self._turned_deg)
        if self._renewed_deg is not None and turned - self._renewed_deg > self.step_deg / 2:
            self._renewed_deg = turned
            try:
                self._command(f"TRUNSINGLE({self._way},{self.step_deg})")
            except DeviceRejectedError:
                # It takes no command while it turns: stop it, and command all that remains at once.
                self._renewed_deg = None
                self._command("SETSTOP()")
                self._step(math.ceil(360 * self.turns - turned) + self.step_deg)
        return readings

    def _tell_stop(self) -> None:
        try:
            self._command("SETSTOP()")
        except DeviceTimeoutError:
            self._command("SETSTOP()")


def open_serial(options: Options) -> Comxim:
    """Options: speed (1 and higher, higher is slower), period (s per turn), direction, reversed, turns."""
    port = options.port()
    speed = int(options.number("speed", 1, 1, 1000))
    table = Comxim(
        lambda: SerialLink(port, BAUD, STOP),
        port,
        options.direction(),
        options.number("period", SECONDS_A_TURN * speed, 1, 3600),
        options.number("turns", None, 0.01, 20),
    )
    table.speed = speed
    table.reversed = options.reversed(port)
    return table
