"""Reads the log of the vendor's MRM-RET program (CSV) into captures, line by line.

Its Config lines can be stale, so the grid is taken from the scan lines, which are correct (P440 MRM API, log
format).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from tagid import files
from tagid.capture import Capture
from tagid.errors import FileFormatError
from tagid.metadata import RadarSettings
from tagid.radar.messages import MAX_SAMPLES_PER_SCAN, SAMPLES_PER_MESSAGE
from tagid.storage.p440 import GRID_PS, MAX_NODES, P440Scans, choose_node, p440_capture

SCAN = b"MrmFullScanInfo"
CONFIG = b"Config"
DETECTIONS = b"MrmDetectionListInfo"
CONFIG_FIELDS = (
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
_FIRST_SAMPLE = 16
_RAW = 1
_WINDOW = ("scan_start_ps", "scan_stop_ps")
_LONGEST_LINE = 1 << 17
"""Maximum line length, bytes; a scan of 8400 samples of 12 characters and a space each fits."""
_MOST_CONFIGS = 64
_NUMBERS = re.compile(rb"-?\d{1,10}+(?:[ \t]*+,[ \t]*+-?\d{1,10}+)*+")
"""Integers and commas; possessive, because a scan of 8400 samples would overflow the backtracking stack."""


def is_mrm_ret(data: bytes) -> bool:
    """Whether the bytes look like an MRM-RET log: text with its headings, configuration or scan lines."""
    head = data[: 1 << 16]
    return b"\0" not in head and any(
        mark in head
        for mark in (b", MrmFullScanInfo,", b", Config,", b"MrmControl", b"MrmDetectionListInfo,")
    )


def read_mrm_ret(path: Path, cable_delay_ps: float = 0.0, node: int | None = None) -> Capture:
    """Read an MRM-RET CSV log.

    A scan line with too few samples (the last one, when the program was stopped) is counted as lost. Where a
    scan was logged raw and filtered, the raw one is used. `radar` is as for `read_recording`; `config` is
    the Config line that fits the scans, with the window of the scans. If no line fits,
    `config_stale` is true and `window_requested_ps` is the window of the last one. `detection_lists` holds
    the vendor's detections as texts "message id: index magnitude, ..."; they do not identify the radar.

    Args:
        path: the file.
        cable_delay_ps: two-way delay of cables and antennas to subtract from the ranges, ps.
        node: number of the radar to read, if the log holds scans of several.

    Raises:
        StorageError: the file cannot be read.
        FileFormatError: not such a log, or without one complete scan.
        UsageError: several radars and no `node`, or no scan of that one.
    """
    with files.open_regular(path) as (stream, size):
        if size > files.MAX_FILE_BYTES or not is_mrm_ret(stream.read(1 << 16)):
            raise FileFormatError(
                f"{path}: is not an MRM-RET log (no Config or MrmFullScanInfo lines)", "Check the file."
            )
        survey = _Survey.of(stream)
        if not survey.scans_of:
            raise FileFormatError(
                f"{path}: the log holds no complete MrmFullScanInfo line", "Log full scans in MRM-RET."
            )
        chosen = choose_node(path, survey.scans_of, node)
        reading = _Reading.of(stream, chosen, survey.has_raw)
    if not reading.message_id:
        raise FileFormatError(
            f"{path}: the log holds no complete MrmFullScanInfo line", "Log full scans in MRM-RET."
        )
    config, window = _fitting_config(survey, chosen, reading)
    scans = P440Scans(
        samples=np.frombuffer(reading.samples, np.int32).reshape(len(reading.message_id), -1),
        message_id=np.array(reading.message_id, dtype=np.int64),
        timestamp_ms=np.array(reading.timestamp_ms, dtype=np.int64),
        host_time_ns=np.array(reading.host_time_ns, dtype=np.int64),
        lost_id=np.array(reading.lost_id, dtype=np.int64),
        info=reading.info,
        config=RadarSettings.from_json(config),
    )
    capture = p440_capture(path, scans, "mrm-ret", cable_delay_ps)
    ignored = survey.unreadable + reading.other_grid
    radar = replace(
        capture.radar,
        packets_ignored=ignored,
        bytes_left_over=survey.left_over,
        detection_lists=tuple(reading.detection_lists),
        config_stale=window.stale,
        window_requested_ps=window.requested_ps,
        window_actual_ps=window.actual_ps,
    )
    return replace(capture, radar=radar)


def _lines(stream: BinaryIO) -> Iterator[tuple[bytes, bytes, int]]:
    """(kind, line, bytes in the file) of every line except headings; an overlong line is truncated."""
    stream.seek(0)
    while raw := stream.readline(_LONGEST_LINE):
        length = len(raw)
        while not raw.endswith(b"\n") and (more := stream.readline(_LONGEST_LINE)):
            length += len(more)
            if more.endswith(b"\n"):
                break
        columns = raw.split(b",", 2)
        kind = columns[1].strip() if len(columns) == 3 else b""
        if columns[0].strip() not in (b"Timestamp", b""):
            yield kind, raw.rstrip(b"\r\n"), length


@dataclass
class _Survey:
    """Contents of the log, determined without storing a sample.

    Attributes:
        scans_of: radar -> its complete scan lines.
        has_raw: radars that have an unfiltered scan.
        configs: (number of scan lines before it, settings) of the Config lines.
        unreadable: scan lines with an invalid header.
        left_over: bytes of an incomplete last line.
    """

    scans_of: dict[int, int] = field(default_factory=dict)
    has_raw: set[int] = field(default_factory=set)
    configs: list[tuple[int, dict[str, Any]]] = field(default_factory=list)
    unreadable: int = 0
    left_over: int = 0

    @classmethod
    def of(cls, stream: BinaryIO) -> _Survey:
        survey = cls()
        seen = 0
        for kind, line, length in _lines(stream):
            survey.left_over = 0
            if kind == CONFIG and len(survey.configs) < _MOST_CONFIGS:
                config = _config(line)
                survey.configs += [(seen, config)] if config else []
            elif kind == SCAN:
                head = _Head.parse(line)
                if head is None:
                    survey.unreadable += 1
                    survey.left_over = length
                elif not head.is_whole(line):
                    survey.left_over = length
                elif head.node in survey.scans_of or len(survey.scans_of) < MAX_NODES:
                    seen += 1
                    survey.scans_of[head.node] = survey.scans_of.get(head.node, 0) + 1
                    if head.filter == _RAW:
                        survey.has_raw.add(head.node)
            elif kind not in (b"MrmControlRequest", b"MrmControlConfirm", DETECTIONS, CONFIG):
                survey.left_over = length
        return survey


@dataclass
class _Reading:
    """The scans of one radar, in the order of the log and on the grid of the first one."""

    samples: bytearray = field(default_factory=bytearray)
    message_id: list[int] = field(default_factory=list)
    timestamp_ms: list[int] = field(default_factory=list)
    host_time_ns: list[int] = field(default_factory=list)
    lost_id: list[int] = field(default_factory=list)
    detection_lists: list[str] = field(default_factory=list)
    info: dict[str, Any] = field(default_factory=dict)
    other_grid: int = 0

    @classmethod
    def of(cls, stream: BinaryIO, node: int, has_raw: set[int]) -> _Reading:
        reading = cls()
        grid: tuple[int, ...] | None = None
        for kind, line, _ in _lines(stream):
            if kind == DETECTIONS and (text := _detections(line)):
                reading.detection_lists.append(text)
            head = _Head.parse(line) if kind == SCAN else None
            if head is None or head.node != node:
                continue
            samples = head.samples(line)
            if samples is None:
                reading.lost_id.append(head.message_id)
                continue
            if node in has_raw and head.filter != _RAW:
                reading.other_grid += 1
                continue
            grid = grid or head.grid
            if head.grid != grid:
                reading.other_grid += 1
                continue
            reading.info = reading.info or head.info
            reading.samples += samples.tobytes()
            reading.message_id.append(head.message_id)
            reading.timestamp_ms.append(head.timestamp_ms)
            reading.host_time_ns.append(head.host_time_ns)
        return reading


class _Head:
    """The columns of a scan line before its samples."""

    def __init__(self, values: list[int], host_time_ns: int, first_sample: int) -> None:
        self.host_time_ns = host_time_ns
        self._first_sample = first_sample
        self.node, self.filter = values[1], values[10]
        self.message_id, self.timestamp_ms = values[0] & 0xFFFF, values[2] & 0xFFFFFFFF
        self.total = values[13]
        self.grid = (values[7], values[9], values[13])
        self.info: dict[str, Any] = {
            "node_id": values[1],
            "reserved": values[3:7],
            "scan_start_ps": values[7],
            "scan_stop_ps": values[8],
            "step_bins": values[9],
            "filter": values[10],
            "antenna_id": values[11],
            "reserved2": values[12],
        }

    @classmethod
    def parse(cls, line: bytes) -> _Head | None:
        """The header of a scan line, or None if it cannot be read.

        The vendor's C example logs neither the reserved columns nor the mode: 11 columns before the samples.
        """
        columns = line.split(b",", _FIRST_SAMPLE)
        try:
            host_time_ns = _nanoseconds(columns[0])
            short = [_integer(c) for c in columns[2:11]]
            values = [_integer(c) for c in columns[11:_FIRST_SAMPLE]]
        except (ValueError, OverflowError):
            return None
        full = brief = None
        if len(short) + len(values) == _FIRST_SAMPLE - 2:
            full = cls(short + values, host_time_ns, _FIRST_SAMPLE)
        if full and full.is_plausible() and full.is_whole(line):
            return full
        if len(short) == 9 and short[5] > 0:
            brief = cls([*short[:3], 0, 0, 0, 0, *short[3:8], 3, short[8]], host_time_ns, 11)
        if brief and brief.is_plausible() and brief.is_whole(line):
            return brief
        return full if full and full.is_plausible() else None

    def is_plausible(self) -> bool:
        """Whether a radar can send these numbers."""
        window = (self.info["scan_start_ps"], self.info["scan_stop_ps"])
        return (
            1 <= self.total <= MAX_SAMPLES_PER_SCAN
            and 0 <= self.node <= 0xFFFFFFFF
            and all(abs(value) < 2**31 for value in window)
            and 0 <= self.info["step_bins"] <= 0xFFFF
            and all(0 <= self.info[name] <= 0xFF for name in ("filter", "antenna_id", "reserved2"))
            and all(0 <= value <= 0xFFFFFFFF for value in self.info["reserved"])
        )

    def is_whole(self, line: bytes) -> bool:
        """Whether the number of samples matches the header."""
        return line.count(b",") - line.endswith((b",", b", ")) >= self._first_sample - 1 + self.total

    def samples(self, line: bytes) -> np.ndarray[Any, np.dtype[np.int32]] | None:
        """(total,) int32 counts; None if the line is incomplete or contains other text."""
        columns = line.split(b",", self._first_sample)
        if len(columns) <= self._first_sample:
            return None
        body = columns[-1].strip(b" \t,")
        # Checked first: numpy's conversion of text that is not a number depends on its version.
        if not _NUMBERS.fullmatch(body):
            return None
        values = np.fromstring(body, np.int64, sep=",")[: self.total]
        limits = np.iinfo(np.int32)
        if len(values) != self.total or values.min() < limits.min or values.max() > limits.max:
            return None
        return values.astype(np.int32)


def _integer(column: bytes) -> int:
    """A decimal number of at most 12 characters; int() would also accept `1_000`. Raises ValueError."""
    text = column.strip()
    if len(text) > 12 or not text.removeprefix(b"-").isdigit():
        raise ValueError(column[:20])
    return int(text)


def _nanoseconds(column: bytes) -> int:
    """Epoch seconds with three decimals as ns; exact, unlike a float. Raises ValueError."""
    seconds = float(column[:64])
    if not abs(seconds) < 9e9:
        raise ValueError(column[:20])
    return round(seconds * 1000) * 1_000_000


def _config(line: bytes) -> dict[str, Any] | None:
    columns = line.split(b",", 2 + len(CONFIG_FIELDS))
    try:
        values = [_integer(c) for c in columns[2 : 2 + len(CONFIG_FIELDS)]]
    except ValueError:
        return None
    if len(values) != len(CONFIG_FIELDS):
        return None
    flat = dict(zip(CONFIG_FIELDS, values, strict=True))
    segments = {
        name: [flat.pop(f"{name}_{i}") for i in range(4)]
        for name in ("segment_samples", "segment_multiplier")
    }
    return {**flat, **segments}


@dataclass(frozen=True)
class _Window:
    """The scan window of the configuration and that of the scans, ps; None if not known."""

    requested_ps: tuple[int, ...] | None = None
    actual_ps: tuple[int, ...] | None = None
    stale: bool | None = None


def _fitting_config(survey: _Survey, node: int, reading: _Reading) -> tuple[dict[str, Any], _Window]:
    """The settings of the Config line for the scans, with notes on it.

    Of a radar's Config lines before its scans, the last one whose window matches is used; otherwise the last
    one, whose window at least is stale.
    """
    actual = {name: reading.info[name] for name in _WINDOW}
    one_radar = len(survey.scans_of) == 1
    configs = [(seen, c) for seen, c in survey.configs if c["node_id"] == node]
    if not configs and one_radar:
        configs = survey.configs
    before = [c for seen, c in configs if seen == 0] or [c for _, c in configs[:1]]
    if not before:
        return {}, _Window()
    fitting = [c for c in before if all(abs(c[name] - actual[name]) <= GRID_PS for name in _WINDOW)]
    chosen = (fitting or before)[-1]
    window = _Window(tuple(chosen[name] for name in _WINDOW), tuple(actual.values()), not fitting)
    return {**chosen, **actual}, window


def _detections(line: bytes) -> str | None:
    """A detection list as "message id: index magnitude, ..."; None if the line is not one."""
    columns = line.split(b",", 4 + 2 * SAMPLES_PER_MESSAGE)[2:]
    try:
        message_id, count = _integer(columns[0]), _integer(columns[1])
        values = [_integer(c) for c in columns[2 : 2 + 2 * max(count, 0)]]
    except (ValueError, IndexError):
        return None
    if not 0 <= count <= SAMPLES_PER_MESSAGE or len(values) != 2 * count:
        return None
    pairs = (f"{values[i]} {values[i + 1]}" for i in range(0, len(values), 2))
    return f"{message_id}: " + ", ".join(pairs)
