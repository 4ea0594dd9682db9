"""Exports captures in the vendor's log format, for tools that read no other format.

Data read from such a log is preserved: samples, times, settings and detection lists.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from typing import Any

import numpy as np

from tagid.capture import Capture
from tagid.errors import DataError
from tagid.storage.mrm_ret import CONFIG, CONFIG_FIELDS, DETECTIONS, SCAN
from tagid.storage.recordings import check_counts, clock_ms, wire_settings

_HEADINGS = (
    "Timestamp, Config, NodeId, ScanStartPs, ScanStopPs, ScanResolutionBins, BaseIntegrationIndex, "
    + ", ".join(f"Segment{i}NumSamples" for i in range(1, 5))
    + ", "
    + ", ".join(f"Segment{i}AdditionalIntegration" for i in range(1, 5))
    + ", AntennaMode, TransmitGain, CodeChannel",
    "Timestamp, MrmFullScanInfo, MessageId, SourceId, EmbeddedTimestamp, Reserved, Reserved, "
    "Reserved, Reserved, ScanStartPs, ScanStopPs, ScanStepBins, Filtering, AntennaId, Reserved, "
    "NumSamplesTotal, ScanData",
    "Timestamp, MrmDetectionListInfo, MessageId, NumDetections, Index, Magnitude",
)


def mrm_ret_lines(capture: Capture) -> Iterator[bytes]:
    """The lines of an MRM-RET log, one scan at a time.

    Raises:
        UsageError: the samples are not int32 counts, the only type that the format supports.
        DataError: too many bins, no times, or settings that do not fit the format.
    """
    check_counts(capture, "an MRM-RET log")
    info, config = wire_settings(capture)
    clock = clock_ms(capture)
    epoch_ms = _epoch_ms(capture, clock)
    numbers = np.arange(capture.views) if capture.scan_id is None else capture.scan_id
    detections = _detections(capture)
    yield from (f"{heading}\r\n".encode() for heading in _HEADINGS)
    yield _line(int(epoch_ms[0]), CONFIG, _config_columns(capture, config))
    grid = [info["scan_start_ps"], info["scan_stop_ps"], info["step_bins"], info["filter"]]
    tail = [info["antenna_id"], info["reserved2"], capture.bins]
    for view in range(capture.views):
        message_id = int(numbers[view]) & 0xFFFF
        head = [message_id, info["node_id"], int(clock[view]) & 0xFFFFFFFF, *info.get("reserved", [0] * 4)]
        yield _line(
            int(epoch_ms[view]), SCAN, _checked([*head, *grid, *tail]) + capture.samples[view].tolist()
        )
        for values in detections.pop(message_id, ()):
            yield _line(int(epoch_ms[view]), DETECTIONS, [message_id, len(values) // 2, *values])


def _line(epoch_ms: int, kind: str, values: list[int]) -> bytes:
    seconds = f"{epoch_ms // 1000}.{epoch_ms % 1000:03d}"
    return f"{seconds}, {kind}, {', '.join(map(str, values))}\r\n".encode()


def _config_columns(capture: Capture, config: dict[str, Any]) -> list[int]:
    requested = capture.radar.window_requested_ps
    flat = {"antenna_mode": 2, "transmit_gain": 63, "base_integration_index": 11, **config}
    if requested is not None and len(requested) == 2:
        flat |= {"scan_start_ps": requested[0], "scan_stop_ps": requested[1]}
    for name in ("segment_samples", "segment_multiplier"):
        values = config.get(name)
        known = values if isinstance(values, list) and len(values) == 4 else [0] * 4
        flat |= {f"{name}_{i}": value for i, value in enumerate(known)}
    return _checked([flat.get(name, 0) for name in CONFIG_FIELDS])


def _checked(values: list[Any]) -> list[int]:
    for value in values:
        if not isinstance(value, int) or isinstance(value, bool) or not abs(value) < 2**32:
            raise DataError(f"the radar setting {str(value)[:60]} does not fit an MRM-RET log")
    return values


def _epoch_ms(capture: Capture, clock: np.ndarray[Any, np.dtype[np.int64]]) -> Any:
    """(views,) arrival in ms since the epoch; if unknown, from the capture's date and the radar's clock."""
    if capture.host_time_ns is not None:
        return np.maximum(capture.host_time_ns // 1_000_000, 0)
    try:
        start = datetime.datetime.fromisoformat(capture.created_utc).timestamp()
    except (ValueError, OverflowError, OSError):
        start = 0.0
    return np.maximum(round(start * 1000) + clock - clock[0], 0)


def _detections(capture: Capture) -> dict[int, list[list[int]]]:
    """The detection lists stored with the scans, by message id: flat [index, magnitude, ...]."""
    lists: dict[int, list[list[int]]] = {}
    for text in capture.radar.detection_lists:
        message_id, _, body = text.partition(": ")
        words = body.replace(",", "").split()
        if message_id.isdigit() and all(word.isdigit() for word in words) and len(words) % 2 == 0:
            lists.setdefault(int(message_id), []).append([int(word) for word in words])
    return lists
