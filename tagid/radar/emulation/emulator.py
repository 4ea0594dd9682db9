"""The emulated radar on a UDP port or a pseudo-terminal; used by `tagid emulate`.

It adds to the core what a real link adds: faults, real time and flow control.
"""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.faults import Faults, FaultyPath
from tagid.radar.emulation.wires import UdpWire, Wire
from tagid.radar.links import DEFAULT_PORT, bind_udp

_IDLE_S: Final = 0.05


@dataclass(frozen=True)
class ServeOptions:
    """Options of the emulator.

    Attributes:
        host, port: address to listen on; port 0 takes any free one.
        rate: emulated seconds per second; 1 is real time, 0 as fast as the receiver reads scans.
        faults: network faults to inject.
    """

    host: str = "127.0.0.1"
    port: int = DEFAULT_PORT
    rate: float = 1.0
    faults: Faults = field(default_factory=Faults)


def serve(core: EmulatorCore, wire: Wire, options: ServeOptions, stop_event: threading.Event) -> None:
    """Serves one emulated radar on a wire until `stop_event` is set; closes the wire."""
    try:
        Server(core, options, wire).run(stop_event)
    finally:
        wire.close()


def serve_udp(
    core: EmulatorCore,
    options: ServeOptions,
    stop_event: threading.Event,
    on_ready: Callable[[str, int], None] | None = None,
) -> None:
    """Serves one emulated radar on UDP. `on_ready` is called with the address once it listens.

    Raises PortInUseError if another program holds the port.
    """
    sock = bind_udp(options.host, options.port)
    host, port = sock.getsockname()
    if on_ready:
        on_ready(host, port)
    serve(core, UdpWire(sock), options, stop_event)


class Server:
    """Moves packets between the core and a link as time passes."""

    def __init__(self, core: EmulatorCore, options: ServeOptions, wire: Wire) -> None:
        self._core = core
        self._rate = options.rate
        self._wire = wire
        self._path = FaultyPath(options.faults)
        self._origin = time.monotonic() - (core.now_s / options.rate if options.rate else 0.0)
        self._orders: queue.SimpleQueue[Callable[[], Any]] = queue.SimpleQueue()
        if options.rate:
            core.follow(lambda emulated_s: self._origin + emulated_s / options.rate)

    def order(self, what: Callable[[], Any]) -> None:
        """Schedule an action to run on the serving thread between two packets."""
        self._orders.put(what)

    def run(self, stop_event: threading.Event) -> None:
        while not stop_event.is_set():
            while not self._orders.empty():
                self._orders.get()()
            for packet in self._wire.requests(self._wait_s()):
                if self._path.request_arrives():
                    self.send(self._core.handle(packet))
            if self._rate:
                self._keep_time()
            elif self._core.next_due_s is not None and self._wire.ready():
                self.send(self._core.step())
            self._release()

    def send(self, packets: list[bytes]) -> None:
        if packets:
            self._wire.send(self._path.pass_on(packets, self._core.now_s))

    def _keep_time(self) -> None:
        now = (time.monotonic() - self._origin) * self._rate
        if self._wire.paces and self._core.scanning and not self._wire.ready():
            self._core.hold_back(now)
        else:
            self.send(self._core.advance_by_one(now))

    def _release(self) -> None:
        """Send packets that were held back when they are due, or at once if no packet can follow them."""
        if self._path.holding:
            if self._core.next_due_s is None:
                late = self._path.flush(self._core.now_s if self._rate else math.inf)
            else:
                late = self._path.pass_on([], self._core.now_s)
            self._wire.send(late)

    def _wait_s(self) -> float:
        due = self._core.next_due_s
        held = self._path.next_due_s
        if due is None and held is None:
            return _IDLE_S
        if not self._rate:
            return 0.0
        first = min(time_s for time_s in (due, held) if time_s is not None)
        return min(max(self._origin + first / self._rate - time.monotonic(), 0.0), _IDLE_S)
