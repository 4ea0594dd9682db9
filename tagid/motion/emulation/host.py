"""An emulated robot with all its interfaces: a pty as serial port, loopback UDP for its true angle."""

from __future__ import annotations

import math
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from tagid.errors import UsageError
from tagid.motion.emulation.body import BodySettings
from tagid.motion.emulation.pty import PtyPort
from tagid.motion.emulation.roomba import RoombaCore, World
from tagid.motion.emulation.truth import TruthServer

EVENTS: Final = {
    "bump": ("bump", 1),
    "wheel-drop": ("wheel_drop", 2),
    "cliff": ("cliff", True),
    "charger": ("on_charger", True),
}
"""What changes in the robot's world at an event."""


class _Timed(RoombaCore):
    """A robot to which an event happens after it has turned for a given time."""

    event = ""
    after_s = math.inf
    _since: float | None = None

    def advance(self, now_s: float) -> bytes:
        if self._since is None and self.body.moving:
            self._since = now_s
        if self._since is not None and now_s - self._since >= self.after_s:
            happen(self.world, self.event)
        return super().advance(now_s)


def happen(world: World, event: str) -> None:
    """Trigger one of EVENTS."""
    setattr(world, *EVENTS[event])


class RoombaHost:
    """A running robot; a context manager.

    Args:
        body, world, baud, asleep: see RoombaCore.
        event: WHAT@SECONDS; None for no event.
        truth_port: UDP port of the true angle; 0 selects any free port.
        link: a symbolic link to create for the serial port.

    Attributes:
        core: the robot; inspect it while holding port.lock.
        port: its serial port.
        truth: provides `angle_rad`, `moving` and `still_since_s` (time.monotonic()).

    Raises UsageError for an event that is not valid.
    """

    def __init__(
        self,
        body: BodySettings | None = None,
        world: World | None = None,
        baud: int = 115200,
        asleep: bool = False,
        event: str | None = None,
        truth_port: int = 0,
        link: Path | None = None,
    ) -> None:
        self.core = _Timed(body, world, time.monotonic(), baud, asleep)
        if event is not None:
            self.core.event, _, after = event.partition("@")
            try:
                self.core.after_s = float(after or 0)
            except ValueError:
                self.core.event = ""
            if self.core.event not in EVENTS:
                raise UsageError(f"the event is {event!r}", f"Give {', '.join(EVENTS)} with @SECONDS.")
        self.port = PtyPort(self.core, link)
        self.truth = TruthServer(self._state, truth_port)
        self._stack = ExitStack()

    def _state(self, moment_s: float) -> dict[str, float | int | bool]:
        with self.port.lock:
            body = self.core.body
            return {
                "angle_rad": body.heading_at(moment_s),
                "moving": body.moving,
                "still_since_s": body.still_since_s,
                "mode": int(self.core.mode),
            }

    def __enter__(self) -> RoombaHost:
        self._stack.enter_context(self.port)
        self._stack.enter_context(self.truth)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()
