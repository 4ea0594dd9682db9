"""Extracts stream frames from a byte stream: invalid data is skipped byte by byte until a frame fits.

A robot that wakes up prints text, connecting a plug causes noise, and a bridge may lose data.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from tagid.motion.roomba.messages import packet_size, unpack_packet

HEADER: Final = 19


class StreamDecoder:
    """Decoder from bytes to frames.

    Args:
        packets: ids in a valid frame; a frame with other ids is noise with a matching checksum (probability
            1 in 256 per byte).

    Attributes:
        dropped: bytes outside any frame.
    """

    def __init__(self, packets: Sequence[int]) -> None:
        self._packets = packets
        body_size = sum(1 + packet_size(packet) for packet in packets)
        self._start = bytes((HEADER, body_size))
        self._size = body_size + 3
        self._buffer = b""
        self.dropped = 0

    def feed(self, data: bytes) -> list[dict[int, int]]:
        """The frames that are complete, oldest first, as {packet: value}."""
        buffer = self._buffer + data
        frames: list[dict[int, int]] = []
        at = 0
        while at < len(buffer):
            frame = buffer[at : at + self._size]
            if len(frame) < self._size and self._start.startswith(frame[:2]):
                break  # the rest of it may follow
            values = self._parse(frame)
            if values is None:
                at += 1
                self.dropped += 1
            else:
                at += self._size
                frames.append(values)
        self._buffer = buffer[at:]
        return frames

    def _parse(self, frame: bytes) -> dict[int, int] | None:
        if not frame.startswith(self._start) or sum(frame) & 0xFF:
            return None
        values: dict[int, int] = {}
        at = len(self._start)
        for packet in self._packets:
            end = at + 1 + packet_size(packet)
            if frame[at] != packet:
                return None
            values |= unpack_packet(packet, frame[at + 1 : end])
            at = end
        return values
