"""Append-only record of a recording, written before any other processing.

After a kill, everything but the record being written can be read back; after a power cut, everything that was
synced.

Layout, little-endian: magic `TAGIDJNL`, version u32; then records of marker `REC\\x1e`, kind u32, payload
length u32, CRC-32 u32 (over kind, length and payload), payload. Kinds: 1 header (JSON), 2 scan, 3 end (JSON),
4 readings of the motion (JSON: lists host_time_ns, angle_rad, sigma_rad, and info, their metadata).
The payload of a scan is scan_id i64, host_time_ns i64, radar_time_ms f64, flags u8, dtype u8 (0 int32,
1 float32), two zero bytes, bins u32, samples.
"""

from __future__ import annotations

import fcntl
import os
import struct
import time
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Final, Self

import numpy as np
from numpy.typing import NDArray

from tagid import files, interrupts
from tagid.errors import DataError, DiskFullError, FileFormatError, StorageError
from tagid.storage.assembly import decode_settings, encode_settings

_TRIES = 20
_PAUSE_S = 0.005


def lock(descriptor: int) -> None:
    """Lock a new journal; the lock lasts until the descriptor and its duplicates are closed."""
    for _ in range(_TRIES):
        if files.lock(descriptor) is not False:
            return
        time.sleep(_PAUSE_S)  # somebody asks `being_recorded` just now


def being_recorded(path: Path) -> bool:
    """Whether a process is recording into this journal, or is writing its capture file."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return False


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
    return _RECORD.size + len(payload)


def intact_records(stream: BinaryIO, size: int) -> Iterator[tuple[int, bytes]]:
    """(kind, payload) of every record of a seekable journal whose CRC holds, in file order.

    A truncated or damaged part is skipped up to the next marker. Memory is limited to one payload and a
    buffer of 1 MiB, time to a small multiple of the size, whatever lengths the records claim.
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
            offset = data.find(mark)
            if offset >= 0:
                return position + offset
            if len(data) < len(mark):
                return -1
            position += len(data) - len(mark) + 1
        return -1


MAGIC = b"TAGIDJNL"
VERSION = 1
SUFFIX = ".tagid.journal"
"""Usual suffix of a journal."""

_SCAN = struct.Struct("<qqdBBHI")
_HEADER, _SCAN_KIND, _END, _MOTION = 1, 2, 3, 4
_READINGS = ("host_time_ns", "angle_rad", "sigma_rad")
_DTYPES = (np.dtype("<i4"), np.dtype("<f4"))
_CODES = {("i", 4): 0, ("f", 4): 1}


@dataclass(frozen=True, eq=False)
class JournalScan:
    """One scan.

    Attributes:
        scan_id: unwrapped scan number.
        host_time_ns: arrival, ns since the epoch.
        radar_time_ms: radar clock, ms.
        flags: of `tagid.capture.ViewFlag`.
        samples: (bins,) int32 or float32, the same shape and dtype in every scan.
    """

    scan_id: int
    host_time_ns: int
    radar_time_ms: float
    flags: int
    samples: NDArray[Any]


class JournalWriter:
    """Appends scans to a new file, unbuffered.

    Args:
        path: the file to create; it must not exist.
        header: the fields of a Capture besides the scans: `range_start_m`, `range_step_m` and, if known,
            `axis_distance_m`, `antenna_height_m`, `antenna_separation_m`, `center_frequency_hz`,
            `bandwidth_hz`, `wave_speed_m_s`, `uuid`, `created_utc`, `tool_version` and the dicts `radar`,
            `motion`, `object`.
        sync_every: number of records (scans or motion readings) after which the disk is synced; a power cut
            loses those that are not (a killed process loses nothing). 0 leaves it to the operating system.
        sync_seconds: minimum time between syncs, s. Whoever appends calls `sync` when `seconds_to_sync` says
            so and no record follows.

    Raises:
        DiskFullError, StorageError: the file cannot be created or written.
    """

    def __init__(
        self, path: Path, header: dict[str, Any], sync_every: int = 50, sync_seconds: float = 0.0
    ) -> None:
        self.path = Path(path)
        self.scans = 0
        self._sync_every = sync_every
        self._sync_seconds = sync_seconds
        self._synced_at = 0.0
        self._unsynced = 0
        self._layout: tuple[int, int] | None = None
        self._size = 0
        with interrupts.deferred():
            self._create(header)

    def _create(self, header: dict[str, Any]) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
        try:
            # An existing device node (a pipe, /dev/full) may be appended to, but never an existing file.
            exclusive = 0 if self.path.exists() and not self.path.is_file() else os.O_EXCL
            self._descriptor = os.open(self.path, flags | exclusive, 0o666)
        except OSError as error:
            raise files.storage_error(error, self.path, "creating the journal") from error
        lock(self._descriptor)
        try:
            first = pack_record(_HEADER, encode_settings(header).encode())
            self._write(PREAMBLE.pack(MAGIC, VERSION) + first)
            self._sync()
            files.sync_folder(self.path.parent)
        except BaseException:
            self._release()
            if self.path.is_file():
                self.path.unlink(missing_ok=True)
            raise

    @property
    def size(self) -> int:
        return self._size

    def append(
        self,
        scan_id: int,
        host_time_ns: int,
        radar_time_ms: float,
        samples: NDArray[np.int32] | NDArray[np.float32],
        flags: int = 0,
    ) -> None:
        """Add one scan, with the fields of a `JournalScan`; see `append_all`."""
        self.append_all((JournalScan(scan_id, host_time_ns, radar_time_ms, flags, samples),))

    def append_all(self, scans: Sequence[JournalScan]) -> None:
        """Add scans with one write; on return, they have been passed to the operating system.

        Raises:
            DiskFullError: no space; the scans that fit are kept, and all earlier ones.
            DataError: samples of another shape or dtype.
        """
        records = [self._packed(scan) for scan in scans]
        with interrupts.deferred():
            self._append(records)

    def _append(self, records: list[bytes]) -> None:
        try:
            self._write(b"".join(records))
        except DiskFullError:
            if len(records) > 1:
                for record in records:
                    self._write(record)
                    self.scans += 1
            raise
        self.scans += len(records)
        self._written(len(records))

    def _written(self, records: int) -> None:
        """Count records, and sync when that is due."""
        self._unsynced += records
        if self._sync_every and self._unsynced >= self._sync_every:
            now = time.monotonic()
            if now - self._synced_at >= self._sync_seconds:
                self._sync()
                self._synced_at = now

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep the journal marked as being recorded after it is closed, to the end of the block."""
        descriptor = os.dup(self._descriptor)
        try:
            yield
        finally:
            os.close(descriptor)

    def seconds_to_sync(self) -> float | None:
        """Seconds until the records written so far are to be synced; None if they are, or need not be."""
        if not self._sync_every or not self._unsynced or self._descriptor < 0:
            return None
        return max(0.0, self._synced_at + self._sync_seconds - time.monotonic())

    def sync(self) -> None:
        """Make all records durable now. Raises StorageError, DiskFullError."""
        with interrupts.deferred():
            self._sync()
            self._synced_at = time.monotonic()

    def _packed(self, scan: JournalScan) -> bytes:
        samples, scan_id = scan.samples, scan.scan_id
        code = _CODES.get((samples.dtype.kind, samples.dtype.itemsize))
        if code is None or samples.ndim != 1 or not 0 < samples.nbytes <= MAX_PAYLOAD - _SCAN.size:
            raise DataError(
                f"scan {scan_id} has shape {samples.shape} and dtype {samples.dtype}, expected (bins,)"
            )
        if self._layout not in (None, (code, len(samples))):
            raise DataError(
                f"scan {scan_id} has {len(samples)} samples ({samples.dtype}), unlike the earlier ones"
            )
        self._layout = (code, len(samples))
        head = _SCAN.pack(scan_id, scan.host_time_ns, scan.radar_time_ms, scan.flags, code, 0, len(samples))
        return pack_record(_SCAN_KIND, head + samples.astype(_DTYPES[code], copy=False).tobytes())

    def append_motion(self, readings: dict[str, Any]) -> None:
        """Add readings of the motion: lists of equal length host_time_ns, angle_rad, sigma_rad; and info."""
        with interrupts.deferred():
            self._write(pack_record(_MOTION, encode_settings(readings).encode()))
            self._written(1)

    def close(self, summary: dict[str, Any] | None = None) -> None:
        """Write the end record, which marks the recording as complete, and close. Raises DiskFullError."""
        if self._descriptor < 0:
            return
        with interrupts.deferred():
            try:
                self._write(pack_record(_END, encode_settings(summary or {}).encode()))
                self._sync()
            finally:
                self._release()

    def abandon(self) -> None:
        """Give up a file whose disk does not answer: closing it would wait for that disk."""
        self._descriptor = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the file; unless `close` was called, the recording stays marked as incomplete."""
        with interrupts.deferred():
            if self._descriptor >= 0:
                try:
                    self._sync()
                except StorageError:
                    if error is None:
                        raise
                finally:
                    self._release()

    def _write(self, data: bytes) -> None:
        if self._descriptor < 0:
            raise StorageError(f"{self.path}: the journal is closed")
        try:
            files.write_all(self._descriptor, data)
        except BaseException as error:
            # The reader would skip a partial record, but it is removed all the same.
            self._cut_back()
            if isinstance(error, OSError):
                raise files.storage_error(error, self.path, "appending to the journal") from error
            raise
        self._size += len(data)

    def _cut_back(self) -> None:
        try:
            os.ftruncate(self._descriptor, self._size)
        except OSError:  # not a regular file; the reader also drops a partial record
            return

    def _sync(self) -> None:
        try:
            os.fsync(self._descriptor)
        except OSError as error:
            if self.path.is_file():
                raise files.storage_error(error, self.path, "syncing the journal") from error
        self._unsynced = 0

    def _release(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


@dataclass
class JournalStream:
    """A journal read scan by scan, in constant memory; see `open_journal`.

    Attributes:
        header: as given to the writer.
        summary: content of the end record; None before the end or if it is missing.
        bytes_dropped: bytes that belong to no intact record; known at the end.
        motion: motion readings up to now; None if there are none.
    """

    path: Path
    size: int
    records: Iterator[tuple[int, bytes]]
    header: dict[str, Any] = field(default_factory=dict)
    summary: dict[str, Any] | None = None
    bytes_dropped: int = 0
    motion: dict[str, Any] | None = None

    def scans(self) -> Iterator[JournalScan]:
        """Every intact scan, in file order; may be called once. Raises FileFormatError."""
        for kind, payload in self.records:
            self.bytes_dropped -= record_bytes(payload)
            if kind == _SCAN_KIND:
                yield _parse_scan(self.path, payload)
            elif kind == _END:
                self.summary = decode_settings(payload, f"{self.path} (end record)", repair=True)
            elif kind == _MOTION:
                self._add_motion(decode_settings(payload, f"{self.path} (motion record)", repair=True))

    def _add_motion(self, part: dict[str, Any]) -> None:
        if not all(isinstance(part.get(name), list) for name in _READINGS):
            raise FileFormatError(
                f"{self.path}: a motion record of the journal does not match its format version"
            )
        joined: dict[str, Any] = self.motion or {name: [] for name in _READINGS}
        for name in _READINGS:
            joined[name] += part[name]
        self.motion = {**joined, "info": part.get("info") or {}}


@contextmanager
def open_journal(path: Path) -> Iterator[JournalStream]:
    """Open a journal for reading in constant memory, whatever record lengths it claims.

    A truncated or damaged part is skipped and counted.

    Raises:
        StorageError: the file cannot be read.
        FileFormatError: not a journal, made by a newer version, or without an intact header.
    """
    with files.open_regular(path) as (stream, size):
        head = stream.read(PREAMBLE.size)
        if len(head) < PREAMBLE.size or head[: len(MAGIC)] != MAGIC:
            raise FileFormatError(
                f"{path}: is not a tagid journal (it does not start with {MAGIC.decode()})",
                "Give the .tagid.journal file of the recording.",
            )
        version = PREAMBLE.unpack(head)[1]
        if version != VERSION:
            raise FileFormatError(
                f"{path}: journal version {version}, this tagid reads version {VERSION}",
                "It was written by a newer tagid; upgrade." if version > VERSION else "The file is damaged.",
            )
        records = intact_records(stream, size)
        kind, payload = next(records, (0, b""))
        if kind != _HEADER:
            raise FileFormatError(
                f"{path}: the header of the journal is truncated or damaged", "Nothing can be recovered."
            )
        # A recording is never refused because of a note: journals of earlier versions may hold such texts.
        header = decode_settings(payload, f"{path} (header)", repair=True)
        dropped = size - PREAMBLE.size - record_bytes(payload)
        yield JournalStream(path, size, records, header, bytes_dropped=dropped)


def _parse_scan(path: Path, payload: bytes) -> JournalScan:
    if len(payload) >= _SCAN.size:
        scan_id, host_time_ns, radar_time_ms, flags, code, _, bins = _SCAN.unpack_from(payload)
        if code < len(_DTYPES) and len(payload) == _SCAN.size + bins * _DTYPES[code].itemsize:
            samples = np.frombuffer(payload, dtype=_DTYPES[code], offset=_SCAN.size)
            return JournalScan(scan_id, host_time_ns, radar_time_ms, flags, samples)
    raise FileFormatError(f"{path}: a scan record of the journal does not match its format version")
