"""The `.prd`/`.out` recordings of other P440 tools, read into captures and written back byte for byte.

Such a file is the 32-byte CONFIG block and then the 1452-byte SCAN_INFO messages as they came, nothing else;
it may end in the middle of a message (P440 MRM API; public recordings).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from tagid import files
from tagid.capture import Capture
from tagid.constants import BINS_PER_SAMPLE, SPEED_OF_LIGHT
from tagid.errors import DataError, FileFormatError, UsageError
from tagid.metadata import RadarSettings
from tagid.radar.messages import (
    CONFIG_DTYPE,
    MAX_MESSAGES_PER_SCAN,
    MAX_SAMPLES_PER_SCAN,
    SAMPLES_PER_MESSAGE,
    SCAN_INFO_DTYPE,
    MessageType,
)
from tagid.storage.p440 import MAX_NODES, P440Scans, choose_node, p440_capture

_PER_SCAN = (
    "node_id",
    "reserved",
    "scan_start_ps",
    "scan_stop_ps",
    "step_bins",
    "filter",
    "reserved2",
    "antenna_id",
    "operation_mode",
)
_GRID = ("scan_start_ps", "step_bins", "total_samples")
_CONFIG_NAMES = CONFIG_DTYPE.names or ()
_HEAD_NAMES = tuple(name for name in SCAN_INFO_DTYPE.names or () if name != "samples")
_HEAD_DTYPE = np.dtype([(name, SCAN_INFO_DTYPE[name]) for name in _HEAD_NAMES])
_SHORTEST = CONFIG_DTYPE.itemsize + SCAN_INFO_DTYPE.itemsize
_PACKETS_AT_ONCE = 64
"""Messages read at a time: 93 kB."""


def is_recording(data: bytes) -> bool:
    """Whether the bytes look like a recording: a SCAN_INFO message follows the configuration."""
    return data[CONFIG_DTYPE.itemsize : CONFIG_DTYPE.itemsize + 2] == int(MessageType.SCAN_INFO).to_bytes(
        2, "big"
    )


def read_recording(path: Path, cable_delay_ps: float = 0.0, node: int | None = None) -> Capture:
    """Read a `.prd`/`.out` recording, in parts: the memory taken is that of the samples and little more.

    Fragments are regrouped by (id, timestamp), so a lost one costs its scan and nothing else; `radar` holds
    `config` and `scan_info` (the fields that make the file again), `scans_lost`, `packets_ignored` (what is
    no fragment of a scan on the recording's grid) and `bytes_left_over` (a message cut off at the end).

    Args:
        path: the file.
        cable_delay_ps: two-way delay of cables and antennas to subtract from the ranges, ps.
        node: number of the radar to read, where the file holds scans of several.

    Raises:
        StorageError: the file cannot be read.
        FileFormatError: not a recording, or without one complete scan.
        UsageError: several radars and no `node`, or no scan of that one.
    """
    with files.open_regular(path) as (stream, size):
        count, left_over = divmod(size - CONFIG_DTYPE.itemsize, SCAN_INFO_DTYPE.itemsize)
        if count < 1 or size > files.MAX_FILE_BYTES:
            limits = f"expected {_SHORTEST} to {files.MAX_FILE_BYTES}"
            raise FileFormatError(
                f"{path}: has {size} bytes, {limits} for a P440 recording",
                f"One has {CONFIG_DTYPE.itemsize} bytes, then {SCAN_INFO_DTYPE.itemsize} a message.",
            )
        config = _plain(np.frombuffer(stream.read(CONFIG_DTYPE.itemsize), CONFIG_DTYPE, 1)[0], _CONFIG_NAMES)
        heads = _read_heads(stream, count)
        valid = _valid(heads)
        if not valid.any():
            raise FileFormatError(f"{path}: holds no SCAN_INFO message where a P440 recording has them")
        numbers, packets_of = np.unique(heads["node_id"][valid], return_counts=True)
        held = dict(zip(numbers[:MAX_NODES].tolist(), packets_of[:MAX_NODES].tolist(), strict=True))
        valid &= heads["node_id"] == choose_node(path, held, node)
        first = heads[int(valid.argmax())]
        for name in _GRID:
            valid &= heads[name] == first[name]
        complete, partial = _regroup(heads, np.flatnonzero(valid))
        if not complete:
            raise FileFormatError(
                f"{path}: holds no complete scan", "The recording is cut off or most of it is lost."
            )
        rows = np.array(complete)
        stream.seek(CONFIG_DTYPE.itemsize)
        samples = _read_samples(stream, heads, rows)
    scans = P440Scans(
        samples=samples,
        message_id=heads["id"][rows[:, 0]].astype(np.int64),
        timestamp_ms=heads["timestamp_ms"][rows[:, 0]].astype(np.int64),
        host_time_ns=None,
        lost_id=np.array(partial, dtype=np.int64),
        info=_plain(heads[rows[0, 0]], _PER_SCAN),
        config=RadarSettings.from_json(config),
    )
    capture = p440_capture(path, scans, "recording", cable_delay_ps)
    ignored = int(count - np.count_nonzero(valid))
    radar = replace(capture.radar, packets_ignored=ignored, bytes_left_over=int(left_over))
    return replace(capture, radar=radar)


def _read_heads(stream: BinaryIO, count: int) -> NDArray[np.void]:
    """(count,) headers of the messages that follow; what a shrinking file lacks is zero."""
    heads = np.zeros(count, dtype=_HEAD_DTYPE)
    for first in range(0, count, _PACKETS_AT_ONCE):
        packets = _read_packets(stream, min(_PACKETS_AT_ONCE, count - first))
        heads[first : first + len(packets)] = packets[list(_HEAD_NAMES)]
    return heads


def _read_packets(stream: BinaryIO, count: int) -> NDArray[np.void]:
    data = stream.read(count * SCAN_INFO_DTYPE.itemsize)
    return np.frombuffer(data, SCAN_INFO_DTYPE, len(data) // SCAN_INFO_DTYPE.itemsize)


def _read_samples(stream: BinaryIO, heads: NDArray[np.void], rows: NDArray[np.int64]) -> NDArray[np.int32]:
    """(views, bins) counts of the scans whose messages stand in `rows` (views, messages)."""
    total = int(heads["total_samples"][rows[0, 0]])
    samples: NDArray[np.int32] = np.zeros((len(rows), total), dtype=np.int32)
    scan_of = np.full(len(heads), -1, dtype=np.int64)
    scan_of[rows] = np.arange(len(rows))[:, None]
    part_of = heads["message_index"]
    for first in range(0, len(heads), _PACKETS_AT_ONCE):
        packets = _read_packets(stream, min(_PACKETS_AT_ONCE, len(heads) - first))
        scans = scan_of[first : first + len(packets)]
        parts = part_of[first : first + len(packets)]
        for part in np.unique(parts[scans >= 0]).tolist():
            here = np.flatnonzero((parts == part) & (scans >= 0))
            start = part * SAMPLES_PER_MESSAGE
            width = min(SAMPLES_PER_MESSAGE, total - start)
            samples[scans[here], start : start + width] = packets["samples"][here, :width]
    return samples


def write_recording(path: Path, capture: Capture) -> None:
    """Write a `.prd`/`.out` recording, whole or not at all; what was read from one comes back byte for byte.

    Raises:
        UsageError: the samples are not int32 counts, which is all that the format holds.
        DataError: too many bins, or settings that do not fit the format.
        DiskFullError, StorageError: the file cannot be written.
    """
    files.write_bytes(path, encode_recording(capture))


def encode_recording(capture: Capture) -> bytes:
    """The bytes of a recording; errors as for `write_recording`."""
    if capture.samples.dtype != np.int32:
        raise UsageError(
            f"the capture holds {capture.samples.dtype} samples, a P440 recording holds int32 counts only",
            "Export to .npz, .mat or .h5 instead.",
        )
    views, bins = capture.samples.shape
    if bins > MAX_SAMPLES_PER_SCAN:
        raise DataError(f"the capture has {bins} bins, a P440 scan has at most {MAX_SAMPLES_PER_SCAN}")
    messages = -(-bins // SAMPLES_PER_MESSAGE)
    info, config = wire_settings(capture)
    packets = np.zeros((views, messages), dtype=SCAN_INFO_DTYPE)
    packets["type"] = int(MessageType.SCAN_INFO)
    scan_id = np.arange(views) if capture.scan_id is None else capture.scan_id
    packets["id"] = (scan_id & 0xFFFF)[:, None]
    packets["timestamp_ms"] = (clock_ms(capture) & 0xFFFFFFFF)[:, None]
    _fill(packets, info)
    packets["total_samples"] = bins
    packets["message_index"] = np.arange(messages)
    packets["message_count"] = messages
    left = bins - SAMPLES_PER_MESSAGE * np.arange(messages)
    packets["message_samples"] = np.minimum(SAMPLES_PER_MESSAGE, left)
    padded = np.zeros((views, messages * SAMPLES_PER_MESSAGE), dtype=">i4")
    padded[:, :bins] = capture.samples
    packets["samples"] = padded.reshape(views, messages, SAMPLES_PER_MESSAGE)
    block = np.zeros(1, dtype=CONFIG_DTYPE)
    _fill(block, config)
    return block.tobytes() + packets.tobytes()


def _valid(packets: NDArray[np.void]) -> NDArray[np.bool_]:
    """Which packets are fragments whose numbers agree with each other."""
    total = packets["total_samples"].astype(np.int64)
    here = packets["message_samples"].astype(np.int64)
    index = packets["message_index"].astype(np.int64)
    count = packets["message_count"].astype(np.int64)
    valid: NDArray[np.bool_] = (
        (packets["type"] == int(MessageType.SCAN_INFO))
        & (total >= 1)
        & (count <= MAX_MESSAGES_PER_SCAN)
        & (count == -(-total // SAMPLES_PER_MESSAGE))
        & (index < count)
        & (here == np.minimum(SAMPLES_PER_MESSAGE, total - index * SAMPLES_PER_MESSAGE))
    )
    return valid


def _regroup(heads: NDArray[np.void], rows: NDArray[np.intp]) -> tuple[list[list[int]], list[int]]:
    """Rows of the fragments of each complete scan, in order of its first one, and the ids of the others."""
    groups: dict[tuple[int, int], dict[int, int]] = {}
    columns = (heads[name][rows].tolist() for name in ("id", "timestamp_ms", "message_index"))
    for row, scan, timestamp, index in zip(rows.tolist(), *columns, strict=True):
        groups.setdefault((scan, timestamp), {}).setdefault(index, row)
    count = int(heads["message_count"][rows[0]])
    complete = [[g[i] for i in range(count)] for g in groups.values() if len(g) == count]
    return complete, [key[0] for key, g in groups.items() if len(g) < count]


def wire_settings(capture: Capture) -> tuple[dict[str, Any], dict[str, Any]]:
    """Header and configuration fields: those of the recording, or what follows from the capture's grid."""
    radar = capture.radar
    info, config = dict(radar.scan_info or {}), (radar.config or RadarSettings()).to_json()
    delay = radar.cable_delay_ps or 0.0
    start = round(capture.range_start_m * 2 / SPEED_OF_LIGHT * 1e12 + delay)
    stop = round(start + capture.bins * capture.range_step_m * 2 / SPEED_OF_LIGHT * 1e12)
    grid = {
        "node_id": 1 if radar.node_id is None else radar.node_id,
        "scan_start_ps": config.get("scan_start_ps", start),
        "scan_stop_ps": config.get("scan_stop_ps", stop),
    }
    defaults = {"step_bins": BINS_PER_SAMPLE, "filter": 1, "reserved2": 3, "operation_mode": 1}
    antenna = {"antenna_id": config.get("antenna_mode", 2)}
    return {**grid, **defaults, **antenna, **info}, {**grid, "resolution_bins": BINS_PER_SAMPLE, **config}


def _fill(record: NDArray[np.void], fields: dict[str, Any]) -> None:
    """Set the fields that the record has; DataError if a value does not fit."""
    names = (set(_PER_SCAN) | set(_CONFIG_NAMES)) & set(record.dtype.names or ())
    for name in names & set(fields):
        field = record.dtype[name]
        values = np.asarray(fields[name])
        limits = np.iinfo(field.base)
        if (
            values.shape != field.shape
            or values.dtype.kind not in "iu"
            or (values < limits.min).any()
            or (values > limits.max).any()
        ):
            raise DataError(
                f"the radar setting {name} = {str(fields[name])[:60]} does not fit a P440 recording"
            )
        record[name] = values


def clock_ms(capture: Capture) -> NDArray[np.int64]:
    if capture.radar_time_ms is not None:
        return np.rint(capture.radar_time_ms).astype(np.int64)
    if capture.host_time_ns is not None:
        return capture.host_time_ns // 1_000_000
    raise DataError(
        "the capture holds no times, a P440 recording needs one a scan", "Export to .npz instead."
    )


def _plain(record: np.void, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: record[name].tolist() for name in names}
