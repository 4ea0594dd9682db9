"""Regroups SCAN_INFO fragments into scans by (id, timestamp), each scan once and in order.

UDP loses, repeats and reorders; counting packets would turn one lost packet into shifted data for the rest of
a recording. Here a lost packet costs its scan, which is counted, and nothing else.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tagid.radar.messages import (
    MAX_MESSAGES_PER_SCAN,
    MAX_SAMPLES_PER_SCAN,
    SAMPLES_PER_MESSAGE,
    Message,
)

WINDOW: Final = 8
"""Scans that may be overtaken by later ones before an unfinished scan is given up."""

MAX_PENDING: Final = 32
"""Unfinished scans kept at a time; bounds the memory that hostile fragments can take to about 1 MB."""


@dataclass(frozen=True, eq=False)
class Scan:
    """One complete scan.

    Attributes:
        scan_id: number of the scan, unwrapped past 65535; a gap is a lost scan.
        radar_time_ms: the radar's clock, whole ms since its boot, unwrapped past 2^32.
        host_time_ns: when its last fragment arrived, ns since the epoch.
        samples: (N,) int32, counts.
        scan_start_ps, scan_stop_ps: two-way time of the scan window, ps.
        antenna_id: the antenna mode it was taken with.
    """

    scan_id: int
    radar_time_ms: int
    host_time_ns: int
    samples: NDArray[np.int32]
    scan_start_ps: int
    scan_stop_ps: int
    antenna_id: int


@dataclass
class Statistics:
    """What happened on the wire, counted.

    Attributes:
        received: packets from the radar, malformed ones included.
        foreign: packets from another sender, dropped.
        malformed: packets that were no message, or a fragment that contradicts itself or its scan, dropped.
        unexpected: well-formed messages that nothing waited for (late confirms), dropped.
        duplicate: fragments that had arrived before, dropped.
        late: fragments of scans already given up, or of an earlier run, dropped.
        complete_scans: scans handed out.
        lost_scans: scans of which a fragment never came.
        retries: requests sent again because no answer came.
    """

    received: int = 0
    foreign: int = 0
    malformed: int = 0
    unexpected: int = 0
    duplicate: int = 0
    late: int = 0
    complete_scans: int = 0
    lost_scans: int = 0
    retries: int = 0


@dataclass(eq=False)
class _Partial:
    """Fragments of one scan so far."""

    layout: tuple[int, ...]
    samples: NDArray[np.int32]
    missing: set[int]
    scan: Scan | None = field(default=None)


def unwrap(value: int, reference: int, bits: int) -> int:
    """The number congruent to `value` modulo 2^bits that lies nearest to `reference`.

    >>> unwrap(2, 65_535, 16)
    65538
    """
    span = 1 << bits
    return reference + (value - reference + span // 2) % span - span // 2


class ScanAssembler:
    """Fragments in, complete scans out.

    Args:
        first_id: id of the run's first scan, which is that of the CONTROL request; None takes the first seen.
        statistics: counters to add to.
        clock_ns: host clock, ns since the epoch.
    """

    def __init__(
        self,
        first_id: int | None = None,
        statistics: Statistics | None = None,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.statistics = statistics or Statistics()
        self._clock_ns = clock_ns
        self._next = first_id
        self._time_reference: int | None = None
        self._pending: dict[tuple[int, int], _Partial] = {}
        self._ready: dict[int, Scan] = {}
        self.newest_id: int | None = None

    @property
    def next_id(self) -> int | None:
        """Unwrapped id of the scan that is waited for; None before the first fragment."""
        return self._next

    def add(self, message: Message) -> list[Scan]:
        """Takes one SCAN_INFO; returns the scans that are complete and in turn now (often none)."""
        layout = _checked_layout(message)
        if layout is None:
            self.statistics.malformed += 1
            return []
        if self._next is None:
            self._next = message.id
        scan_id = unwrap(message.id, self._next, 16)
        if scan_id < self._next:
            self.statistics.late += 1
            return []
        if scan_id in self._ready:
            self.statistics.duplicate += 1
            return []
        key = (scan_id, message["timestamp_ms"])
        partial = self._pending.get(key)
        if partial is None:
            if len(self._pending) >= MAX_PENDING:
                del self._pending[next(iter(self._pending))]
            total, count = layout[0], layout[1]
            partial = _Partial(layout, np.zeros(total, np.int32), set(range(count)))
            self._pending[key] = partial
        if partial.layout != layout:
            self.statistics.malformed += 1
            return []
        index = message["message_index"]
        if index not in partial.missing:
            self.statistics.duplicate += 1
            return []
        partial.missing.discard(index)
        start = index * SAMPLES_PER_MESSAGE
        stop = start + message["message_samples"]
        partial.samples[start:stop] = message["samples"][: stop - start]
        self.newest_id = scan_id if self.newest_id is None else max(self.newest_id, scan_id)
        if partial.missing:
            return []
        del self._pending[key]
        self._complete(key, partial)
        return self._in_turn(WINDOW)

    def flush(self) -> list[Scan]:
        """The complete scans still held back, in order; what is unfinished before them is lost."""
        return self._in_turn(0)

    def give_up_until(self, end_id: int) -> None:
        """Counts as lost every scan before `end_id` that has not been handed out: the run is over."""
        if self._next is not None and end_id > self._next:
            self.statistics.lost_scans += end_id - self._next
            self._next = end_id
            self._drop_old()

    def _complete(self, key: tuple[int, int], partial: _Partial) -> None:
        scan_id, timestamp = key
        reference = self._time_reference if self._time_reference is not None else timestamp
        radar_time = unwrap(timestamp, reference, 32)
        self._time_reference = max(radar_time, reference)
        partial.samples.flags.writeable = False
        _, _, scan_start, scan_stop, antenna = partial.layout
        self._ready[scan_id] = Scan(
            scan_id, radar_time, self._clock_ns(), partial.samples, scan_start, scan_stop, antenna
        )

    def _in_turn(self, window: int) -> list[Scan]:
        """Hands out what is next; an unfinished scan is lost once the scan `window` ids on is complete."""
        out: list[Scan] = []
        while self._ready and self._next is not None:
            if self._next not in self._ready:
                if max(self._ready) - self._next < window:
                    break
                first = min(self._ready)
                # Within the window the ids before `first` may still come, as far as they are young enough.
                lost_until = min(first, max(self._ready) - window + 1) if window else first
                self.statistics.lost_scans += lost_until - self._next
                self._next = lost_until
                self._drop_old()
                continue
            out.append(self._ready.pop(self._next))
            self._next += 1
        self.statistics.complete_scans += len(out)
        if out:
            self._drop_old()
        return out

    def _drop_old(self) -> None:
        if self._next is not None:
            for key in [k for k in self._pending if k[0] < self._next]:
                del self._pending[key]


def _checked_layout(message: Message) -> tuple[int, ...] | None:
    """(samples, messages, start, stop, antenna) of a fragment, or None where its numbers disagree."""
    total, count = message["total_samples"], message["message_count"]
    index, here = message["message_index"], message["message_samples"]
    if not (1 <= total <= MAX_SAMPLES_PER_SCAN and 1 <= count <= MAX_MESSAGES_PER_SCAN):
        return None
    if count != -(-total // SAMPLES_PER_MESSAGE) or index >= count:
        return None
    if here != min(SAMPLES_PER_MESSAGE, total - index * SAMPLES_PER_MESSAGE):
        return None
    return total, count, message["scan_start_ps"], message["scan_stop_ps"], message["antenna_id"]
