"""Stream frames out of any bytes: what is no frame is dropped byte by byte until one fits again.

A robot that wakes up prints text, a plug that is pushed in makes noise, and a bridge may lose a piece.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from tagid.motion.roomba.messages import GROUPS, PACKETS, packet_size, unpack_packet

HEADER: Final = 19
MAX_BODY: Final = 170
"""A frame of 15 ms at 115200 baud holds at most 172 bytes."""


class StreamDecoder:
    """Bytes in, frames out.

    Args:
        packets: the ids that were asked for; a frame of other ids is noise that happens to add up (its chance
            is 1 in 256 a byte). None takes any valid frame.

    Attributes:
        frames: good frames so far.
        dropped: bytes that belonged to none.
    """

    def __init__(self, packets: Sequence[int] | None = None) -> None:
        self._packets = None if packets is None else tuple(packets)
        self._buffer = bytearray()
        self.frames = 0
        self.dropped = 0

    def feed(self, data: bytes) -> list[dict[int, int]]:
        """The frames that are complete now, oldest first, as {packet: value}."""
        self._buffer += data
        found: list[dict[int, int]] = []
        start = 0
        buffer = self._buffer
        while start < len(buffer):
            if buffer[start] != HEADER:
                start += 1
                self.dropped += 1
                continue
            if start + 1 >= len(buffer):
                break
            size = buffer[start + 1]
            plausible = 2 <= size <= MAX_BODY and (self._packets is None or size == self._body_size())
            if plausible and start + size + 3 > len(buffer):
                break
            frame = bytes(buffer[start : start + size + 3])
            values = self._parse(frame[2:-1]) if plausible and sum(frame) & 0xFF == 0 else None
            if values is None:
                start += 1
                self.dropped += 1
                continue
            found.append(values)
            self.frames += 1
            start += size + 3
        del buffer[:start]
        return found

    def _body_size(self) -> int:
        return sum(1 + packet_size(packet) for packet in self._packets or ())

    def _parse(self, body: bytes) -> dict[int, int] | None:
        values: dict[int, int] = {}
        order: list[int] = []
        at = 0
        while at < len(body):
            packet = body[at]
            if packet not in PACKETS and packet not in GROUPS:
                return None
            size = packet_size(packet)
            data = body[at + 1 : at + 1 + size]
            if len(data) < size:
                return None
            values |= unpack_packet(packet, data)
            order.append(packet)
            at += 1 + size
        return values if self._packets is None or tuple(order) == self._packets else None
