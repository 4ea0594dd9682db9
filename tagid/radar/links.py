"""Links carry whole packets between the client and a radar, independent of the messages in them.

The client uses the same Link protocol for a real radar, an emulator and a replay.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import sys
import time
from typing import Any, Final, Protocol

from tagid.errors import DeviceError, DeviceTimeoutError, PortInUseError
from tagid.workers import Worker

DEFAULT_PORT: Final = 21210
"""UDP port on which a P440 listens (P440 MRM API)."""

_RECEIVE_BUFFER: Final = 4 * 1024 * 1024
_LARGEST_DATAGRAM: Final = 65_535
_RESOLVE_S: Final = 10.0
_REPORT_ERRORS: Final = 11
"""IP_RECVERR of Linux, which the socket module lacks: later calls report what ICMP says of a packet."""
_NOT_REACHED: Final = (errno.ECONNREFUSED, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN)


class Link(Protocol):
    """Carries packets to and from one radar."""

    foreign: int
    """Packets dropped because another sender sent them."""

    @property
    def skipped_bytes(self) -> int:
        """Number of bytes outside any packet: noise on a serial line, truncated frames."""
        ...

    guarded: bool
    """Whether a checksum keeps damaged packets out: UDP and UART have one, USB frames have none."""

    packet_time_s: float
    """Duration of the longest packet on the link, s; 0 if negligible."""

    @property
    def exhausted(self) -> bool:
        """True when no further packet can arrive (the end of a replay)."""
        ...

    def send(self, packet: bytes) -> None:
        """Send one packet. Raises DeviceError if the link is down."""
        ...

    def receive(self, timeout: float) -> bytes | None:
        """The next packet, or None if none arrived within `timeout` seconds."""
        ...

    def reopen(self) -> None:
        """Make the link usable again after the device disconnected. Raises DeviceGoneError if it still is."""
        ...

    def close(self) -> None:
        """Release the link; has no effect if it is closed already."""
        ...


def bind_udp(host: str, port: int) -> socket.socket:
    """A UDP socket bound to an address; port 0 selects any free one.

    Raises PortInUseError if another program holds the port, DeviceError for an address of another machine.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        sock.bind((host, port))
    except (OSError, OverflowError) as error:
        sock.close()
        if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
            raise PortInUseError(
                f"UDP port {port} on {host or 'this machine'} is in use",
                "Stop the program that uses it (an emulator, another tagid) or choose another port.",
            ) from error
        raise DeviceError(
            f"cannot open UDP port {port} on {host or 'this machine'}: {error}",
            "Give an address of this machine and a port from 1024 to 65535.",
        ) from error
    return sock


def resolve(host: str, port: int) -> tuple[str, int]:
    """IPv4 address and port of a host name. Raises DeviceError for an unknown host or a bad port.

    The resolver of the system may take long and hears no signal meanwhile, so it runs on a thread of its own.
    """
    if not 1 <= port <= 65_535:
        raise DeviceError(f"radar port is {port}", "Give a port from 1 to 65535 (a P440 listens on 21210).")
    infos: list[Any] = []
    worker = Worker(
        lambda: infos.extend(socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)), "resolver"
    )
    with contextlib.suppress(RuntimeError):
        worker.start()
    ended = worker.join(_RESOLVE_S)
    if not infos:
        why = worker.failure if ended else f"no answer within {_RESOLVE_S:g} s"
        raise DeviceError(
            f"radar host {host!r} is unknown ({why})",
            "Give the radar's IPv4 address; kit units use 192.168.1.100 to 103.",
        ) from worker.failure
    address = infos[0][4]
    return str(address[0]), int(address[1])


def port_remedy(port: int) -> str:
    """What to check of the port of a radar's URL, after "Check"."""
    usual = "" if port == DEFAULT_PORT else f"; a P440 listens on {DEFAULT_PORT}"
    return f"the port of the URL ({port}{usual})"


class UdpLink:
    """UDP to one radar; packets from any other address or port are counted in `foreign` and dropped.

    Args:
        host: name or IPv4 address of the radar.
        local_port: port to receive on; 0 selects any free one.

    Raises:
        DeviceError: unknown host, or no network.
        PortInUseError: `local_port` is in use.
    """

    exhausted = False
    guarded = True
    skipped_bytes = 0
    packet_time_s = 0.0

    def __init__(self, host: str, port: int = DEFAULT_PORT, local_port: int = 0) -> None:
        self.address = resolve(host, port)
        self.foreign = 0
        self._socket = bind_udp("", local_port)
        self._heard = False
        if sys.platform == "linux":
            self._socket.setsockopt(socket.IPPROTO_IP, _REPORT_ERRORS, 1)

    def __repr__(self) -> str:
        return f"udp://{self.address[0]}:{self.address[1]}"

    @property
    def local_port(self) -> int:
        """The port on which answers arrive."""
        return int(self._socket.getsockname()[1])

    def send(self, packet: bytes) -> None:
        """Send one datagram. Raises DeviceError if the network is down."""
        try:
            try:
                self._socket.sendto(packet, self.address)
            except OSError as error:
                if error.errno not in _NOT_REACHED:
                    raise
                self._socket.sendto(packet, self.address)  # the first call may report an earlier packet
        except OSError as error:
            raise DeviceError(
                f"cannot send to the radar at {self.address[0]}:{self.address[1]}: {error}",
                "Check the cable and that this computer has an address in the radar's network (192.168.1.x).",
            ) from error

    def receive(self, timeout: float) -> bytes | None:
        """The next datagram from the radar, or None after `timeout` seconds.

        Raises DeviceTimeoutError if its host says that no program listens on the port, and no datagram ever
        came from there; one that was heard may be about to return.
        """
        deadline = time.monotonic() + timeout
        while True:
            # A flood of foreign packets must not extend the wait beyond the deadline.
            self._socket.settimeout(max(deadline - time.monotonic(), 1e-4))
            try:
                packet, sender = self._socket.recvfrom(_LARGEST_DATAGRAM)
                if sender == self.address:
                    self._heard = True
                    return packet
                self.foreign += 1
            except TimeoutError:
                return None
            except OSError as error:
                if isinstance(error, ConnectionError) and not self._heard:
                    raise DeviceTimeoutError(
                        f"nothing listens at {self}",
                        f"Check power and cable, {port_remedy(self.address[1])}, and that the radar or its "
                        "emulator runs.",
                    ) from error
                if error.errno not in _NOT_REACHED:
                    raise DeviceError(
                        f"cannot receive from the radar: {error}", "Check the network."
                    ) from error
            if time.monotonic() >= deadline:
                return None

    def reopen(self) -> None:
        """Nothing to do: a UDP socket survives a restart of the radar."""

    def close(self) -> None:
        self._socket.close()
