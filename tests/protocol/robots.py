"""What the tests of robots wait for."""

from __future__ import annotations

import time

from tagid.motion.emulation.roomba import RoombaHost
from tagid.motion.roomba.device import Roomba


def turned(motion: Roomba, radians: float) -> None:
    """Return once the robot has turned so far; fail after 20 s, or where the motion does."""
    deadline = time.monotonic() + 20
    while abs(motion.turned_rad) < radians:
        motion.check()
        assert time.monotonic() < deadline
        time.sleep(0.005)


def comes_to_rest(host: RoombaHost, timeout_s: float) -> bool:
    """Whether the wheels stop within a time."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        with host.port.lock:
            if not host.core.body.moving:
                return True
        time.sleep(0.002)
    return False
