"""Extracts stream frames from a byte stream: invalid data is skipped byte by byte until a frame fits.

A robot that wakes up prints text, connecting a plug causes noise, and a bridge may lose data.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from tagid.motion.roomba.messages import GROUPS, PACKETS, packet_size, unpack_packet

HEADER: Final = 19
MAX_BODY: Final = 170
"""A frame of 15 ms at 115200 baud holds at most 172 bytes."""


class StreamDecoder:
    """Decoder from bytes to frames.

    Args:
        packets: ids in a valid frame; a frame with other ids is noise with a matching checksum (probability
            1 in 256 per byte). None accepts any valid frame.

    Attributes:
        frames: valid frames so far.
        dropped: bytes outside any frame.
    """

    def __init__(self, packets: Sequence[int] | None = None) -> None:
        self._packets = None if packets is None else tuple(packets)
        self._buffer = bytearray()
        self.frames = 0
        self.dropped = 0

    def feed(self, data: bytes) -> list[dict[int, int]]:
        """The frames that are complete, oldest first, as {packet: value}."""
        self._buffer += data
        frames: list[dict[int, int]] = []
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
            frames.append(values)
            self.frames += 1
            start += size + 3
        del buffer[:start]
        return frames

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
