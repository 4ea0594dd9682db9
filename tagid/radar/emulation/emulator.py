"""The emulated radar on a UDP port or a pseudo-terminal; used by `tagid emulate`.

It adds to the core what a real link adds: faults, real time and flow control.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Protocol, Self

from tagid.errors import DeviceError, UsageError
from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.faults import Faults, FaultyPath
from tagid.radar.emulation.wires import PtyWire, UdpWire, Wire
from tagid.radar.framing import Framing
from tagid.radar.links import DEFAULT_PORT, bind_udp
from tagid.workers import Worker

_IDLE_S: Final = 0.05
_ORDER_S: Final = 10.0


class StopEvent(Protocol):
    """Accepts both `threading.Event` and `multiprocessing.Event`."""

    def is_set(self) -> bool:
        """Whether to stop."""
        ...


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

    def __post_init__(self) -> None:
        if not 0 <= self.rate <= 1e6:
            raise UsageError(f"emulator rate is {self.rate}", "Give 1 for real time, 0 for no limit.")


def serve(core: EmulatorCore, wire: Wire, options: ServeOptions, stop_event: StopEvent) -> None:
    """Serves one emulated radar on a wire until `stop_event` is set; closes the wire."""
    try:
        Server(core, options, wire).run(stop_event)
    finally:
        wire.close()


def serve_udp(
    core: EmulatorCore,
    options: ServeOptions,
    stop_event: StopEvent,
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
    """Moves packets between the core and a link as time passes.

    Args:
        core: the radar.
        options: rate and faults.
        wire: carries the packets.
    """

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

    def run(self, stop_event: StopEvent) -> None:
        """Serve until `stop_event` is set."""
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
        """Send packets of the radar through the simulated faults."""
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
                late = self._path.flush(self._core.now_s if self._rate else None)
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


class _Emulator:
    """The emulator on a thread, for tests and demos in one process; a context manager.

    If the thread has failed, `order` and the exit raise DeviceError.
    """

    def __init__(self, core: EmulatorCore, options: ServeOptions) -> None:
        self.core = core
        self._options = options
        self._stop = threading.Event()
        self._worker: Worker | None = None
        self._server: Server | None = None

    def _start(self, wire: Wire) -> None:
        self._server = server = Server(self.core, self._options, wire)

        def work() -> None:
            try:
                server.run(self._stop)
            finally:
                wire.close()

        self._worker = Worker(work, "p440-emulator")
        self._worker.start()

    def order(self, what: Callable[[], Any]) -> None:
        """Run an action on the emulator's thread and wait until it is done."""
        assert self._server is not None
        done = threading.Event()

        def work() -> None:
            what()
            done.set()

        self._server.order(work)
        deadline = time.monotonic() + _ORDER_S
        while not done.wait(_IDLE_S):
            self._check()
            if time.monotonic() > deadline:
                raise DeviceError(f"the emulated radar has not acted for {_ORDER_S:g} s")

    def _check(self) -> None:
        failure = self._worker.failure if self._worker else None
        if failure is not None:
            raise DeviceError(f"the emulated radar ended: {failure!r}") from failure

    def power_cycle(self) -> None:
        """Interrupt the power briefly: the radar boots, loses its run and sends READY_INFO."""
        self.order(self.core.power_cycle)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        if self._worker:
            self._worker.join(5)
        if error is None:
            self._check()


class UdpEmulator(_Emulator):
    """An emulated radar on a UDP port.

    Raises PortInUseError on entry if the port is in use.
    """

    def __init__(self, core: EmulatorCore, options: ServeOptions | None = None) -> None:
        super().__init__(core, options or ServeOptions(port=0))
        self.address: tuple[str, int] = ("", 0)

    @property
    def url(self) -> str:
        """The radar URL to connect to."""
        return f"udp://{self.address[0]}:{self.address[1]}"

    def __enter__(self) -> Self:
        sock = bind_udp(self._options.host, self._options.port)
        self.address = sock.getsockname()
        self._start(UdpWire(sock))
        return self


class SerialEmulator(_Emulator):
    """An emulated radar on a pseudo-terminal.

    Args:
        core: the radar.
        options: rate and faults.
        framing: USB or UART.
        baud: maximum baud rate; None sends as fast as the reader reads.
        link: path of a symbolic link to the port, whose name stays the same when the device is reconnected.
    """

    def __init__(
        self,
        core: EmulatorCore,
        options: ServeOptions | None = None,
        framing: Framing = Framing.USB,
        baud: int | None = None,
        link: Path | None = None,
    ) -> None:
        super().__init__(core, options or ServeOptions())
        self._framing = framing
        self._link = link
        self.wire = PtyWire(framing, baud, link)

    @property
    def url(self) -> str:
        """The radar URL to connect to."""
        path = self._link or self.wire.path
        return f"serial://{path}" + ("?framing=uart" if self._framing is Framing.UART else "")

    def unplug(self) -> None:
        """Disconnect the cable; the radar has its own power supply and continues."""
        self.order(self.wire.unplug)

    def plug(self) -> None:
        """Reconnect the cable; the port may have another name."""
        self.order(self.wire.plug)

    def __enter__(self) -> Self:
        self._start(self.wire)
        return self
