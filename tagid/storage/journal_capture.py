"""From a journal to captures: one in memory, or files written while the journal is read.

A recording of hours exceeds the memory of any command, so it is split into several files.
"""

from __future__ import annotations

import uuid as uuid_module
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tagid import files
from tagid.capture import Capture
from tagid.errors import DataError, FileFormatError
from tagid.metadata import RadarInfo, RecordingPart, Track
from tagid.storage import hdf5
from tagid.storage.assembly import build_capture, number, text
from tagid.storage.journal import Journal, JournalScan, open_journal, read_journal
from tagid.storage.metadata import PARTS, read_metadata, stored_version

PART_BYTES = 1 << 30
"""Samples in one file of a long recording, bytes: half the limit for reading."""

_BLOCK_BYTES = 1 << 19
_NUMBERS = ("range_start_m", "range_step_m", "axis_distance_m", "antenna_height_m", "antenna_separation_m")
_BAND = ("center_frequency_hz", "bandwidth_hz")
_TEXTS = ("uuid", "created_utc", "tool_version")


def journal_to_capture(journal: Journal) -> Capture:
    """The capture that a journal holds; `complete` is False if its end record is missing.

    The objects `radar`, `motion` and `object` of the end record extend those of the header. Dropped bytes are
    noted as `radar.journal_bytes_dropped`, motion readings as `motion.track`
    (`tagid.pipeline.resolve.with_measured_angles` converts them to angles).

    Raises:
        FileFormatError: no scan is intact, scans differ in shape or dtype, or the header lacks a value.
    """
    scans = journal.scans
    layout = common_layout(journal.path, scans)
    arrays = ScanArrays.empty(len(scans), *layout)
    for row, scan in enumerate(scans):
        arrays.put(row, scan)
    return _to_capture(journal, arrays)


def read_journal_capture(path: Path) -> Capture:
    """The capture that a journal file holds, read twice to use no more memory than the capture.

    Raises as `read_journal` and `journal_to_capture` do.
    """
    with open_journal(path) as stream:
        if stream.size > files.MAX_FILE_BYTES:
            return journal_to_capture(read_journal(path))  # raises the detailed error
        count = 0

        def counted() -> Iterator[JournalScan]:
            nonlocal count
            for scan in stream.scans():
                count += 1
                yield scan

        layout = common_layout(path, counted())
        journal = Journal(path, stream.header, (), stream.summary, stream.bytes_dropped, stream.motion)
    with open_journal(path) as stream:
        arrays = ScanArrays.empty(count, *layout)
        arrays.fill(path, stream.scans())
    return _to_capture(journal, arrays)


def common_layout(path: Path, scans: Iterable[JournalScan]) -> tuple[int, np.dtype[Any]]:
    """(bins, dtype) of the scans. Raises FileFormatError if there is none or they differ."""
    layout: tuple[int, np.dtype[Any]] | None = None
    for scan in scans:
        scan_layout = len(scan.samples), scan.samples.dtype.newbyteorder("=")
        if layout not in (None, scan_layout):
            raise FileFormatError(f"{path}: the scans of the journal differ in length or dtype")
        layout = scan_layout
    if layout is None:
        raise FileFormatError(
            f"{path}: the journal holds no scan", "The recording stopped before the first scan."
        )
    return layout


@dataclass(frozen=True, eq=False)
class ScanArrays:
    """Scans as arrays of a capture: (views, bins) samples and (views,) of the rest."""

    samples: NDArray[Any]
    host_time_ns: NDArray[np.int64]
    radar_time_ms: NDArray[np.float64]
    scan_id: NDArray[np.int64]
    flags: NDArray[np.uint8]

    @classmethod
    def empty(cls, views: int, bins: int, dtype: np.dtype[Any]) -> Self:
        """Zero-filled arrays for `views` scans."""
        integers = np.zeros((2, views), np.int64)
        times, flags = np.zeros(views, np.float64), np.zeros(views, np.uint8)
        return cls(np.zeros((views, bins), dtype), integers[0], times, integers[1], flags)

    def fill(self, path: Path, scans: Iterator[JournalScan]) -> None:
        """Fill all rows. Raises FileFormatError if the journal at `path` has too few scans left."""
        for row in range(len(self.samples)):
            scan = next(scans, None)
            if scan is None:
                raise FileFormatError(f"{path}: the journal changed while it was read", "Read it again.")
            self.put(row, scan)

    def put(self, row: int, scan: JournalScan) -> None:
        """Fill one row."""
        self.samples[row] = scan.samples
        self.host_time_ns[row] = scan.host_time_ns
        self.radar_time_ms[row] = scan.radar_time_ms
        self.scan_id[row] = scan.scan_id
        self.flags[row] = scan.flags


def capture_fields(
    path: Path, header: dict[str, Any], summary: dict[str, Any] | None, dropped: int
) -> dict[str, Any]:
    """The fields of a Capture from a journal's header and end record. Raises FileFormatError."""
    fields: dict[str, Any] = {"complete": summary is not None}
    for name in (*_NUMBERS, *_BAND):
        if header.get(name) is not None:
            fields[name] = number(header[name], f"{path} (header, {name})")
        elif name in ("range_start_m", "range_step_m"):
            raise FileFormatError(f"{path}: the header of the journal lacks {name}")
    fields |= {name: text(header[name], f"{path} (header, {name})") for name in _TEXTS if name in header}
    objects: dict[str, Any] = {}
    for name in PARTS:
        parts = (header.get(name) or {}, (summary or {}).get(name) or {})
        if not all(isinstance(part, dict) for part in parts):
            raise FileFormatError(f"{path}: {name} in the journal is not a JSON object")
        objects[name] = {**parts[0], **parts[1]}
    fields |= read_metadata(objects, f"{path} (journal)", stored_version(header, str(path)))
    if dropped:
        fields["radar"] = replace(fields["radar"], journal_bytes_dropped=dropped)
    return fields


def _to_capture(journal: Journal, arrays: ScanArrays) -> Capture:
    fields = capture_fields(journal.path, journal.header, journal.summary, journal.bytes_dropped)
    if journal.motion is not None:
        try:
            track = Track.from_json(journal.motion)
        except DataError as error:
            raise FileFormatError(f"{journal.path}: {error.message}", error.remedy) from error
        fields["motion"] = replace(fields["motion"], track=track)
    return build_capture(journal.path, **vars(arrays), **fields)


@dataclass(frozen=True)
class WrittenCaptures:
    """The result of `write_captures`.

    Attributes:
        paths: the files, in recording order.
        views, bins: scans of all files, and samples per scan.
        complete: whether the journal has its end record.
        bytes_dropped: bytes of the journal that belong to no intact record.
        radar: the settings and counters stored in the files.
        has_track: whether the journal holds readings of the motion, which the files do not contain.
    """

    paths: tuple[Path, ...]
    views: int
    bins: int
    complete: bool
    bytes_dropped: int
    radar: RadarInfo
    has_track: bool


def write_captures(
    journal: Path,
    part_path: Callable[[int], Path],
    counters: RadarInfo | None = None,
    part_bytes: int = PART_BYTES,
) -> WrittenCaptures:
    """Write the capture files of a journal in constant memory, each atomically.

    Args:
        journal: the file.
        part_path: returns the path of part 1, 2, ... (one part if the recording is short enough).
        counters: counters of the recording; added to the journal's `radar`.
        part_bytes: samples in one file, bytes.

    Raises:
        StorageError, DiskFullError: a file cannot be read or written; earlier parts are kept.
        FileFormatError: as for `journal_to_capture`.
    """
    views = 0
    with open_journal(journal) as stream:

        def counted() -> Iterator[JournalScan]:
            nonlocal views
            for scan in stream.scans():
                views += 1
                yield scan

        bins, dtype = common_layout(journal, counted())
        fields = capture_fields(journal, stream.header, stream.summary, stream.bytes_dropped)
        complete, dropped = stream.summary is not None, stream.bytes_dropped
        has_track = stream.motion is not None
    if counters is not None:
        fields["radar"] = fields["radar"].with_known(counters)
    row_bytes = bins * dtype.itemsize
    rows_a_part = max(1, part_bytes // row_bytes)
    rows_a_block = max(1, min(_BLOCK_BYTES // row_bytes, rows_a_part))
    parts = -(-views // rows_a_part)
    first_uuid = fields.get("uuid", str(uuid_module.uuid4()))
    paths = []
    with open_journal(journal) as stream:
        scans = stream.scans()
        for part in range(1, parts + 1):
            fields["uuid"] = first_uuid if part == 1 else str(uuid_module.uuid4())
            if parts > 1:
                place = RecordingPart(first_uuid, part, parts)
                fields["radar"] = replace(fields["radar"], recording=place)
            remaining = min(rows_a_part, views - rows_a_part * (part - 1))
            path = part_path(part)
            with hdf5.growing_capture(path) as append:
                while remaining:
                    arrays = ScanArrays.empty(min(rows_a_block, remaining), bins, dtype)
                    arrays.fill(journal, scans)
                    append(build_capture(journal, **vars(arrays), **fields))
                    remaining -= len(arrays.samples)
            paths.append(path)
    return WrittenCaptures(tuple(paths), views, bins, complete, dropped, fields["radar"], has_track)
