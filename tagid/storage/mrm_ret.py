"""Reads the log of the vendor's MRM-RET program (CSV) into captures, line by line.

Its Config lines can be stale, so the grid is taken from the scan lines, which are correct (P440 MRM API, log
format). Logs that a spreadsheet, a data-frame library or another client saved again are read as well: other
delimiters, decimal commas, quotes, encodings, an index in front, empty cells behind, wrapped lines.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from tagid import files
from tagid.capture import Capture
from tagid.counting import counted
from tagid.errors import FileFormatError, displayable
from tagid.metadata import RadarInfo, RadarSettings
from tagid.radar.messages import MAX_SAMPLES_PER_SCAN, SAMPLES_PER_MESSAGE
from tagid.storage.p440 import GRID_PS, MAX_NODES, RAW, WINDOW, P440Scans, choose_node, p440_capture

SCAN = "MrmFullScanInfo"
CONFIG = "Config"
DETECTIONS = "MrmDetectionListInfo"
_CONTROLS = ("MrmControlRequest", "MrmControlConfirm")
_KINDS = {kind.lower(): kind for kind in (SCAN, CONFIG, DETECTIONS, *_CONTROLS)}
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
_HEAD_COLUMNS = 14
"""Columns between the name of a scan line and its samples."""
_BRIEF_COLUMNS = 9
"""The same in the vendor's C example, which logs neither the reserved columns nor the mode."""
_LONGEST_LINE = 1 << 17
"""Maximum line length; a scan of 8400 samples of 12 characters and a space each fits."""
_MOST_CONFIGS = 64
_MOST_WRAPS = 256
_NUMBERS = re.compile(r"-?[0-9]{1,10}+(?:[ \t]*+,[ \t]*+-?[0-9]{1,10}+)*+")
"""Integers and commas; possessive, because a scan of 8400 samples would overflow the backtracking stack."""
_DECIMAL = r"[+-]?[0-9]{1,12}+(?:\.[0-9]*+)?+(?:[eE][+-]?[0-9]{1,2}+)?+"
_DECIMALS = re.compile(rf"{_DECIMAL}(?:[ \t]*+,[ \t]*+{_DECIMAL})*+")
"""The same numbers as another program writes them: 123.0, 1.23E+02."""
_MARK = re.compile(
    r"""(?:(?:^|[\s,;|"'])(?i:MrmFullScanInfo|MrmControl(?:Request|Confirm)|MrmDetectionListInfo)"""
    r"""|[,;\t|]\ *+["']?Config)["']?\ *+(?P<delimiter>[,;\t|]|(?<=\ )|(?<=\ "))""",
    re.MULTILINE,
)
"""The name of a line and the delimiter behind it; empty where spaces separate the columns."""
_QUOTED = re.compile(r"""(["'])(.*?)\1""")
_SWISS = re.compile(r"(?<=[0-9])'(?=[0-9]{3}(?![0-9]))")
"""The apostrophe in 1'977."""
_THOUSANDS = re.compile(r"-?[0-9]{1,3}(?:,[0-9]{3})+")
_MISSING = ("", "nan", "null", "none", "na", "#n/a", "<na>")
"""What other programs write into cells without a value, in lower case."""
_EARLIEST_S, _LATEST_S = 946_684_800, 2_524_608_000
"""A time of the host lies between 2000 and 2050, s since 1970; those since 1900 or 1904 are later."""
_SECOND = (1, 10**3, 10**6, 10**9)
"""A second in the units of such a time."""


def is_mrm_ret(data: bytes) -> bool:
    """Whether the bytes look like an MRM-RET log: text with its headings, configuration or scan lines."""
    return _Form.of(data) is not None


@dataclass(frozen=True)
class _Form:
    """How the text of a log is stored.

    Attributes:
        encoding: of the text.
        delimiter: between the columns; "" where spaces separate them.
    """

    encoding: str
    delimiter: str

    @classmethod
    def of(cls, data: bytes) -> _Form | None:
        """The form of a log that begins with these bytes; None if they are no such log."""
        data = data[: 1 << 16]
        if data.startswith((b"\xff\xfe", b"\xfe\xff")):
            encoding = "utf-16"
        elif data.startswith(b"\xef\xbb\xbf"):
            encoding = "utf-8-sig"
        elif len(data) > 1 and 0 in data[:2]:
            encoding = "utf-16-le" if data[1] == 0 else "utf-16-be"
        else:
            encoding = "latin-1"
        text = data.decode(encoding, "replace")
        mark = None if "\0" in text else _MARK.search(text)
        return None if mark is None else cls(encoding, mark["delimiter"])

    def cells(self, line: str) -> str:
        """The line with commas between the cells, decimal points, no quotes and no empty cells behind."""
        if '"' in line or "'" in line:
            line = _SWISS.sub("", line)
            line = _QUOTED.sub(self._unquoted, line)
        if not self.delimiter:
            line = ",".join(line.replace(",", ".").split())
        elif self.delimiter != ",":
            line = line.replace(",", ".").replace(self.delimiter, ",")
        line = line.strip(" \t\r\n").rstrip(", \t")
        if line[-4:].rpartition(",")[2].strip().lower() in _MISSING:
            cells = line.split(",")
            while cells and cells[-1].strip().lower() in _MISSING:
                cells.pop()
            line = ",".join(cells)
        return line

    def _unquoted(self, quoted: re.Match[str]) -> str:
        content = quoted[2]
        if self.delimiter != ",":
            return content
        return (
            content.replace(",", "") if _THOUSANDS.fullmatch(content.strip()) else content.replace(",", ".")
        )


def read_mrm_ret(path: Path, cable_delay_ps: float = 0.0, node: int | None = None) -> Capture:
    """Read an MRM-RET CSV log.

    A scan line with too few samples (the last one, when the program was stopped) is counted as lost. Where a
    scan was logged raw and filtered, the raw one is used. `radar` is as for `read_recording`; `config` is
    the Config line that fits the scans, with the window of the scans. If no line fits,
    `config_stale` is true and `window_requested_ps` is the window of the last one. `detection_lists` holds
    the vendor's detections as texts "message id: index magnitude, ..."; they do not identify the radar.

    Arguments as `tagid.storage.importers.read_any`.

    Raises:
        StorageError: the file cannot be read.
        FileFormatError: not such a log, or without one complete scan.
        UsageError: several radars and no `node`, or no scan of that one.
    """
    with files.open_regular(path) as (stream, size):
        form = _Form.of(stream.read(1 << 16))
        if size > files.MAX_FILE_BYTES or form is None:
            raise FileFormatError(
                f"{path}: is not an MRM-RET log (no Config or MrmFullScanInfo lines)", "Check the file."
            )
        survey = _Survey.of(stream, form)
        if not survey.scans_of:
            raise _no_scan(path, survey.unreadable + survey.incomplete, survey.example)
        chosen = choose_node(path, survey.scans_of, node)
        reading = _Reading.of(stream, form, chosen, survey.has_raw)
    if not reading.message_id:
        raise _no_scan(path, len(reading.lost_id), reading.example)
    config, windows = _fitting_config(survey, chosen, reading)
    scans = P440Scans(
        samples=np.frombuffer(reading.samples, np.int32).reshape(len(reading.message_id), -1),
        message_id=np.array(reading.message_id, dtype=np.int64),
        timestamp_ms=np.array(reading.timestamp_ms, dtype=np.int64),
        host_time_ns=None if None in reading.host_time_ns else np.array(reading.host_time_ns, dtype=np.int64),
        lost_id=np.array(reading.lost_id, dtype=np.int64),
        info=reading.info,
        config=RadarSettings.from_json(config),
    )
    counts = {
        "unreadable scan line": (survey.unreadable, ""),
        "filtered scan": (reading.filtered, " of the same radar"),
        "scan": (reading.other_grid, " with another window"),
    }
    ignored = [f"{counted(count, what)}{whose}" for what, (count, whose) in counts.items() if count]
    if scans.host_time_ns is None:
        ignored.append("the host's times, which are not in seconds since 1970")
    about = RadarInfo(
        source="mrm-ret",
        packets_ignored=sum(count for count, _ in counts.values()),
        ignored=tuple(ignored),
        bytes_left_over=survey.left_over,
        detection_lists=tuple(reading.detection_lists),
        **windows,
    )
    return p440_capture(path, scans, cable_delay_ps, about)


def _no_scan(path: Path, count: int, example: str) -> FileFormatError:
    if count:
        return FileFormatError(
            f"{path}: none of the log's {count} MrmFullScanInfo lines can be read; {example}",
            "Expected the vendor's columns and no others: time, MrmFullScanInfo, message id, source id, ..., "
            "samples as whole numbers.",
        )
    return FileFormatError(f"{path}: the log holds no MrmFullScanInfo line", "Log full scans in MRM-RET.")


@dataclass
class _Line:
    """A line of the log, except headings.

    Attributes:
        kind: its name, e.g. MrmFullScanInfo; "" if it has none.
        time: the cell before the name.
        body: the cells behind the name.
        length: bytes in the file.
        wraps: number of further lines that were joined to it.
        number: of the line in the file, from 1.
    """

    kind: str
    time: str
    body: str
    length: int
    wraps: int = 0
    number: int = 0

    @classmethod
    def of(cls, cells: str, length: int) -> _Line:
        # Data-frame libraries write an index in front, and dates and times take two columns.
        columns = cells.split(",", 5)
        for at, column in enumerate(columns[:5]):
            if kind := _KINDS.get(column.strip().lower()):
                return cls(kind, columns[at - 1].strip() if at else "", ",".join(columns[at + 1 :]), length)
        return cls("", "", cells, length)


def _lines(stream: BinaryIO, form: _Form) -> Iterator[_Line]:
    """Every line except headings; an overlong line is truncated, a wrapped scan line is joined."""
    stream.seek(0)
    text = io.TextIOWrapper(stream, form.encoding, "replace", newline="")
    wide = 2 if form.encoding.startswith("utf-16") else 1
    last: _Line | None = None
    number = 0
    try:
        while raw := text.readline(_LONGEST_LINE):
            length = len(raw)
            while not raw.endswith(("\n", "\r")) and (more := text.readline(_LONGEST_LINE)):
                length += len(more)
                if more.endswith(("\n", "\r")):
                    break
            line = _Line.of(form.cells(raw), length * wide)
            number += 1
            line.number = number
            heading = line.kind and line.body.lstrip()[:1].isalpha()
            if heading or line.time == "Timestamp" or not line.kind + line.body:
                continue
            if last is not None and not line.kind and _continues(last, line):
                joined = last.body.rstrip(", ") + "," + line.body.lstrip(", ")
                length = last.length + line.length
                last = _Line(
                    last.kind, last.time, joined[:_LONGEST_LINE], length, last.wraps + 1, last.number
                )
                continue
            if last is not None:
                yield last
            last = line
        if last is not None:
            yield last
    finally:
        text.detach()


def _continues(last: _Line, line: _Line) -> bool:
    """Whether a line holds further columns of an incomplete scan or configuration."""
    if last.wraps >= _MOST_WRAPS or _DECIMALS.fullmatch(line.body.strip(", \t")) is None:
        return False
    if last.kind == CONFIG:
        return last.body.count(",") + 1 < len(CONFIG_FIELDS)
    head = _Head.parse(last)
    return last.kind == SCAN and (head is None or not head.is_whole)


@dataclass
class _Survey:
    """Contents of the log, determined without storing a sample.

    Attributes:
        scans_of: radar -> its complete scan lines.
        has_raw: radars that have an unfiltered scan.
        configs: (number of scan lines before it, settings) of the Config lines.
        unreadable: scan lines with an invalid header.
        incomplete: scan lines with another number of samples than the header says.
        example: what is wrong with the first line of either.
        left_over: bytes of an incomplete last line.
    """

    scans_of: dict[int, int] = field(default_factory=dict)
    has_raw: set[int] = field(default_factory=set)
    configs: list[tuple[int, dict[str, Any]]] = field(default_factory=list)
    unreadable: int = 0
    incomplete: int = 0
    example: str = ""
    left_over: int = 0

    @classmethod
    def of(cls, stream: BinaryIO, form: _Form) -> _Survey:
        survey = cls()
        seen = 0
        for line in _lines(stream, form):
            survey.left_over = 0
            if line.kind == CONFIG and len(survey.configs) < _MOST_CONFIGS:
                config = _config(line.body)
                survey.configs += [(seen, config)] if config else []
            elif line.kind == SCAN:
                head = _Head.parse(line)
                if head is None:
                    survey.example = (
                        survey.example or f"line {line.number} begins {displayable(line.body[:60])!r}"
                    )
                    survey.unreadable += 1
                    survey.left_over = line.length
                elif not head.is_whole:
                    survey.example = (
                        survey.example
                        or f"line {line.number} has {head.columns} columns behind the name, "
                        f"not the {_HEAD_COLUMNS + head.total} of its {head.total} samples"
                    )
                    survey.incomplete += 1
                    survey.left_over = line.length
                elif head.node in survey.scans_of or len(survey.scans_of) < MAX_NODES:
                    seen += 1
                    survey.scans_of[head.node] = survey.scans_of.get(head.node, 0) + 1
                    if head.filter == RAW:
                        survey.has_raw.add(head.node)
            elif not line.kind:
                survey.left_over = line.length
        return survey


@dataclass
class _Reading:
    """The scans of one radar, in the order of the log and on the grid of the first one."""

    samples: bytearray = field(default_factory=bytearray)
    message_id: list[int] = field(default_factory=list)
    timestamp_ms: list[int] = field(default_factory=list)
    host_time_ns: list[int | None] = field(default_factory=list)
    lost_id: list[int] = field(default_factory=list)
    example: str = ""
    detection_lists: list[str] = field(default_factory=list)
    info: dict[str, Any] = field(default_factory=dict)
    filtered: int = 0
    other_grid: int = 0

    @classmethod
    def of(cls, stream: BinaryIO, form: _Form, node: int, has_raw: set[int]) -> _Reading:
        reading = cls()
        grid: tuple[int, ...] | None = None
        wanted = RAW if node in has_raw else None
        for line in _lines(stream, form):
            if line.kind == DETECTIONS and (text := _detections(line.body)):
                reading.detection_lists.append(text)
            head = _Head.parse(line) if line.kind == SCAN else None
            if head is None or head.node != node:
                continue
            samples = head.samples()
            if samples is None:
                reading.example = reading.example or (
                    f"line {line.number} has samples missing, or others than whole numbers"
                )
                reading.lost_id.append(head.message_id)
                continue
            wanted = head.filter if wanted is None else wanted
            if head.filter != wanted:
                reading.filtered += 1
                continue
            grid = grid or head.grid
            if head.grid != grid:
                reading.other_grid += 1
                continue
            reading.info = reading.info or head.info
            reading.samples += samples.tobytes()
            reading.message_id.append(head.message_id)
            reading.timestamp_ms.append(head.timestamp_ms)
            reading.host_time_ns.append(_nanoseconds(line.time))
        return reading


class _Head:
    """The columns of a scan line before its samples.

    Attributes:
        columns: number of columns behind the line's name.
        is_whole: whether the number of samples matches the header.
    """

    def __init__(self, values: list[int], body: str, columns: int) -> None:
        self._body, self._columns = body, columns
        self.node, self.filter = values[1], values[10]
        self.message_id, self.timestamp_ms = values[0] & 0xFFFF, values[2] & 0xFFFFFFFF
        self.total = values[13]
        self.columns = body.count(",") + 1
        self.is_whole = self.columns == columns + self.total
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
    def parse(cls, line: _Line) -> _Head | None:
        """The header of a scan line, or None if it cannot be read."""
        columns = line.body.split(",", _HEAD_COLUMNS)
        try:
            short = [_integer(c) for c in columns[:_BRIEF_COLUMNS]]
            values = [_integer(c) for c in columns[_BRIEF_COLUMNS:_HEAD_COLUMNS]]
        except (ValueError, OverflowError):
            return None
        full = brief = None
        if len(short) + len(values) == _HEAD_COLUMNS:
            full = cls(short + values, line.body, _HEAD_COLUMNS)
        if full and full.is_plausible() and full.is_whole:
            return full
        if len(short) == _BRIEF_COLUMNS and short[5] > 0:
            brief = cls([*short[:3], 0, 0, 0, 0, *short[3:8], 3, short[8]], line.body, _BRIEF_COLUMNS)
        if brief and brief.is_plausible() and brief.is_whole:
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

    def samples(self) -> np.ndarray[Any, np.dtype[np.int32]] | None:
        """(total,) int32 counts; None if the line is incomplete or contains anything but whole numbers."""
        columns = self._body.split(",", self._columns)
        if not self.is_whole or len(columns) <= self._columns:
            return None
        body = columns[-1].strip(" \t,")
        # Checked first: numpy's conversion of text that is not a number depends on its version.
        if _NUMBERS.fullmatch(body):
            values = np.fromstring(body, np.int64, sep=",")
        elif _DECIMALS.fullmatch(body):
            values = np.fromstring(body, np.float64, sep=",")
        else:
            return None
        limits = np.iinfo(np.int32)
        if len(values) != self.total or values.min() < limits.min or values.max() > limits.max:
            return None
        counts = values.astype(np.int32)
        return counts if np.array_equal(counts, values) else None


def _integer(cell: str) -> int:
    """A whole number of at most 12 characters, also written 123.0; int() would accept `1_000`, too.

    Raises ValueError.
    """
    text = cell.strip()
    if len(text) > 12 or not _DECIMALS.fullmatch(text) or "," in text:
        raise ValueError(cell[:20])
    number = float(text)
    if not number.is_integer():
        raise ValueError(cell[:20])
    return int(number)


def _nanoseconds(cell: str) -> int | None:
    """A time of the host as ns since 1970, from s, ms, us or ns; None if it is in another form.

    The vendor's program writes seconds with three decimals.
    """
    try:
        value = Decimal(cell) if len(cell) < 64 else Decimal("nan")
    except InvalidOperation:
        return None
    for unit in _SECOND:
        if value.is_finite() and _EARLIEST_S <= value / unit <= _LATEST_S:
            return int(value * (10**9 // unit))
    return None


def _config(body: str) -> dict[str, Any] | None:
    columns = body.split(",", len(CONFIG_FIELDS))
    try:
        values = [_integer(c) for c in columns[: len(CONFIG_FIELDS)]]
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


def _fitting_config(survey: _Survey, node: int, reading: _Reading) -> tuple[dict[str, Any], dict[str, Any]]:
    """The settings of the Config line for the scans, and what `RadarInfo` says of its window and theirs.

    Of a radar's Config lines before its scans, the last one whose window matches is used; otherwise the last
    one, whose window at least is stale.
    """
    actual = {name: reading.info[name] for name in WINDOW}
    one_radar = len(survey.scans_of) == 1
    configs = [(seen, c) for seen, c in survey.configs if c["node_id"] == node]
    if not configs and one_radar:
        configs = survey.configs
    before = [c for seen, c in configs if seen == 0] or [c for _, c in configs[:1]]
    if not before:
        return {}, {}
    fitting = [c for c in before if all(abs(c[name] - actual[name]) <= GRID_PS for name in WINDOW)]
    chosen = (fitting or before)[-1]
    windows = {
        "config_stale": not fitting,
        "window_requested_ps": tuple(chosen[name] for name in WINDOW),
        "window_actual_ps": tuple(actual.values()),
    }
    return {**chosen, **actual}, windows


def _detections(body: str) -> str | None:
    """A detection list as "message id: index magnitude, ..."; None if the line is not one."""
    columns = body.split(",", 2 + 2 * SAMPLES_PER_MESSAGE)
    try:
        message_id, count = _integer(columns[0]), _integer(columns[1])
        values = [_integer(c) for c in columns[2 : 2 + 2 * max(count, 0)]]
    except (ValueError, IndexError):
        return None
    if not 0 <= count <= SAMPLES_PER_MESSAGE or len(values) != 2 * count:
        return None
    pairs = (f"{values[i]} {values[i + 1]}" for i in range(0, len(values), 2))
    return f"{message_id}: " + ", ".join(pairs)
