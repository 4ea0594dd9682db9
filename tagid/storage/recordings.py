"""Reads the recordings of other P440 tools into captures and writes `.prd`/`.out` files back byte for byte.

Such a file is the 32-byte CONFIG block followed by the 1452-byte SCAN_INFO messages as received;
it may end in the middle of a message (P440 MRM API; public recordings). Other tools store the same messages
after a whole confirm, in frames, with prefixes or among other messages: the messages are searched.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from tagid import files
from tagid.capture import Capture
from tagid.constants import BINS_PER_SAMPLE, SPEED_OF_LIGHT
from tagid.counting import counted
from tagid.errors import DataError, FileFormatError, UsageError
from tagid.metadata import RadarInfo, RadarSettings
from tagid.radar.messages import (
    CONFIG_DTYPE,
    HEADER_DTYPE,
    MAX_MESSAGES_PER_SCAN,
    MAX_SAMPLES_PER_SCAN,
    MESSAGES,
    SAMPLES_PER_MESSAGE,
    SCAN_INFO_DTYPE,
    MessageType,
)
from tagid.storage.p440 import GRID_PS, MAX_NODES, RAW, WINDOW, P440Scans, choose_node, p440_capture

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
HEAD_BYTES = _HEAD_DTYPE.itemsize
_ORDERS = (">", "<")
"""Byte orders: that of the wire, and that of a program that stored the fields as its own numbers."""
_INTEGRATION = range(6, 16)
"""Base integration indexes of a P440 (MRM API)."""
_MOST_COUNTS = 1 << 23
"""Larger than a typical sample of any scan; a small one of the other byte order is larger still."""
_PROBE, _SURE = 64, 192
"""Scans that are looked at, and the fewest samples that tell."""
_BLOCK_BYTES = 1 << 18
_MOST_MESSAGES = files.MAX_FILE_BYTES // SCAN_INFO_DTYPE.itemsize
_RESYNC_BYTES = 64
"""Bytes searched for the next message of another type: more noise contains random types."""
_MOST_GAP_BYTES = 1 << 20
"""Bytes between the messages that are looked at; more are only counted."""


def is_recording(stream: BinaryIO) -> bool:
    """Whether a file holds the consistent header of a SCAN_INFO message, wherever it is."""
    for order in _ORDERS:
        stream.seek(0)
        if any(len(offsets) for offsets, _ in _search(stream, order)):
            return True
    return False


def read_recording(path: Path, cable_delay_ps: float = 0.0, node: int | None = None) -> Capture:
    """Read the scans of a file that holds SCAN_INFO messages, whatever lies before, between and after them.

    The file is read in parts, which needs little more memory than the samples. Fragments are regrouped by
    (id, timestamp), so a lost or cut one costs only its scan. Where raw and filtered scans are recorded, the
    raw ones are used. `radar` contains `config` (empty where the file holds none) and `scan_info` (the fields
    needed to write the file again), `scans_lost`, `packets_ignored` and `ignored` (messages that are no scan
    of this radar, and other bytes) and `bytes_left_over` (a truncated last message).

    Arguments as `tagid.storage.importers.read_any`.

    Raises:
        StorageError: the file cannot be read.
        FileFormatError: no SCAN_INFO message, or no complete scan.
        UsageError: several radars and no `node`, or no scan of that one.
    """
    with files.open_regular(path) as (stream, size):
        if size > files.MAX_FILE_BYTES:
            raise FileFormatError(
                f"{path}: has {size} bytes, more than the {files.MAX_FILE_BYTES} of a P440 recording",
                "Record in parts.",
            )
        messages = _Messages.of(path, stream, size)
        heads, valid = messages.heads, messages.whole.copy()
        ignored = _Ignored(messages)
        numbers, packets_of = np.unique(heads["node_id"][valid], return_counts=True)
        held = dict(zip(numbers[:MAX_NODES].tolist(), packets_of[:MAX_NODES].tolist(), strict=True))
        if not held:
            raise FileFormatError(f"{path}: every SCAN_INFO message is cut", "Record again.")
        valid = ignored.keep(
            valid, heads["node_id"] == choose_node(path, held, node), "message", "of other radars"
        )
        raw = valid & (heads["filter"] == RAW)
        kept_filter = RAW if raw.any() else heads["filter"][valid.argmax()]
        valid = ignored.keep(valid, heads["filter"] == kept_filter, "filtered message", "of the same radar")
        first = heads[int(valid.argmax())]
        same_grid = np.logical_and.reduce([heads[name] == first[name] for name in _GRID])
        valid = ignored.keep(valid, same_grid, "message", "of scans with another window")
        complete, partial, repeated = _regroup(heads, np.flatnonzero(valid))
        ignored.add("message|stored again", repeated)
        if not complete:
            raise FileFormatError(
                f"{path}: holds no complete scan", "The recording is truncated or mostly lost."
            )
        rows = np.array(complete)
        samples = _read_samples(stream, messages, rows)
        config = _read_gaps(stream, messages, heads[rows[0, 0]], ignored)
    scans = P440Scans(
        samples=samples,
        message_id=heads["id"][rows[:, 0]].astype(np.int64),
        timestamp_ms=heads["timestamp_ms"][rows[:, 0]].astype(np.int64),
        host_time_ns=None,
        lost_id=np.array(partial, dtype=np.int64),
        info=_plain(heads[rows[0, 0]], _PER_SCAN),
        config=RadarSettings.from_json(config),
    )
    about = RadarInfo(
        source="recording",
        packets_ignored=ignored.count,
        ignored=ignored.notes(),
        bytes_left_over=messages.left_over,
    )
    return p440_capture(path, scans, cable_delay_ps, about)


@dataclass(frozen=True, eq=False)
class _Messages:
    """The SCAN_INFO messages of a file, in its order.

    Attributes:
        order: byte order of the fields: ">" as on the wire, "<" where a program stored them as its own.
        offset: (n,) int64 position in the file, bytes.
        end: (n,) int64 position after the message or, where it is cut, after what there is of it.
        heads: (n,) their headers.
        whole: (n,) bool, whether all samples are there.
        size: of the file, bytes.
        left_over: bytes of a truncated last message.
    """

    order: str
    offset: NDArray[np.int64]
    end: NDArray[np.int64]
    heads: NDArray[np.void]
    whole: NDArray[np.bool_]
    size: int
    left_over: int

    @classmethod
    def of(cls, path: Path, stream: BinaryIO, size: int) -> _Messages:
        """Search a file. Raises FileFormatError if it holds none."""
        for order in _ORDERS:
            stream.seek(0)
            blocks = list(_search(stream, order))
            offset = np.concatenate([np.zeros(0, np.int64), *(offsets for offsets, _ in blocks)])
            if len(offset):
                heads = np.concatenate([head for _, head in blocks])
                break
        else:
            raise FileFormatError(
                f"{path}: holds no SCAN_INFO message of a P440",
                "Expected messages as received from the radar.",
            )
        # A P440 pads the last message of a scan to the length of the others; some programs do not store that.
        room = np.diff(np.append(offset, size))
        needed = HEAD_BYTES + 4 * heads["message_samples"].astype(np.int64)
        whole = room >= needed
        if not (whole & (room < SCAN_INFO_DTYPE.itemsize))[:-1].any():
            whole[-1] = room[-1] >= SCAN_INFO_DTYPE.itemsize
        end = offset + np.minimum(room, SCAN_INFO_DTYPE.itemsize)
        left_over = 0 if whole[-1] else size - int(offset[-1])
        if whole[-1] and 0 < size - end[-1] < SCAN_INFO_DTYPE.itemsize:
            stream.seek(int(end[-1]))
            tail = stream.read(2)
            if _type_bytes(order).startswith(tail):
                left_over = size - int(end[-1])
        return cls(order, offset, end, heads, whole, size, left_over)

    def gaps(self) -> Iterator[tuple[int, int]]:
        """(start, end) of the bytes of the file that are no SCAN_INFO message."""
        starts = np.concatenate([[0], self.end])
        ends = np.append(self.offset, max(self.size - self.left_over, int(self.end[-1])))
        for i in np.flatnonzero(ends > starts):
            yield int(starts[i]), int(ends[i])


def _type_bytes(order: str) -> bytes:
    return np.array(int(MessageType.SCAN_INFO), f"{order}u2").tobytes()


def _search(stream: BinaryIO, order: str) -> Iterator[tuple[NDArray[np.int64], NDArray[np.void]]]:
    """Positions and headers of the SCAN_INFO messages in a byte stream, block by block.

    Noise does not pass: type, counts and lengths of a header agree at random once in 2^90 bytes. Cut messages
    are among them; a message begins inside another one only where that is cut.
    """
    dtype = _HEAD_DTYPE.newbyteorder(order)  # type: ignore[arg-type]
    first, second = _type_bytes(order)
    total_at = SCAN_INFO_DTYPE.fields["total_samples"][1]  # type: ignore[index]
    high = total_at + np.array([0, 1] if order == ">" else [2, 3])
    base, tail, count = 0, b"", 0
    while block := stream.read(_BLOCK_BYTES):
        data = np.frombuffer(tail + block, np.uint8)
        searched = max(0, len(data) - HEAD_BYTES + 1)
        at = np.flatnonzero((data[:searched] == first) & (data[1 : searched + 1] == second))
        at = at[(data[at[:, None] + high] == 0).all(axis=1)]
        candidates = data[at[:, None] + np.arange(HEAD_BYTES)].view(dtype).reshape(-1)
        valid = _valid(candidates)
        count += int(valid.sum())
        if count > _MOST_MESSAGES:
            raise FileFormatError(f"more than {_MOST_MESSAGES} SCAN_INFO messages, which is not plausible")
        yield base + at[valid], candidates[valid]
        tail = data[searched:].tobytes()
        base += searched


def _read_samples(stream: BinaryIO, messages: _Messages, rows: NDArray[np.int64]) -> NDArray[np.int32]:
    """(views, bins) counts of the scans whose messages are at `rows`; 0 where the file has shrunk."""
    total = int(messages.heads["total_samples"][rows[0, 0]])
    samples: NDArray[np.int32] = np.zeros((len(rows), total), dtype=np.int32)
    for scan, parts in enumerate(messages.offset[rows].tolist()):
        for part, offset in enumerate(parts):
            start = part * SAMPLES_PER_MESSAGE
            width = min(SAMPLES_PER_MESSAGE, total - start)
            stream.seek(offset + HEAD_BYTES)
            data = stream.read(4 * width)
            values = np.frombuffer(data, f"{messages.order}i4", len(data) // 4)
            samples[scan, start : start + len(values)] = values
    # Some programs convert the header to their own byte order, but not the samples, or the reverse.
    probe = samples[:_PROBE]
    if probe.size >= _SURE and _typical(probe) > _MOST_COUNTS >= _typical(probe.byteswap()):
        samples.byteswap(inplace=True)
    return samples


def _typical(samples: NDArray[np.int32]) -> float:
    return float(np.median(np.abs(samples.astype(np.int64))))


class _Ignored:
    """What of a file is no scan of the recording."""

    def __init__(self, messages: _Messages) -> None:
        self._counts: dict[str, int] = {}
        self._bytes = 0
        self._first = 0
        last = messages.left_over and not messages.whole[-1]
        self.add("cut message", int(np.count_nonzero(~messages.whole)) - bool(last))

    @property
    def count(self) -> int:
        return sum(self._counts.values())

    def keep(
        self, valid: NDArray[np.bool_], kept: NDArray[np.bool_], what: str, whose: str
    ) -> NDArray[np.bool_]:
        """Those of `valid` that are `kept`; the others are counted as `what`."""
        self.add(f"{what}|{whose}", int(np.count_nonzero(valid & ~kept)))
        both: NDArray[np.bool_] = valid & kept
        return both

    def add(self, what: str, count: int) -> None:
        """Count messages of a kind, a noun with what follows it behind a bar."""
        if count:
            self._counts[what] = self._counts.get(what, 0) + count

    def add_gap(self, data: bytes, start: int, order: str) -> None:
        """Count the messages of other types in the bytes at `start`, and the bytes of none."""
        at = unknown = 0
        while at < len(data) and unknown < _RESYNC_BYTES:
            number = int.from_bytes(data[at : at + 2], "big" if order == ">" else "little")
            sizes = MESSAGES[number].sizes if number in MESSAGES else ()
            # A type and an id alone are found in any noise.
            fitting = [size for size in sizes if HEADER_DTYPE.itemsize < size <= len(data) - at]
            size = max(fitting, default=0)
            if size:
                name = "damaged SCAN_INFO" if number == MessageType.SCAN_INFO else MESSAGES[number].name
                self.add(f"{name} message", 1)
                at, unknown = at + size, 0
            else:
                self.add_bytes(1, start + at)
                at, unknown = at + 1, unknown + 1
        if at < len(data):
            self.add_bytes(len(data) - at, start + at)

    def add_bytes(self, count: int, start: int) -> None:
        """Count bytes at `start` that are of no message."""
        self._first = self._first if self._bytes else start
        self._bytes += count

    def notes(self) -> tuple[str, ...]:
        """What is ignored, a phrase each."""
        phrases = []
        for what, number in self._counts.items():
            noun, _, whose = what.partition("|")
            phrases.append(f"{counted(number, noun)} {whose}".rstrip())
        if self._bytes:
            phrases.append(f"{counted(self._bytes, 'byte')} of no message, the first at byte {self._first}")
        return tuple(phrases)


def _read_gaps(stream: BinaryIO, messages: _Messages, head: np.void, ignored: _Ignored) -> dict[str, Any]:
    """The configuration in the bytes between the messages ({} if none); the rest of them is counted.

    A recording usually begins with the bare block, which is believed even if it is stale. Otherwise it is in
    a request or confirm, or in what another program wrote: it has the node and the window of the scans.
    """
    config: dict[str, Any] = {}
    budget = _MOST_GAP_BYTES
    for start, end in messages.gaps():
        stream.seek(start)
        data = stream.read(min(end - start, budget))
        budget -= len(data)
        if end - start > len(data):
            ignored.add_bytes(end - start - len(data), start + len(data))
        order = messages.order
        if start == 0 and end == CONFIG_DTYPE.itemsize:
            order = _order_of_block(data, order, head)
            at = 0 if order else -1
        else:
            at = -1 if config else _find_config(data, order, head)
        if at < 0:
            ignored.add_gap(data, start, messages.order)
            continue
        block = data[at : at + CONFIG_DTYPE.itemsize]
        dtype = CONFIG_DTYPE.newbyteorder(order)  # type: ignore[arg-type]
        config = _plain(np.frombuffer(block, dtype, 1)[0], _CONFIG_NAMES)
        before, after = _around_config(data, at, messages.order)
        ignored.add_gap(data[:before], start, messages.order)
        ignored.add_gap(data[after:], start + after, messages.order)
    return config


def _order_of_block(data: bytes, order: str, head: np.void) -> str:
    """Byte order of a bare configuration block, `order` if that fits; "" if the bytes are none."""
    for candidate in (order, *_ORDERS):
        block = np.frombuffer(data, CONFIG_DTYPE.newbyteorder(candidate), 1)[0]  # type: ignore[arg-type]
        # A program that does not know the integration writes 0, and the window of the scans.
        known = block["base_integration_index"] in _INTEGRATION
        if known or all(abs(int(block[name]) - int(head[name])) <= GRID_PS for name in WINDOW):
            return candidate
    return ""


def _find_config(data: bytes, order: str, head: np.void) -> int:
    """Position of the configuration of these scans in the bytes; -1 if there is none."""
    size = CONFIG_DTYPE.itemsize
    if len(data) < size:
        return -1
    windows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(data, np.uint8), size)
    # The fields at the head of the block first: a copy of all windows would take 32 times the bytes.
    wanted = np.array([head["node_id"]], f"{order}u4").view(np.uint8)
    at = np.flatnonzero((windows[:, : len(wanted)] == wanted).all(axis=1))
    blocks = np.ascontiguousarray(windows[at]).view(CONFIG_DTYPE.newbyteorder(order)).reshape(-1)  # type: ignore[arg-type]
    fits = np.isin(blocks["base_integration_index"], _INTEGRATION)
    for name in WINDOW:
        fits &= np.abs(blocks[name].astype(np.int64) - int(head[name])) <= GRID_PS
    return int(at[fits][-1]) if fits.any() else -1


def _around_config(data: bytes, at: int, order: str) -> tuple[int, int]:
    """Start and end of the message that holds the configuration at `at`, or of the bare block."""
    end = at + CONFIG_DTYPE.itemsize
    head = HEADER_DTYPE.itemsize
    number = int.from_bytes(data[max(at - head, 0) : at][:2], "big" if order == ">" else "little")
    if at >= head and number in (MessageType.GET_CONFIG_CONFIRM, MessageType.SET_CONFIG_REQUEST):
        size = MESSAGES[number].dtype.itemsize
        return at - head, min(at - head + size, len(data))
    return at, end


def encode_recording(capture: Capture) -> bytes:
    """The bytes of a `.prd`/`.out` recording; one read from such a file is restored byte for byte.

    Raises:
        UsageError: the samples are not int32 counts, the only type that the format supports.
        DataError: too many bins, or settings that do not fit the format.
    """
    check_counts(capture, "a P440 recording")
    views, bins = capture.samples.shape
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
    remaining = bins - SAMPLES_PER_MESSAGE * np.arange(messages)
    packets["message_samples"] = np.minimum(SAMPLES_PER_MESSAGE, remaining)
    padded = np.zeros((views, messages * SAMPLES_PER_MESSAGE), dtype=">i4")
    padded[:, :bins] = capture.samples
    packets["samples"] = padded.reshape(views, messages, SAMPLES_PER_MESSAGE)
    block = np.zeros(1, dtype=CONFIG_DTYPE)
    _fill(block, config)
    return block.tobytes() + packets.tobytes()


def _valid(packets: NDArray[np.void]) -> NDArray[np.bool_]:
    """Which packets are fragments with consistent fields."""
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


def _regroup(heads: NDArray[np.void], rows: NDArray[np.intp]) -> tuple[list[list[int]], list[int], int]:
    """Rows of the fragments of each complete scan, the ids of the others, and the number of repetitions.

    The scans are in the order of their first fragments.
    """
    groups: dict[tuple[int, int, int], dict[int, int]] = {}
    columns = [heads[name][rows] for name in ("id", "timestamp_ms", "message_index")]
    count = int(heads["message_count"][rows[0]])
    # A program that numbers nothing: the scans follow one another.
    numbered = len(rows) <= count or bool(np.ptp(columns[0].astype(np.int64)))
    place = np.zeros(len(rows), np.int64)
    if not numbered:
        place = np.cumsum(np.diff(columns[2].astype(np.int64), prepend=0) <= 0)
    for row, scan, timestamp, index, at in zip(
        rows.tolist(), *(column.tolist() for column in columns), place.tolist(), strict=True
    ):
        groups.setdefault((scan, timestamp, at), {}).setdefault(index, row)
    complete = [[g[i] for i in range(count)] for g in groups.values() if len(g) == count]
    used = sum(map(len, groups.values()))
    return complete, [key[0] for key, g in groups.items() if len(g) < count], len(rows) - used


def check_counts(capture: Capture, form: str) -> None:
    """Raises UsageError for samples that are no int32 counts, DataError for more than a P440 scan has."""
    if capture.samples.dtype != np.int32:
        raise UsageError(
            f"the capture holds {capture.samples.dtype} samples, {form} holds int32 counts only",
            "Export to .npz, .mat or .h5 instead.",
        )
    if capture.bins > MAX_SAMPLES_PER_SCAN:
        raise DataError(
            f"the capture has {capture.bins} bins, a P440 scan has at most {MAX_SAMPLES_PER_SCAN}"
        )


def wire_settings(capture: Capture) -> tuple[dict[str, Any], dict[str, Any]]:
    """Header and configuration fields: those of the recording, or values derived from the capture's grid."""
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
        "the capture has no times, a P440 recording needs one per scan", "Export to .npz instead."
    )


def _plain(record: np.void, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: record[name].tolist() for name in names}
