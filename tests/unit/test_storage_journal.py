"""The journal keeps every intact record whatever happens to the rest of the file, with bounded work."""

from __future__ import annotations

import io
import json
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from tagid import files
from tagid.errors import DataError, DiskFullError, FileFormatError, StorageError
from tagid.metadata import MotionInfo, ObjectInfo, RadarInfo
from tagid.radar.settings import RadarConfig
from tagid.recording.plan import RecordingPlan
from tagid.recording.session import journal_header
from tagid.storage import journal
from tagid.storage.journal import PREAMBLE, JournalWriter, intact_records, pack_record, record_bytes
from tagid.storage.journal_capture import read_journal_capture
from tests.unit.storage_samples import file_size_limit, read_journal

HEADER = {"range_start_m": 0.4, "range_step_m": 0.009149}


def scan(number: int, bins: int = 32) -> np.ndarray:
    return np.random.default_rng(number).integers(-(2**31), 2**31, bins, dtype=np.int64).astype(np.int32)


def write(path: Path, scans: int, close: bool = True, bins: int = 32) -> None:
    with JournalWriter(path, HEADER, sync_every=3) as journal:
        for i in range(scans):
            journal.append(100 + i, 10**18 + i, 21.5 * i, scan(i, bins), flags=i % 8)
        if close:
            journal.close({"radar": {"scans_lost": 2}})


def test_every_field_of_a_recordings_header_reaches_the_capture(tmp_path: Path) -> None:
    plan = RecordingPlan(
        None, 1.5, 0.1, 0.2, cable_delay_ps=30.0, motion="free?rpm=2", object=ObjectInfo(label="helmet")
    )
    header = journal_header(plan, RadarConfig(), RadarInfo(serial=7))
    with JournalWriter(tmp_path / "j", header) as journal:
        for number in range(3):
            journal.append(100 + number, 10**18 + number, 21.5 * number, scan(number), flags=number)
        journal.close({"radar": {"scans_lost": 2}})
    with pytest.raises(StorageError, match="already exists"):
        JournalWriter(tmp_path / "j", header)
    capture = read_journal_capture(tmp_path / "j")
    assert capture.complete and capture.samples.dtype == np.int32
    np.testing.assert_array_equal(capture.samples, np.stack([scan(number) for number in range(3)]))
    assert (capture.scan_id.tolist(), capture.flags.tolist()) == ([100, 101, 102], [0, 1, 2])
    assert (capture.host_time_ns - 10**18).tolist() == [0, 1, 2]
    assert capture.radar_time_ms.tolist() == [0, 21.5, 43]
    for name in set(header) - {"metadata_version", "radar", "motion", "object"}:
        assert getattr(capture, name) == header[name], name
    assert capture.range_start_m == RadarConfig().range_start_m(30.0)
    stored = RadarConfig().stored()
    assert capture.radar == RadarInfo(serial=7, config=stored, cable_delay_ps=30.0, scans_lost=2)
    assert (capture.motion, capture.object) == (MotionInfo(url="free?rpm=2"), plan.object)
    assert journal_header(plan, RadarConfig(), RadarInfo())["uuid"] != header["uuid"]


def test_the_bytes_are_those_of_the_documented_layout(tmp_path: Path) -> None:
    """Written down from the format's description, so that a journal of today can be read tomorrow."""

    def record(kind: int, payload: bytes) -> bytes:
        crc = zlib.crc32(struct.pack("<II", kind, len(payload)) + payload)
        return struct.pack("<4sIII", b"REC\x1e", kind, len(payload), crc) + payload

    samples = np.array([1, -2, 2**31 - 1], np.int32)
    motion = {"host_time_ns": [5], "angle_rad": [0.25], "sigma_rad": [0.5], "info": {}}
    before = os.umask(0)
    try:
        with JournalWriter(tmp_path / "j", {"range_step_m": 0.5}) as journal:
            journal.append(-3, 10**18, 21.5, samples, flags=9)
            journal.append_motion(motion)
            journal.close({"radar": {}})
    finally:
        os.umask(before)
    data = (tmp_path / "j").read_bytes()
    assert (tmp_path / "j").stat().st_mode & 0o777 == 0o666  # the rest is the umask's
    texts = [json.dumps(value).encode() for value in ({"range_step_m": 0.5}, motion, {"radar": {}})]
    scan = struct.pack("<qqdBBHI", -3, 10**18, 21.5, 9, 0, 0, 3) + samples.astype("<i4").tobytes()
    wanted = b"TAGIDJNL" + struct.pack("<I", 1) + record(1, texts[0]) + record(2, scan)
    assert data[: len(wanted)] == wanted
    rest = data[len(wanted) :]
    (kind, length), at = struct.unpack_from("<II", rest, 4), 16
    assert (kind, json.loads(rest[at : at + length])) == (4, motion)
    assert rest[: at + length] == record(4, rest[at : at + length])
    rest = rest[at + length :]
    assert (rest[4:8], json.loads(rest[16:])) == (struct.pack("<I", 3), {"radar": {}})
    assert rest == record(3, rest[16:])
    with JournalWriter(tmp_path / "f", {}) as journal:
        journal.append(0, 0, 0.0, samples.astype(np.float32))
    scan = struct.pack("<qqdBBHI", 0, 0, 0.0, 0, 1, 0, 3) + samples.astype("<f4").tobytes()
    assert (tmp_path / "f").read_bytes().endswith(scan)


@pytest.mark.parametrize(
    ("kind", "payload", "message"),
    [
        (2, b"short", "scan record"),
        (2, struct.pack("<qqdBBHI", 0, 0, 0.0, 0, 2, 0, 1) + b"1234", "scan record"),  # no such dtype
        (2, struct.pack("<qqdBBHI", 0, 0, 0.0, 0, 0, 0, 2) + b"1234", "scan record"),  # one sample short
        (4, b'{"host_time_ns": [], "angle_rad": []}', "motion record"),
        (4, b'{"host_time_ns": [], "angle_rad": [], "sigma_rad": 1}', "motion record"),
        (4, b"[1", "motion record"),
        (3, b"{", "end record"),
    ],
)
def test_a_record_that_is_intact_but_makes_no_sense_is_an_error(
    tmp_path: Path, kind: int, payload: bytes, message: str
) -> None:
    write(tmp_path / "j", 2, close=False)
    with (tmp_path / "j").open("ab") as stream:
        stream.write(pack_record(kind, payload))
    with pytest.raises(FileFormatError, match=message) as caught:
        read_journal(tmp_path / "j")
    assert str(tmp_path / "j") in caught.value.message


def test_a_journal_too_large_for_memory_is_not_read_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "j", 3)
    size = (tmp_path / "j").stat().st_size
    monkeypatch.setattr(files, "MAX_FILE_BYTES", size)
    assert read_journal_capture(tmp_path / "j").views == 3
    monkeypatch.setattr(files, "MAX_FILE_BYTES", size - 1)
    with pytest.raises(FileFormatError, match="exceeds the limit") as caught:
        read_journal_capture(tmp_path / "j")
    assert "tagid recover" in caught.value.remedy


def test_cut_at_any_byte_keeps_every_record_before_and_damage_all_others(tmp_path: Path) -> None:
    write(tmp_path / "j", 4, bins=5)
    data = (tmp_path / "j").read_bytes()
    record = 16 + 32 + 5 * 4
    header = data.rindex(b"REC\x1e") - 4 * record  # of the end record
    for cut in range(0, len(data)):
        (tmp_path / "cut").write_bytes(data[:cut])
        if cut < header:
            with pytest.raises(FileFormatError):
                read_journal(tmp_path / "cut")
            continue
        journal = read_journal(tmp_path / "cut")
        whole = min(4, (cut - header) // record)
        assert [s.scan_id for s in journal.scans] == list(range(100, 100 + whole))
        assert journal.summary is None
        assert journal.bytes_dropped == cut - header - whole * record
    at = header + 2 * record + 60
    (tmp_path / "j").write_bytes(data[:at] + bytes([data[at] ^ 0x40]) + data[at + 1 :])
    journal = read_journal(tmp_path / "j")
    assert [s.scan_id for s in journal.scans] == [100, 101, 103]
    assert journal.bytes_dropped == read_journal_capture(tmp_path / "j").radar.journal_bytes_dropped == record


def test_a_scan_is_one_row_of_a_known_type_of_the_length_of_the_first(tmp_path: Path) -> None:
    none, too_many = np.zeros(0, np.int32), np.zeros(((64 << 20) - 32) // 4 + 1, np.int32)
    with JournalWriter(tmp_path / "j", HEADER) as journal:
        # What is refused has not set the shape.
        for bad in (none, too_many, scan(0, 31).astype(np.int64), scan(0, 30).reshape(2, 15)):
            with pytest.raises(DataError, match=r"expected|shape"):
                journal.append(0, 0, 0.0, bad)
        journal.append(0, 0, 0.0, scan(0))
        for bad in (scan(0, 31), scan(0).astype(np.float32), scan(0).astype(np.int64)):
            with pytest.raises(DataError):
                journal.append(1, 0, 0.0, bad)
        journal.close()
        journal.close()
        with pytest.raises(StorageError, match="closed"):
            journal.append(1, 0, 0.0, scan(0))
    assert len(read_journal(tmp_path / "j").scans) == 1


def test_not_a_journal(tmp_path: Path) -> None:
    write(tmp_path / "j", 2)
    data = (tmp_path / "j").read_bytes()
    scans = data[data.index(data[12:16], 16) :]  # from the marker of the first one on
    # Without a header before the scans, range and settings are unknown, also after another intact record.
    headless = "header of the journal is truncated or damaged"
    for content, says in (
        (b"", ""),
        (b"x" * 500, ""),
        (data[:8], ""),
        (data[:12], headless),
        (data[:12] + scans, headless),
        (data[:12] + pack_record(3, b"{}") + scans, headless),
        (data[:8] + b"\x09" + data[9:], "newer"),
    ):
        (tmp_path / "j").write_bytes(content)
        with pytest.raises(FileFormatError) as caught:
            read_journal(tmp_path / "j")
        assert says in f"{caught.value.message} {caught.value.remedy}"
    write(tmp_path / "k", 0)
    with pytest.raises(FileFormatError, match="no scan"):
        read_journal_capture(tmp_path / "k")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no /dev/full")
def test_full_disk_at_the_start() -> None:
    with pytest.raises(DiskFullError):
        JournalWriter(Path("/dev/full"), HEADER)
    assert Path("/dev/full").exists()


def test_full_disk_in_the_middle_keeps_what_was_written(tmp_path: Path) -> None:
    full = pytest.raises(DiskFullError, match="the disk is full")
    with JournalWriter(tmp_path / "j", HEADER) as journal, file_size_limit(10_000), full:
        for acknowledged in range(100):
            journal.append(acknowledged, 0, 0.0, np.full(300, acknowledged, np.int32))
    assert 0 < acknowledged < 100
    kept = read_journal(tmp_path / "j")
    assert [s.scan_id for s in kept.scans] == list(range(acknowledged))
    assert kept.bytes_dropped == 0 and kept.summary is None
    np.testing.assert_array_equal(kept.scans[-1].samples, np.full(300, acknowledged - 1))
    assert not read_journal_capture(tmp_path / "j").complete


def test_a_note_that_is_not_utf_8_costs_no_recording(tmp_path: Path) -> None:
    note = "Kopfh\udcf6rer"  # as Python reads the byte F6 of a Latin-1 terminal
    header = HEADER | {"object": {"note": note}}
    with JournalWriter(tmp_path / "j", header) as journal:
        journal.append(100, 10**18, 0.0, scan(0))
        journal.close({"motion": {"url": "roomba+serial:///dev/\udce4"}})
    capture = read_journal_capture(tmp_path / "j")
    assert capture.object.note == "Kopfh\\xf6rer" and capture.motion.url == "roomba+serial:///dev/\\xe4"
    # A header that an older version wrote, with half a surrogate pair.
    write(tmp_path / "k", 3)
    data = (tmp_path / "k").read_bytes()
    first = pack_record(1, json.dumps(HEADER, sort_keys=True).encode())
    assert data.count(first) == 1
    header = HEADER | {"object": {"note": note, "label": "\ud800"}}
    (tmp_path / "k").write_bytes(data.replace(first, pack_record(1, json.dumps(header).encode())))
    capture = read_journal_capture(tmp_path / "k")
    assert capture.views == 3
    assert (capture.object.note, capture.object.label) == ("Kopfh\\xf6rer", "\\ud800")


PREFIX = bytes(PREAMBLE.size)


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


def test_no_damaged_byte_goes_unseen() -> None:
    packed, after = pack_record(7, b"payload"), pack_record(8, b"")
    assert record_bytes(b"payload") == len(packed)
    assert found(PREFIX + packed + after) == [(7, b"payload"), (8, b"")]
    assert found(PREFIX) == found(b"") == found(PREFIX + packed[:-1]) == []
    for place in range(len(packed)):
        damaged = packed[:place] + bytes([packed[place] ^ 1]) + packed[place + 1 :]
        assert found(PREFIX + damaged + after) == [(8, b"")], place


@pytest.mark.parametrize("buffer", [4, 5, 16, 17, 23, 64, 1 << 20])
def test_records_are_found_over_the_edges_of_the_window(monkeypatch: pytest.MonkeyPatch, buffer: int) -> None:
    monkeypatch.setattr(journal, "_BUFFER", buffer)
    records = [(n, bytes([n]) * (5 * n)) for n in range(6)]
    for between in range(9):
        noise = (b"REC\x1dREC" * 9)[:between]
        data = PREFIX + b"".join(pack_record(*record) + noise for record in records)
        assert found(data) == records
        assert found(PREFIX + noise * 20 + data[len(PREFIX) :]) == records


def test_each_byte_of_a_sound_journal_is_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal, "_BUFFER", 1000)
    data = PREFIX + b"".join(pack_record(2, bytes(84)) for _ in range(500))
    stream = Counted(data)
    assert len(list(intact_records(stream, len(data)))) == 500
    assert stream.total <= 1.2 * len(data)  # a record that is cut by the window's edge is read again
    assert stream.largest <= 1000


def test_a_claim_longer_than_any_payload_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal, "MAX_PAYLOAD", 40)
    data = PREFIX + pack_record(1, bytes(40)) + pack_record(1, bytes(41)) + pack_record(1, b"x")
    assert [len(payload) for _, payload in found(data)] == [40, 1]


def test_claims_that_all_fail_cost_a_small_multiple_of_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of 2000 markers claims 4000 bytes: without a bound 8 MB are read of a file of 32 kB."""
    monkeypatch.setattr(journal, "MAX_PAYLOAD", 4096)
    monkeypatch.setattr(journal, "_BUFFER", 256)
    data = PREFIX + struct.pack("<4sIII", b"REC\x1e", 2, 4000, 1) * 2000 + bytes(4000)
    stream = Counted(data)
    assert list(intact_records(stream, len(data))) == []
    assert stream.total < 4 * (len(data) + 4096)
    # What comes before the bound is used up is still found.
    good = pack_record(5, b"good")
    few = PREFIX + struct.pack("<4sIII", b"REC\x1e", 2, 4000, 1) * 2 + good + bytes(4000)
    assert found(few) == [(5, b"good")]
