"""The log of the vendor's MRM-RET program (CSV), read into captures.

Its Config lines can be stale, so the grid is taken from the scan lines, which are right (P440 MRM API, log
format).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tagid.capture import Capture
from tagid.errors import FileFormatError
from tagid.radar.messages import MAX_SAMPLES_PER_SCAN
from tagid.storage import atomic
from tagid.storage.p440 import P440Scans, p440_capture

_SCAN = b"MrmFullScanInfo"
_CONFIG = b"Config"
_FIRST_SAMPLE = 16
_CONFIG_FIELDS = (
    "node_id",
    "scan_start_ps",
    "scan_stop_ps",
    "resolution_bins",
    "base_integration_index",
    *(f"segment_samples_{i}" for i in range(4)),
    *(f"segment_multiplier_{i}" for i in range(4)),
    "antenna_mode",
    "transmit_gain",
    "code_channel",
)
_RAW = 1


def is_mrm_ret(data: bytes) -> bool:
    """Whether the bytes look like an MRM-RET log: text with its headings, configuration or scan lines."""
    head = data[: 1 << 16]
    return b"\0" not in head and any(
        mark in head
        for mark in (b", MrmFullScanInfo,", b", Config,", b"MrmControl", b"MrmDetectionListInfo,")
    )


def read_mrm_ret(path: Path, cable_delay_ps: float = 0.0) -> Capture:
    """Read an MRM-RET CSV log.

    A scan line with too few samples (the last one, when the program was stopped) is counted as lost. Where a
    scan was logged raw and filtered, the raw one is taken. `radar` is as for `read_recording`.

    Args:
        path: the file.
        cable_delay_ps: two-way delay of cables and antennas to take off the ranges, ps.

    Raises:
        StorageError: the file cannot be read.
        FileFormatError: not such a log, or without one complete scan.
    """
    data = atomic.read_bytes(path)
    if not is_mrm_ret(data):
        raise FileFormatError(f"{path}: is not an MRM-RET log (no Config or MrmFullScanInfo lines)")
    config: dict[str, Any] = {}
    lines: list[_Line] = []
    lost: list[int] = []
    ignored = 0
    for raw in data.splitlines():
        columns = raw.split(b",")
        kind = columns[1].strip() if len(columns) > 1 else b""
        if kind == _CONFIG and columns[0].strip() != b"Timestamp" and not lines:
            config = _config(columns) or config
        elif kind == _SCAN and columns[0].strip() != b"Timestamp":
            line = _Line.parse(columns)
            if line is None:
                ignored += 1
            elif line.samples is None:
                lost.append(line.message_id)
            else:
                lines.append(line)
    if any(line.filter == _RAW for line in lines):
        lines = [line for line in lines if line.filter == _RAW]
    if not lines:
        raise FileFormatError(
            f"{path}: the log holds no complete MrmFullScanInfo line", "Log full scans in MRM-RET."
        )
    grid = lines[0].grid
    kept = [line for line in lines if line.grid == grid]
    scans = P440Scans(
        samples=np.stack([line.samples for line in kept if line.samples is not None]),
        message_id=np.array([line.message_id for line in kept], dtype=np.int64),
        timestamp_ms=np.array([line.timestamp_ms for line in kept], dtype=np.int64),
        host_time_ns=np.array([line.host_time_ns for line in kept], dtype=np.int64),
        lost_id=np.array(lost, dtype=np.int64),
        info=kept[0].info,
        config=config,
    )
    capture = p440_capture(path, scans, "mrm-ret", cable_delay_ps)
    capture.radar["packets_ignored"] = ignored + len(lines) - len(kept)
    return capture


class _Line:
    """One MrmFullScanInfo line; `samples` is None where it is cut off."""

    def __init__(self, head: list[int], host_time_ns: int, samples: Any) -> None:
        self.host_time_ns = host_time_ns
        self.message_id, self.timestamp_ms = head[0] & 0xFFFF, head[2] & 0xFFFFFFFF
        self.filter = head[10]
        self.samples = samples
        self.grid = (head[7], head[9], head[13])
        self.info: dict[str, Any] = {
            "node_id": head[1],
            "reserved": head[3:7],
            "scan_start_ps": head[7],
            "scan_stop_ps": head[8],
            "step_bins": head[9],
            "filter": head[10],
            "antenna_id": head[11],
            "reserved2": head[12],
        }

    @classmethod
    def parse(cls, columns: list[bytes]) -> _Line | None:
        """The line, or None where even its head cannot be read."""
        try:
            host_time_ns = _nanoseconds(columns[0])
            head = [int(c) for c in columns[2:_FIRST_SAMPLE]]
        except (ValueError, OverflowError):
            return None
        if len(head) != _FIRST_SAMPLE - 2 or not 1 <= head[13] <= MAX_SAMPLES_PER_SCAN:
            return None
        if any(abs(value) > 0xFFFFFFFF for value in head):
            return None
        body = columns[_FIRST_SAMPLE : _FIRST_SAMPLE + head[13]]
        try:
            samples = np.array([int(c) for c in body], dtype=np.int32) if len(body) == head[13] else None
        except (ValueError, OverflowError):
            samples = None
        return cls(head, host_time_ns, samples)


def _nanoseconds(column: bytes) -> int:
    """Epoch seconds with three decimals as ns; exact, where a float would not be. Raises ValueError."""
    return round(float(column) * 1000) * 1_000_000


def _config(columns: list[bytes]) -> dict[str, Any] | None:
    try:
        values = [int(c) for c in columns[2 : 2 + len(_CONFIG_FIELDS)]]
    except ValueError:
        return None
    if len(values) != len(_CONFIG_FIELDS):
        return None
    flat = dict(zip(_CONFIG_FIELDS, values, strict=True))
    segments = {
        name: [flat.pop(f"{name}_{i}") for i in range(4)]
        for name in ("segment_samples", "segment_multiplier")
    }
    return {**flat, **segments}
