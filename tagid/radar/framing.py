"""Packets in a byte stream: the frames of the P440's USB and UART ports, and a decoder that finds them.

A serial line has no packet boundaries: bytes are lost, noise is received, and samples may contain the sync
word. One damaged frame must not affect the frames after it.

Frame (P440 MRM API): `A5 A5`, length u16 of the packet, packet; on UART followed by the CRC-16 of the packet.
"""

from __future__ import annotations

import binascii
import enum
from typing import Final

from tagid.radar.messages import HEADER_DTYPE, MAX_PACKET_BYTES, MESSAGES

SYNC: Final = b"\xa5\xa5"
_PREFIX: Final = 4
_CRC: Final = 2
_SMALLEST: Final = HEADER_DTYPE.itemsize
_STRONG: Final = _PREFIX + 2
"""Bytes that identify the frame of a known message: sync, length, type."""
_SIZES: Final = {number: spec.sizes for number, spec in MESSAGES.items()}


class Framing(enum.Enum):
    """How packets are put into a byte stream."""

    USB = "usb"
    UART = "uart"


def crc16(packet: bytes | bytearray) -> int:
    """CRC-16/XMODEM: polynomial 0x1021, start 0, not reflected (P440 MRM API).

    >>> hex(crc16(bytes.fromhex("00020001"))), hex(crc16(bytes.fromhex("10020001")))
    ('0x7e41', '0x65e6')
    """
    return binascii.crc_hqx(packet, 0)


def frame(packet: bytes, framing: Framing) -> bytes:
    """One packet as sent on the wire. Raises ValueError if the packet is too long for a frame."""
    if not 0 < len(packet) <= 0xFFFF:
        raise ValueError(f"a frame holds 1 to 65535 bytes, not {len(packet)}")
    head = SYNC + len(packet).to_bytes(2, "big") + packet
    return head if framing is Framing.USB else head + crc16(packet).to_bytes(2, "big")


class StreamDecoder:
    """Decoder from bytes to packets; bytes outside frames are skipped and counted.

    The result does not depend on how the bytes are divided into chunks. On UART the CRC decides. On USB,
    which has no CRC, a frame is valid if it starts where the previous one ended, or if it has the length of
    its message type. A frame that contains the header of another one is a truncated frame followed by its
    successor, unless another frame starts exactly after it (then the header was a pattern in the samples).

    Attributes:
        skipped: bytes outside any frame.
    """

    def __init__(self, framing: Framing) -> None:
        self._framing = framing
        self._tail = _CRC if framing is Framing.UART else 0
        self._buffer = bytearray()
        self._locked = True
        self.skipped = 0

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes from the wire; return the packets that are certain now."""
        self._buffer += data
        return self._take(quiet=False)

    def flush(self) -> list[bytes]:
        """The packets that are valid if the line has been quiet for a moment.

        An incomplete frame is discarded in favour of complete frames inside it. If there are none, it is
        kept, so a pause within a frame loses nothing.
        """
        return self._take(quiet=True)

    def reset(self) -> None:
        """Discard the buffer, e.g. after the line was reopened."""
        self.skipped += len(self._buffer)
        self._buffer.clear()
        self._locked = True

    def _take(self, quiet: bool) -> list[bytes]:
        out: list[bytes] = []
        data, at = self._buffer, 0
        while at < len(data):
            sync_at = data.find(SYNC, at)
            if sync_at < 0:
                sync_at = len(data) - (data[-1] == SYNC[0])
            if sync_at > at:
                self._skip(sync_at - at)
                at = sync_at
            if at >= len(data):
                break
            size = self._size_at(at)
            if size is None:
                break
            verdict = size > 0 and self._verdict(at, size, quiet)
            if verdict is None:
                break
            if not verdict:
                self._skip(1)
                at += 1
                continue
            out.append(bytes(data[at + _PREFIX : at + _PREFIX + size]))
            at += _PREFIX + size + self._tail
            self._locked = True
        del data[:at]
        return out

    def _skip(self, count: int) -> None:
        self.skipped += count
        self._locked = False

    def _size_at(self, at: int) -> int | None:
        """Packet size of the frame that may start at `at`; 0 if none does, None if not known yet."""
        data = self._buffer
        have = len(data) - at
        if have < _PREFIX:
            return None
        size = data[at + 2] << 8 | data[at + 3]
        if not _SMALLEST <= size <= MAX_PACKET_BYTES:
            return 0
        if self._locked or self._framing is Framing.UART:
            return size
        if have < _STRONG:
            return None
        return size if self._is_strong(at) else 0

    def _head_at(self, at: int) -> bool | None:
        """Whether a known message's frame starts at `at`; None: it may begin there."""
        if len(self._buffer) - at >= _STRONG:
            return self._buffer.startswith(SYNC, at) and self._is_strong(at)
        return None if SYNC.startswith(self._buffer[at : at + 2]) else False

    def _is_strong(self, at: int) -> bool:
        data = self._buffer
        size = data[at + 2] << 8 | data[at + 3]
        return size in _SIZES.get(data[at + 4] << 8 | data[at + 5], ())

    def _verdict(self, at: int, size: int, quiet: bool) -> bool | None:
        """Whether the frame at `at` is valid; None if more bytes are needed to decide."""
        data = self._buffer
        end = at + _PREFIX + size + self._tail
        if len(data) < end:
            return False if quiet and self._holds_whole_frame(at, len(data)) else None
        if self._framing is Framing.UART:
            packet = data[at + _PREFIX : at + _PREFIX + size]
            return crc16(packet) == (data[end - 2] << 8 | data[end - 1])
        inner = self._inner_head(at + 1, end)
        if inner is False:
            return True
        # A complete or partial header inside: the following bytes decide.
        behind = self._head_at(end)
        if inner is None:
            return True if quiet or behind else None
        return True if quiet and behind is None else behind

    def _inner_head(self, start: int, end: int) -> bool | None:
        """Whether a known message's frame starts in `start`..`end`; None if its header may still arrive."""
        data = self._buffer
        at = data.find(SYNC, start, end + 1)
        while 0 <= at < end:
            if len(data) - at < _STRONG:
                return None
            if self._is_strong(at):
                return True
            at = data.find(SYNC, at + 1, end + 1)
        return None if len(data) == end and data[-1] == SYNC[0] else False

    def _holds_whole_frame(self, start: int, end: int) -> bool:
        """Whether a complete frame follows `start`, i.e. the one that starts there was truncated."""
        data = self._buffer
        at = data.find(SYNC, start + 1, end)
        while at >= 0 and end - at >= _PREFIX + _SMALLEST:
            size = data[at + 2] << 8 | data[at + 3]
            stop = at + _PREFIX + size + self._tail
            if size >= _SMALLEST and stop <= end and self._is_strong(at):
                packet = data[at + _PREFIX : at + _PREFIX + size]
                if self._framing is Framing.USB or crc16(packet) == (data[stop - 2] << 8 | data[stop - 1]):
                    return True
            at = data.find(SYNC, at + 1, end)
        return False
