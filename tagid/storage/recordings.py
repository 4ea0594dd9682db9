"""The `.prd`/`.out` recordings of other P440 tools, read into captures and written back byte for byte.

Such a file is the 32-byte CONFIG block and then the 1452-byte SCAN_INFO messages as they came, nothing else;
it may end in the middle of a message (P440 MRM API; public recordings).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.constants import BINS_PER_SAMPLE, SPEED_OF_LIGHT
from tagid.errors import DataError, FileFormatError, UsageError
from tagid.radar.messages import (
    CONFIG_DTYPE,
    MAX_MESSAGES_PER_SCAN,
    MAX_SAMPLES_PER_SCAN,
    SAMPLES_PER_MESSAGE,
    SCAN_INFO_DTYPE,
    MessageType,
)
from tagid.storage import atomic
from tagid.storage.p440 import P440Scans, p440_capture

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


def is_recording(data: bytes) -> bool:
    """Whether the bytes look like a recording: a SCAN_INFO message follows the configuration."""
    return data[CONFIG_DTYPE.itemsize : CONFIG_DTYPE.itemsize + 2] == int(MessageType.SCAN_INFO).to_bytes(
        2, "big"
    )


def read_recording(path: Path, cable_delay_ps: float = 0.0) -> Capture:
    """Read a `.prd`/`.out` recording.

    Fragments are regrouped by (id, timestamp), so a lost one costs its scan and nothing else; `radar` holds
    `config` and `scan_info` (the fields that make the file again), `scans_lost` and `packets_ignored`
    (what is no fragment of a scan on the recording's grid).

    Args:
        path: the file.
        cable_delay_ps: two-way delay of cables and antennas to take off the ranges, ps.

    Raises:
        StorageError: the file cannot be read.
        FileFormatError: not a recording, or without one complete scan.
    """
    data = atomic.read_bytes(path)
    count = (len(data) - CONFIG_DTYPE.itemsize) // SCAN_INFO_DTYPE.itemsize
    if count < 1:
        raise FileFormatError(
            f"{path}: has {len(data)} bytes, too few for a P440 recording",
            f"One has {CONFIG_DTYPE.itemsize} bytes, then {SCAN_INFO_DTYPE.itemsize} a message.",
        )
    config = _plain(np.frombuffer(data, CONFIG_DTYPE, 1)[0], CONFIG_DTYPE.names or ())
    packets = np.frombuffer(data, SCAN_INFO_DTYPE, count, CONFIG_DTYPE.itemsize)
    valid = _valid(packets)
    if not valid.any():
        raise FileFormatError(f"{path}: holds no SCAN_INFO message where a P440 recording has them")
    fragments = packets[valid]
    same = np.ones(len(fragments), dtype=bool)
    for name in _GRID:
        same &= fragments[name] == fragments[name][0]
    fragments = fragments[same]
    complete, partial = _regroup(fragments)
    if not complete:
        raise FileFormatError(
            f"{path}: holds no complete scan", "The recording is cut off or most of it is lost."
        )
    index = np.array(complete)
    first = fragments[index[:, 0]]
    total = int(first["total_samples"][0])
    scans = P440Scans(
        samples=fragments["samples"][index].reshape(len(index), -1)[:, :total].astype(np.int32),
        message_id=first["id"].astype(np.int64),
        timestamp_ms=first["timestamp_ms"].astype(np.int64),
        host_time_ns=None,
        lost_id=np.array(partial, dtype=np.int64),
        info=_plain(first[0], _PER_SCAN),
        config=config,
    )
    capture = p440_capture(path, scans, "recording", cable_delay_ps)
    capture.radar["packets_ignored"] = int(count - len(fragments))
    return capture


def write_recording(path: Path, capture: Capture) -> None:
    """Write a `.prd`/`.out` recording, whole or not at all; what was read from one comes back byte for byte.

    Raises:
        UsageError: the samples are not int32 counts, which is all that the format holds.
        DataError: too many bins, or settings that do not fit the format.
        DiskFullError, StorageError: the file cannot be written.
    """
    atomic.write_bytes(path, encode_recording(capture))


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
    info, config = _settings(capture)
    packets = np.zeros((views, messages), dtype=SCAN_INFO_DTYPE)
    packets["type"] = int(MessageType.SCAN_INFO)
    scan_id = np.arange(views) if capture.scan_id is None else capture.scan_id
    packets["id"] = (scan_id & 0xFFFF)[:, None]
    packets["timestamp_ms"] = (_clock_ms(capture) & 0xFFFFFFFF)[:, None]
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


def _regroup(fragments: NDArray[np.void]) -> tuple[list[list[int]], list[int]]:
    """Rows of the fragments of each complete scan, in order of its first one, and the ids of the others."""
    groups: dict[tuple[int, int], dict[int, int]] = {}
    keys = zip(
        fragments["id"].tolist(),
        fragments["timestamp_ms"].tolist(),
        fragments["message_index"].tolist(),
        strict=True,
    )
    for row, (scan, timestamp, index) in enumerate(keys):
        groups.setdefault((scan, timestamp), {}).setdefault(index, row)
    count = int(fragments["message_count"][0])
    complete = [[g[i] for i in range(count)] for g in groups.values() if len(g) == count]
    return complete, [key[0] for key, g in groups.items() if len(g) < count]


def _settings(capture: Capture) -> tuple[dict[str, Any], dict[str, Any]]:
    """Header and configuration fields: those of the recording, or what follows from the capture's grid."""
    radar = capture.radar
    info, config = radar.get("scan_info"), radar.get("config")
    info = dict(info) if isinstance(info, dict) else {}
    config = dict(config) if isinstance(config, dict) else {}
    delay = radar.get("cable_delay_ps", 0.0)
    delay = delay if isinstance(delay, int | float) else 0.0
    start = round(capture.range_start_m * 2 / SPEED_OF_LIGHT * 1e12 + delay)
    stop = round(start + capture.bins * capture.range_step_m * 2 / SPEED_OF_LIGHT * 1e12)
    grid = {
        "node_id": radar.get("node_id", 1),
        "scan_start_ps": config.get("scan_start_ps", start),
        "scan_stop_ps": config.get("scan_stop_ps", stop),
    }
    defaults = {"step_bins": BINS_PER_SAMPLE, "filter": 1, "reserved2": 3, "operation_mode": 1}
    antenna = {"antenna_id": config.get("antenna_mode", 2)}
    return {**grid, **defaults, **antenna, **info}, {**grid, "resolution_bins": BINS_PER_SAMPLE, **config}


def _fill(record: NDArray[np.void], fields: dict[str, Any]) -> None:
    """Set the fields that the record has; DataError where a value does not fit."""
    names = (set(_PER_SCAN) | set(CONFIG_DTYPE.names or ())) & set(record.dtype.names or ())
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


def _clock_ms(capture: Capture) -> NDArray[np.int64]:
    if capture.radar_time_ms is not None:
        return np.rint(capture.radar_time_ms).astype(np.int64)
    if capture.host_time_ns is not None:
        return capture.host_time_ns // 1_000_000
    raise DataError(
        "the capture holds no times, a P440 recording needs one a scan", "Export to .npz instead."
    )


def _plain(record: np.void, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: record[name].tolist() for name in names}
