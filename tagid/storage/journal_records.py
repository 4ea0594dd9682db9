"""The records of a journal, read one by one from a file of any size.

Long recordings exceed the memory, so this module holds at most one record and a buffer.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, Final

PREAMBLE: Final = struct.Struct("<8sI")
MAX_PAYLOAD: Final = 64 << 20
_RECORD: Final = struct.Struct("<4sIII")
_COVERED: Final = struct.Struct("<II")
_MARKER: Final = b"REC\x1e"
_BUFFER: Final = 1 << 20


def pack_record(kind: int, payload: bytes) -> bytes:
    """The bytes of one record: marker, kind, length, CRC-32 over kind, length and payload, payload."""
    return _RECORD.pack(_MARKER, kind, len(payload), _crc(kind, payload)) + payload


def record_bytes(payload: bytes) -> int:
    """Size of a record with this payload in the file, bytes."""
    return _RECORD.size + len(payload)


def intact_records(stream: BinaryIO, size: int) -> Iterator[tuple[int, bytes]]:
    """(kind, payload) of every record whose CRC holds, in file order.

    A truncated or damaged part is skipped up to the next marker. Memory is limited to one payload and a
    buffer of 1 MiB, time to a small multiple of the size, whatever lengths the records claim.

    Args:
        stream: the journal, seekable.
        size: its size, bytes.
    """
    window = _Window(stream, size)
    position = PREAMBLE.size
    # A crafted file could make every marker claim a long payload: the work on failures is limited as well.
    patience = size + MAX_PAYLOAD
    while patience > 0:
        head = window.take(position, _RECORD.size)
        if len(head) < _RECORD.size:
            return
        marker, kind, length, crc = _RECORD.unpack(head)
        end = position + _RECORD.size + length
        if marker == _MARKER and length <= MAX_PAYLOAD and end <= size:
            payload = window.take(position + _RECORD.size, length)
            if len(payload) == length and _crc(kind, payload) == crc:
                yield kind, payload
                position = end
                continue
            patience -= length
        position = window.find(_MARKER, position + 1)
        if position < 0:
            return


def _crc(kind: int, payload: bytes) -> int:
    return zlib.crc32(payload, zlib.crc32(_COVERED.pack(kind, len(payload))))


class _Window:
    """A buffered view of a file; sequential access reads each byte once."""

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self._stream = stream
        self._size = size
        self._start = 0
        self._data = b""

    def take(self, position: int, count: int) -> bytes:
        """`count` bytes from `position`, fewer at the end of the file."""
        if not self._start <= position <= position + count <= self._start + len(self._data):
            self._stream.seek(position)
            self._data = self._stream.read(max(min(max(count, _BUFFER), self._size - position), 0))
            self._start = position
        first = position - self._start
        return self._data[first : first + count]

    def find(self, mark: bytes, position: int) -> int:
        """Position of the next `mark`, -1 if there is none."""
        while position < self._size:
            data = self.take(position, min(_BUFFER, self._size - position))
            found = data.find(mark)
            if found >= 0:
                return position + found
            if len(data) < len(mark):
                return -1
            position += len(data) - len(mark) + 1
        return -1
