"""The emulated radar on a real UDP port: what stands behind `tagid emulate`.

It adds to the core only what a network adds: a socket, faults, real time, and a pace the receiver can take.
"""

from __future__ import annotations

import select
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Final, Protocol, Self

from tagid.errors import UsageError
from tagid.radar.emulator_core import EmulatorCore
from tagid.radar.faults import Faults, FaultyPath
from tagid.radar.links import DEFAULT_PORT, bind_udp
from tagid.radar.pacing import queued_bytes

_IDLE_S: Final = 0.05
_LARGEST_DATAGRAM: Final = 65_535
_WORST_LAG_S: Final = 0.5
_QUEUE_LIMIT: Final = 64 * 1024
"""Bytes waiting at the receiver from which an unlimited emulator holds its next scan back."""
_UNSEEN_PACE_S: Final = 2e-3
"""Time between scans where the receiver's queue cannot be seen (another machine, not Linux)."""


class StopEvent(Protocol):
    """`threading.Event` and `multiprocessing.Event` alike."""

    def is_set(self) -> bool:
        """Whether to stop."""
        ...


@dataclass(frozen=True)
class ServeOptions:
    """How the emulator runs.

    Attributes:
        host, port: address to listen on; port 0 takes any free one.
        rate: emulated seconds per second; 1 is real time, 0 as fast as the receiver takes scans.
        faults: of the network.
    """

    host: str = "127.0.0.1"
    port: int = DEFAULT_PORT
    rate: float = 1.0
    faults: Faults = field(default_factory=Faults)

    def __post_init__(self) -> None:
        if not 0 <= self.rate <= 1e6:
            raise UsageError(f"emulator rate is {self.rate}", "Give 1 for real time, 0 for no limit.")


def serve_udp(
    core: EmulatorCore,
    options: ServeOptions,
    stop_event: StopEvent,
    on_ready: Callable[[str, int], None] | None = None,
) -> None:
    """Serves one emulated radar until `stop_event` is set. `on_ready` is told the address when it listens.

    Raises PortInUseError where another program holds the port.
    """
    with bind_udp(options.host, options.port) as sock:
        host, port = sock.getsockname()
        if on_ready:
            on_ready(host, port)
        _Server(core, options, sock).run(stop_event)


class _Server:
    def __init__(self, core: EmulatorCore, options: ServeOptions, sock: socket.socket) -> None:
        self._core = core
        self._rate = options.rate
        self._socket = sock
        self._path = FaultyPath(options.faults)
        self._client: tuple[str, int] | None = None
        self._origin = time.monotonic() - (core.now_s / options.rate if options.rate else 0.0)
        sock.setblocking(False)

    def run(self, stop_event: StopEvent) -> None:
        while not stop_event.is_set():
            readable, _, _ = select.select([self._socket], [], [], self._wait_s())
            if readable:
                self._answer()
            if self._rate:
                self._send(self._core.advance_by_one((time.monotonic() - self._origin) * self._rate))
                # A source slower than the radar slows the emulated clock; it must not end in bursts.
                lag = time.monotonic() - self._origin - self._core.now_s / self._rate
                self._origin += lag if lag > _WORST_LAG_S else 0.0
            elif self._core.next_due_s is not None and self._receiver_ready():
                self._send(self._core.step())
            if self._core.next_due_s is None:
                self._transmit(self._path.flush())

    def _wait_s(self) -> float:
        due = self._core.next_due_s
        if due is None:
            return _IDLE_S
        if not self._rate:
            return 0.0
        return min(max(self._origin + due / self._rate - time.monotonic(), 0.0), _IDLE_S)

    def _receiver_ready(self) -> bool:
        """Back-pressure: the next scan waits while the receiver has not read the ones before."""
        waiting = queued_bytes(self._client) if self._client else None
        if waiting is None:
            time.sleep(_UNSEEN_PACE_S)
            return True
        if waiting > _QUEUE_LIMIT:
            time.sleep(2e-4)
            return False
        return True

    def _answer(self) -> None:
        try:
            packet, sender = self._socket.recvfrom(_LARGEST_DATAGRAM)
        except OSError:
            return  # an ICMP error of a client that is gone
        if not self._path.request_arrives():
            return
        answers = self._core.handle(packet)
        if answers:
            self._client = sender
        self._send(answers)

    def _send(self, packets: list[bytes]) -> None:
        self._transmit(self._path.pass_on(packets, self._core.now_s))

    def _transmit(self, packets: list[bytes]) -> None:
        if self._client is None:
            return
        for packet in packets:
            try:
                self._socket.sendto(packet, self._client)
            except OSError:
                continue  # the wire loses what it cannot carry; so does the radar


class UdpEmulator:
    """The emulator on a thread, for tests and demos in one process; a context manager.

    Raises PortInUseError on entry where the port is taken.
    """

    def __init__(self, core: EmulatorCore, options: ServeOptions | None = None) -> None:
        self._core = core
        self._options = options or ServeOptions(port=0)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.address: tuple[str, int] = ("", 0)

    @property
    def url(self) -> str:
        """The radar URL to connect to."""
        return f"udp://{self.address[0]}:{self.address[1]}"

    def __enter__(self) -> Self:
        sock = bind_udp(self._options.host, self._options.port)
        self.address = sock.getsockname()
        server = _Server(self._core, self._options, sock)

        def work() -> None:
            with sock:
                server.run(self._stop)

        self._thread = threading.Thread(target=work, name="p440-emulator", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        if self._thread:
            self._thread.join(timeout=5)
