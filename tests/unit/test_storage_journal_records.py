"""Records are found whatever lies between them, in windows of any size, with bounded work."""

from __future__ import annotations

import io
import struct
import zlib

import pytest

from tagid.storage import journal
from tagid.storage.journal import PREAMBLE, intact_records, pack_record, record_bytes

HEAD = bytes(PREAMBLE.size)


class Counted(io.BytesIO):
    """Counts the bytes that are read, and how many at most at once."""

    total = largest = 0

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        self.total += len(data)
        self.largest = max(self.largest, len(data))
        return data


def found(data: bytes) -> list[tuple[int, bytes]]:
    return list(intact_records(io.BytesIO(data), len(data)))


def test_a_record_is_marker_kind_length_and_checksum() -> None:
    packed = pack_record(7, b"payload")
    crc = zlib.crc32(struct.pack("<II", 7, 7) + b"payload")
    assert packed == b"REC\x1e" + struct.pack("<III", 7, 7, crc) + b"payload"
    assert record_bytes(b"payload") == len(packed) == 23
    assert found(HEAD + packed) == [(7, b"payload")]
    assert found(HEAD + pack_record(1, b"")) == [(1, b"")]
    assert found(HEAD) == found(b"") == found(HEAD + packed[:-1]) == []


@pytest.mark.parametrize("place", range(23))
def test_no_damaged_byte_goes_unseen(place: int) -> None:
    packed = bytearray(pack_record(7, b"payload"))
    packed[place] ^= 1
    after = pack_record(8, b"after")
    assert found(HEAD + bytes(packed) + after) == [(8, b"after")]


@pytest.mark.parametrize("buffer", [4, 5, 16, 17, 23, 64, 1 << 20])
@pytest.mark.parametrize("between", range(9))
def test_records_are_found_over_the_edges_of_the_window(
    monkeypatch: pytest.MonkeyPatch, buffer: int, between: int
) -> None:
    monkeypatch.setattr(journal, "_BUFFER", buffer)
    noise = (b"REC\x1dREC" * 9)[:between]
    records = [(n, bytes([n]) * (5 * n)) for n in range(6)]
    data = HEAD + b"".join(pack_record(*record) + noise for record in records)
    assert found(data) == records
    assert found(HEAD + noise * 20 + data[len(HEAD) :]) == records


def test_each_byte_of_a_sound_journal_is_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal, "_BUFFER", 1000)
    data = HEAD + b"".join(pack_record(2, bytes(84)) for _ in range(500))
    stream = Counted(data)
    assert len(list(intact_records(stream, len(data)))) == 500
    assert stream.total <= 1.2 * len(data)  # a record that is cut by the window's edge is read again
    assert stream.largest <= 1000


def test_a_claim_longer_than_any_payload_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal, "MAX_PAYLOAD", 40)
    data = HEAD + pack_record(1, bytes(40)) + pack_record(1, bytes(41)) + pack_record(1, b"x")
    assert [len(payload) for _, payload in found(data)] == [40, 1]


def test_claims_that_all_fail_cost_a_small_multiple_of_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of 2000 markers claims 4000 bytes: without a bound 8 MB are read of a file of 32 kB."""
    monkeypatch.setattr(journal, "MAX_PAYLOAD", 4096)
    monkeypatch.setattr(journal, "_BUFFER", 256)
    data = HEAD + struct.pack("<4sIII", b"REC\x1e", 2, 4000, 1) * 2000 + bytes(4000)
    stream = Counted(data)
    assert list(intact_records(stream, len(data))) == []
    assert stream.total < 4 * (len(data) + 4096)
    # What comes before the bound is used up is still found.
    good = pack_record(5, b"good")
    few = HEAD + struct.pack("<4sIII", b"REC\x1e", 2, 4000, 1) * 2 + good + bytes(4000)
    assert found(few) == [(5, b"good")]
