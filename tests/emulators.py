"""Emulated radars on real wires, each on a thread of the test's process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from tagid.errors import DeviceError
from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.emulator import ServeOptions, Server
from tagid.radar.emulation.wires import PtyWire, UdpWire, Wire
from tagid.radar.framing import Framing
from tagid.radar.links import bind_udp
from tagid.workers import Worker

_IDLE_S: Final = 0.05
_ORDER_S: Final = 10.0


class _Emulator:
    """An emulated radar on a thread, whose failure `order` and the exit raise as DeviceError."""

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
    """An emulated radar on a UDP port; PortInUseError on entry if it is in use."""

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
    """An emulated radar on a pseudo-terminal; without `baud` it sends as fast as the reader reads.

    `link` is the path of a symbolic link to the port, which stays the same when the device is reconnected.
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
