"""The emulated radar's side of the wire: a UDP port, or a pseudo-terminal with USB or UART frames on it.

The server above knows neither; it gets requests, and hands over what the radar sends.
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
from tagid.radar.emulation.pacing import queued_bytes
from tagid.radar.framing import Framing, StreamDecoder, frame
from tagid.radar.messages import MessageType
from tagid.radar.scan_info import SCAN_INFO_HEAD

_LARGEST_DATAGRAM: Final = 65_535
_QUEUE_LIMIT: Final = 64 * 1024
"""Bytes waiting at a UDP receiver from which an unlimited emulator holds its next scan back."""
_UNSEEN_PACE_S: Final = 2e-3
"""Time between scans where the receiver's queue cannot be seen (another machine, not Linux)."""
_MOST_FRAMES: Final = 256
"""Frames that wait for a serial line; more are dropped, as a radar's own memory would."""
_USB_ROOM: Final = 64
"""Frames that may wait for a reader on USB before the radar waits for it."""
_CONTROL_HEAD: Final = int(MessageType.CONTROL_REQUEST).to_bytes(2, "big")
_BITS_PER_BYTE: Final = 10
"""8N1: a start bit, eight data bits, a stop bit."""


class Wire(Protocol):
    """What the server needs of a wire."""

    paces: bool
    """Whether the wire is slower than the radar, which then waits for it."""

    def requests(self, wait_s: float) -> list[bytes]:
        """Packets of clients, after waiting for them up to `wait_s`."""
        ...

    def send(self, packets: list[bytes]) -> None:
        """Sends what leaves the radar: scans to who asked for scans, all else to who asked last."""
        ...

    def ready(self) -> bool:
        """Whether the wire and the receiver have room for another scan; may wait for a moment."""
        ...

    def close(self) -> None:
        """Frees the wire."""
        ...


class UdpWire:
    """A bound UDP socket. Answers go to the port that asked; scans continue to the port that started them.

    Args:
        sock: bound; closed with the wire.
    """

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
            return []  # an ICMP error of a client that is gone
        if packet[:2] == _CONTROL_HEAD:
            self._owner = self._asker
        return [packet]

    def send(self, packets: list[bytes]) -> None:
        """One datagram a packet; what the network does not take is lost, as on a real wire."""
        for packet in packets:
            target = self._owner or self._asker if packet[:2] == SCAN_INFO_HEAD else self._asker
            if target is None:
                continue
            try:
                self._socket.sendto(packet, target)
            except OSError:
                continue

    def ready(self) -> bool:
        """Back-pressure: the next scan waits while the receiver has not read the ones before."""
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
        """Frees the port."""
        self._socket.close()


class PtyWire:
    """A pseudo-terminal whose other end is a serial port like any other.

    Args:
        framing: USB or UART.
        baud: bytes leave no faster than this rate (8N1) allows; None is as fast as they are taken.
        link: a symbolic link to the port is kept at this path, as udev does under /dev/serial/by-id.

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
        # A UART is the bottleneck, so the radar waits for it; a USB port is not, only its reader may be late.
        self._room = 0 if baud else _USB_ROOM
        self._ends: tuple[int, int] | None = None
        self.dropped = 0
        self.path = ""
        self.plug()

    def plug(self) -> None:
        """Makes the port, under a new name as a replugged device may get; the link leads to it."""
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
        """The port vanishes with all that was under way."""
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
        """Packets found in what the client wrote; bytes that wait go out meanwhile."""
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
        """Frames packets and writes what the line takes now."""
        for packet in packets:
            if self._ends is None or len(self._frames) >= _MOST_FRAMES:
                self.dropped += 1
            else:
                self._frames.append(frame(packet, self._framing))
        self._pump()

    def write_raw(self, data: bytes) -> None:
        """Puts bytes that are no frame on the line, behind the frames that wait."""
        if self._ends is not None:
            self._frames.append(data)

    def ready(self) -> bool:
        """Whether everything sent so far is on the line; without a baud rate, nearly everything."""
        return self._ends is None or len(self._frames) + bool(self._rest) <= self._room

    def close(self) -> None:
        """Frees the port and takes the link away."""
        self.unplug()

    def _pump(self) -> None:
        while self._ends is not None and (self._rest or self._frames):
            now = time.monotonic()
            if now < self._free_at:
                return
            if not self._rest:
                self._rest = self._frames.popleft()
            # At a real rate a hundredth of a second's bytes go at a time, so that answers come in their time.
            limit = max(1, round(0.01 / self._byte_s)) if self._byte_s else len(self._rest)
            try:
                written = os.write(self._ends[0], self._rest[:limit])
            except OSError:
                return  # the line is full for now, or the client's end is gone; the port stays
            self._rest = self._rest[written:]
            self._free_at = max(self._free_at, now - 0.01) + written * self._byte_s
            if written == 0:
                return
