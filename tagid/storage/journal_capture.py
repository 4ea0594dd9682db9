"""From a journal to captures: one in memory, or files written while the journal is read.

A recording of hours exceeds the memory of any command, so it is split into several files.
"""

from __future__ import annotations

import uuid as uuid_module
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid import files
from tagid.capture import Capture
from tagid.errors import DataError, FileFormatError
from tagid.metadata import RadarInfo, RecordingPart, Track
from tagid.storage import hdf5
from tagid.storage.assembly import OPTIONAL_NUMBERS, TEXTS, build_capture, number, text
from tagid.storage.journal import JournalScan, JournalStream, open_journal
from tagid.storage.metadata import PARTS, read_metadata, stored_version

PART_BYTES = 1 << 30
"""Samples in one file of a long recording, bytes: half the limit for reading."""

_BLOCK_BYTES = 1 << 19
_SCAN_FIELDS = {"host_time_ns": np.int64, "radar_time_ms": np.float64, "scan_id": np.int64, "flags": np.uint8}


@dataclass(frozen=True)
class _Survey:
    """What a first pass over a journal tells.

    Attributes:
        fields: of a Capture, besides its arrays.
        track: readings of the motion; None if there are none.
        views, bins: number of scans, and samples of each.
        dtype: of the samples.
        dropped: bytes that belong to no intact record.
    """

    fields: dict[str, Any]
    track: dict[str, Any] | None
    views: int
    bins: int
    dtype: np.dtype[Any]
    dropped: int


def _surveyed(path: Path, stream: JournalStream) -> _Survey:
    """Read all of a journal. Raises FileFormatError if it has no scan, or they differ in length or dtype."""
    views = 0
    layout: tuple[int, np.dtype[Any]] | None = None
    for scan in stream.scans():
        views += 1
        scan_layout = len(scan.samples), scan.samples.dtype.newbyteorder("=")
        if layout not in (None, scan_layout):
            raise FileFormatError(f"{path}: the scans of the journal differ in length or dtype")
        layout = scan_layout
    if layout is None:
        raise FileFormatError(
            f"{path}: the journal holds no scan", "The recording stopped before the first scan."
        )
    fields = _capture_fields(path, stream.header, stream.summary, stream.bytes_dropped)
    return _Survey(fields, stream.motion, views, *layout, stream.bytes_dropped)


def read_journal_capture(path: Path) -> Capture:
    """The capture that a journal holds, read twice to use no more memory than the capture.

    `complete` is False if the end record is missing. The objects `radar`, `motion` and `object` of the end
    record extend those of the header. Dropped bytes are noted as `radar.journal_bytes_dropped`, motion
    readings as `motion.track` (`tagid.pipeline.resolve.with_measured_angles` converts them to angles).

    Raises:
        StorageError: the file cannot be read.
        FileFormatError: as `open_journal`, or too large for memory; no scan is intact, scans differ in shape
            or dtype, or the header lacks a value.
    """
    with open_journal(path) as stream:
        if stream.size > files.MAX_FILE_BYTES:
            raise FileFormatError(
                f"{path}: exceeds the limit of {files.MAX_FILE_BYTES} bytes",
                f"`tagid recover {path}` converts it to capture files of readable size.",
            )
        survey = _surveyed(path, stream)
    fields = survey.fields
    if survey.track is not None:
        try:
            track = Track.from_json(survey.track)
        except DataError as error:
            raise FileFormatError(f"{path}: {error.message}", error.remedy) from error
        fields["motion"] = replace(fields["motion"], track=track)
    with open_journal(path) as stream:
        arrays = _next_arrays(path, stream.scans(), survey.views, survey)
    return build_capture(path, **arrays, **fields)


def _next_arrays(
    path: Path, scans: Iterator[JournalScan], views: int, survey: _Survey
) -> dict[str, NDArray[Any]]:
    """The next scans as arrays of a capture. Raises FileFormatError if the journal has too few left."""
    arrays = {name: np.zeros(views, dtype) for name, dtype in _SCAN_FIELDS.items()}
    arrays["samples"] = np.zeros((views, survey.bins), survey.dtype)
    for row in range(views):
        scan = next(scans, None)
        if scan is None:
            raise FileFormatError(f"{path}: the journal changed while it was read", "Read it again.")
        for name, values in arrays.items():
            values[row] = getattr(scan, name)
    return arrays


def _capture_fields(
    path: Path, header: dict[str, Any], summary: dict[str, Any] | None, dropped: int
) -> dict[str, Any]:
    """The fields of a Capture from a journal's header and end record. Raises FileFormatError."""
    fields: dict[str, Any] = {"complete": summary is not None}
    for name in ("range_start_m", "range_step_m", *OPTIONAL_NUMBERS):
        if header.get(name) is not None:
            fields[name] = number(header[name], f"{path} (header, {name})")
        elif name in ("range_start_m", "range_step_m"):
            raise FileFormatError(f"{path}: the header of the journal lacks {name}")
    fields |= {name: text(header[name], f"{path} (header, {name})") for name in TEXTS if name in header}
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


@dataclass(frozen=True)
class WrittenCaptures:
    """The result of `write_captures`.

    Attributes:
        paths: the files, in recording order.
        views, bins: scans of all files, and samples per scan.
        complete, bytes_dropped: of the journal, see `JournalStream`.
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
        part_path: returns the path of part 1, 2, ... (one part if the recording is short enough).
        counters: counters of the recording; added to the journal's `radar`.
        part_bytes: samples in one file, bytes.

    Raises:
        StorageError, DiskFullError: a file cannot be read or written; earlier parts are kept.
        FileFormatError: as for `read_journal_capture`.
    """
    with open_journal(journal) as stream:
        survey = _surveyed(journal, stream)
    fields, views = survey.fields, survey.views
    if counters is not None:
        fields["radar"] = fields["radar"].with_known(counters)
    row_bytes = survey.bins * survey.dtype.itemsize
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
                    rows = min(rows_a_block, remaining)
                    append(build_capture(journal, **_next_arrays(journal, scans, rows, survey), **fields))
                    remaining -= rows
            paths.append(path)
    return WrittenCaptures(
        tuple(paths),
        views,
        survey.bins,
        fields["complete"],
        survey.dropped,
        fields["radar"],
        survey.track is not None,
    )
