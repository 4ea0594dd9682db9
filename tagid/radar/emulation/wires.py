"""The emulated radar's side of the link: a UDP port, or a pseudo-terminal with USB or UART frames.

The server that uses these classes knows neither; it receives requests and sends packets.
"""

from __future__ import annotations

import os
import select
import socket
import time
import tty
from collections import deque
from pathlib import Path
from typing import Final, Protocol

from tagid.errors import StorageError
from tagid.radar.framing import Framing, StreamDecoder, frame
from tagid.radar.messages import MessageType
from tagid.radar.scan_info import SCAN_INFO_HEAD

_TABLE: Final = Path("/proc/net/udp")


def queued_bytes(address: tuple[str, int]) -> int | None:
    """Bytes waiting in the receive queue of a UDP port on this machine; None if that cannot be seen.

    A row is "sl local_address rem_address st tx_queue:rx_queue ...", numbers in hexadecimal (Linux, proc(5)).
    """
    host, port = address
    if not host.startswith("127."):
        return None
    try:
        rows = _TABLE.read_text(encoding="ascii").splitlines()[1:]
    except (OSError, UnicodeDecodeError):
        return None
    for row in rows:
        columns = row.split()
        try:
            if int(columns[1].rpartition(":")[2], 16) == port:
                return int(columns[4].partition(":")[2], 16)
        except (IndexError, ValueError):
            return None
    return None


_LARGEST_DATAGRAM: Final = 65_535
_QUEUE_LIMIT: Final = 64 * 1024
"""Bytes waiting at a UDP receiver above which an emulator without a clock delays its next scan."""
_UNSEEN_PACE_S: Final = 2e-3
"""Time between scans if the receiver's queue is not visible (another machine, not Linux)."""
_MOST_FRAMES: Final = 256
"""Maximum number of frames queued for a serial line; more are dropped, as in the radar's own memory."""
_USB_ROOM: Final = 64
"""Maximum number of frames queued for a USB reader before the radar waits for it."""
_CONTROL_HEAD: Final = int(MessageType.CONTROL_REQUEST).to_bytes(2, "big")
_BITS_PER_BYTE: Final = 10
"""8N1: a start bit, eight data bits, a stop bit."""


class Wire(Protocol):
    """Interface that the server requires of a link."""

    paces: bool
    """Whether the link is slower than the radar, which then waits for it."""

    def requests(self, wait_s: float) -> list[bytes]:
        """Packets from clients, after waiting up to `wait_s` for them."""
        ...

    def send(self, packets: list[bytes]) -> None:
        """Send packets: scans to the client that requested them, all others to the client that sent last."""
        ...

    def ready(self) -> bool:
        """Whether the link and the receiver have room for another scan; may wait briefly."""
        ...

    def close(self) -> None:
        """Release the link."""
        ...


class UdpWire:
    """A bound UDP socket, closed with it. Answers go to who asks; scans to the port that started them."""

    paces = False

    def __init__(self, sock: socket.socket) -> None:
        self._socket = sock
        self._asker: tuple[str, int] | None = None
        self._owner: tuple[str, int] | None = None
        sock.setblocking(False)

    def requests(self, wait_s: float) -> list[bytes]:
        """At most one datagram."""
        readable, _, _ = select.select([self._socket], [], [], wait_s)
        if not readable:
            return []
        try:
            packet, self._asker = self._socket.recvfrom(_LARGEST_DATAGRAM)
        except OSError:
            return []  # an ICMP error from a client that has exited
        if packet[:2] == _CONTROL_HEAD:
            self._owner = self._asker
        return [packet]

    def send(self, packets: list[bytes]) -> None:
        """One datagram per packet; a packet that the network rejects is lost, as on a real link."""
        for packet in packets:
            target = self._owner or self._asker if packet[:2] == SCAN_INFO_HEAD else self._asker
            if target is None:
                continue
            try:
                self._socket.sendto(packet, target)
            except OSError:
                continue

    def ready(self) -> bool:
        """Back-pressure: the next scan waits until the receiver has read the previous ones."""
        target = self._owner or self._asker
        waiting = queued_bytes(target) if target else None
        if waiting is None:
            time.sleep(_UNSEEN_PACE_S)
            return True
        if waiting > _QUEUE_LIMIT:
            time.sleep(2e-4)
            return False
        return True

    def close(self) -> None:
        self._socket.close()


class PtyWire:
    """A pseudo-terminal whose other end is a serial port like any other.

    Args:
        framing: USB or UART.
        baud: maximum rate of the bytes sent (8N1); None sends as fast as the reader reads.
        link: a symbolic link to the port is maintained at this path, as udev does under /dev/serial/by-id.

    Raises StorageError if the link cannot be made.
    """

    paces = True

    def __init__(self, framing: Framing, baud: int | None = None, link: Path | None = None) -> None:
        self._framing = framing
        self._byte_s = _BITS_PER_BYTE / baud if baud else 0.0
        self._link = link
        self._decoder = StreamDecoder(framing)
        self._frames: deque[bytes] = deque()
        self._rest = b""
        self._free_at = 0.0
        # A UART is slower than the radar, so the radar waits for it; with USB only the reader may be late.
        self._room = 0 if baud else _USB_ROOM
        self._ends: tuple[int, int] | None = None
        self.dropped = 0
        self.path = ""
        self.plug()

    def plug(self) -> None:
        """Create the port, under a new name as after a reconnection; the link points to it."""
        if self._ends:
            return
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        self._ends, self.path = (master, slave), os.ttyname(slave)
        if self._link is not None:
            try:
                if self._link.is_symlink():
                    self._link.unlink()
                self._link.symlink_to(self.path)
            except OSError as error:
                raise StorageError(
                    f"cannot make the link {self._link}: {error.strerror}", "Choose another."
                ) from error

    def unplug(self) -> None:
        """Remove the port and discard all packets in transit."""
        if self._ends is None:
            return
        for end in self._ends:
            os.close(end)
        self._ends = None
        self._frames.clear()
        self._rest = b""
        self._decoder.reset()
        if self._link is not None and self._link.is_symlink():
            self._link.unlink()

    def requests(self, wait_s: float) -> list[bytes]:
        """Packets found in the bytes from the client; queued bytes are sent meanwhile."""
        if self._ends is None:
            time.sleep(min(wait_s, 0.01))
            return []
        master = self._ends[0]
        pending = bool(self._frames or self._rest)
        blocked = max(self._free_at - time.monotonic(), 0.0) if pending else 0.0
        writers = [master] if pending and not blocked else []
        readable, _, _ = select.select([master], writers, [], min(wait_s, blocked) if blocked else wait_s)
        self._pump()
        if not readable:
            return self._decoder.flush()
        try:
            return self._decoder.feed(os.read(master, _LARGEST_DATAGRAM))
        except OSError:
            return []

    def send(self, packets: list[bytes]) -> None:
        """Frame packets and write as many bytes as the line accepts now."""
        for packet in packets:
            if self._ends is None or len(self._frames) >= _MOST_FRAMES:
                self.dropped += 1
            else:
                self._frames.append(frame(packet, self._framing))
        self._pump()

    def ready(self) -> bool:
        """Whether everything sent so far has been written; without a baud rate, nearly everything."""
        return self._ends is None or len(self._frames) + bool(self._rest) <= self._room

    def close(self) -> None:
        self.unplug()

    def _pump(self) -> None:
        while self._ends is not None and (self._rest or self._frames):
            now = time.monotonic()
            if now < self._free_at:
                return
            if not self._rest:
                self._rest = self._frames.popleft()
            # At a finite rate send 10 ms worth of bytes at a time, so that answers are sent on time.
            limit = max(1, round(0.01 / self._byte_s)) if self._byte_s else len(self._rest)
            try:
                written = os.write(self._ends[0], self._rest[:limit])
            except OSError:
                return  # the line is full, or the client closed its end; the port remains
            self._rest = self._rest[written:]
            self._free_at = max(self._free_at, now - 0.01) + written * self._byte_s
            if written == 0:
                return
