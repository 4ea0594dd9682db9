"""The true angle of an emulated robot, served over loopback so that an emulated radar sees it turn.

The radar and the robot may run in different processes; both share this machine's monotonic clock.
"""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections.abc import Callable
from typing import Final

from tagid.errors import DeviceError, UsageError
from tagid.radar.links import bind_udp
from tagid.workers import Worker

_LONGEST: Final = 512
_TRIES: Final = 3
_WAIT_S: Final = 0.5
_LOOK_S: Final = 0.1


class TruthServer:
    """Answers `{"at": monotonic seconds}` with the result of `state` at that time; a context manager.

    Args:
        state: function from a time (time.monotonic) to JSON values; `angle_rad` is the true angle.
        port: port on 127.0.0.1; 0 selects any free one.
    """

    def __init__(self, state: Callable[[float], dict[str, float | int | bool]], port: int = 0) -> None:
        self._state = state
        self._socket = bind_udp("127.0.0.1", port)
        self._socket.settimeout(_LOOK_S)
        self._stop = threading.Event()
        self.worker = Worker(self._serve, "true-angle")
        self.address = f"127.0.0.1:{self._socket.getsockname()[1]}"

    def __enter__(self) -> TruthServer:
        self.worker.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self.worker.join(5)
        self._socket.close()

    def _serve(self) -> None:
        while not self._stop.is_set():
            try:
                asked, sender = self._socket.recvfrom(_LONGEST)
                moment = float(json.loads(asked)["at"])
            except (TimeoutError, ValueError, KeyError, TypeError):
                continue
            with contextlib.suppress(OSError):
                self._socket.sendto(json.dumps(self._state(moment)).encode(), sender)


class TrueAngle:
    """Client of a TruthServer.

    Args:
        address: HOST:PORT on this machine.

    Raises UsageError for an address that is not valid.
    """

    def __init__(self, address: str) -> None:
        host, _, port = address.rpartition(":")
        if not host.startswith("127.") or not port.isdecimal() or not 0 < int(port) < 65536:
            raise UsageError(
                f"the turning robot's address is {address!r}",
                "Give the address of the true angle that `tagid emulate roomba` prints: 127.0.0.1:PORT.",
            )
        self._address = (host, int(port))

    def state(self, moment_s: float | None = None) -> dict[str, float]:
        """State at a time of the monotonic clock; now if none is given. Raises DeviceError."""
        moment = time.monotonic() if moment_s is None else moment_s
        asked = json.dumps({"at": moment}).encode()
        for _ in range(_TRIES):
            try:
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
                    wire.settimeout(_WAIT_S)
                    wire.sendto(asked, self._address)
                    answer = json.loads(wire.recv(_LONGEST))
            except (OSError, ValueError):
                continue
            if isinstance(answer, dict) and isinstance(answer.get("angle_rad"), int | float):
                return answer
        raise DeviceError(
            f"the emulated robot at {self._address[0]}:{self._address[1]} does not report its angle",
            "Start `tagid emulate roomba` first.",
        )

    def at(self, moment_s: float) -> float:
        """True angle, rad."""
        return float(self.state(moment_s)["angle_rad"])
