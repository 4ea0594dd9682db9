"""Regroups SCAN_INFO fragments into scans by (id, timestamp), each scan once and in order.

UDP loses, repeats and reorders packets. If packets were merely counted, one lost packet would shift the data
for the rest of a recording. Here a lost packet loses only its scan, which is counted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tagid import hostclock
from tagid.radar.messages import SAMPLES_PER_MESSAGE
from tagid.radar.scan_info import Fragment

WINDOW: Final = 8
"""Number of later scans that may always arrive before an incomplete scan is declared lost."""

HOLD_MS: Final = 100
"""How long later scans wait for an incomplete one, ms of radar time: twice the 50 ms by which a network may
delay a packet. At 1000 scans/s this is 100 scans; at 7 scans/s the minimum of `REORDER_WINDOW` applies."""

MAX_PENDING: Final = 512
"""Maximum number of incomplete scans kept; limits the memory used by forged fragments to 17 MB."""

MAX_READY: Final = 512
"""Maximum number of complete scans held back."""

_SLACK_SCANS: Final = 64


@dataclass(frozen=True, eq=False)
class Scan:
    """One complete scan.

    Attributes:
        scan_id: number of the scan, unwrapped past 65535; a gap is a lost scan.
        radar_time_ms: the radar's clock, whole ms since its boot, unwrapped past 2^32.
        host_time_ns: arrival time of its last fragment, ns since the epoch.
        samples: (N,) int32, counts.
        scan_start_ps, scan_stop_ps: two-way time of the scan window, ps.
        antenna_id: the antenna mode used.
        node_id: the radar's node number.
    """

    scan_id: int
    radar_time_ms: int
    host_time_ns: int
    samples: NDArray[np.int32]
    scan_start_ps: int
    scan_stop_ps: int
    antenna_id: int
    node_id: int = 0


@dataclass
class Statistics:
    """Counters of a connection.

    Attributes:
        received: packets from the radar, including malformed ones.
        foreign: packets from other senders, dropped.
        malformed: packets that are not a message, or fragments that contradict themselves, their scan or the
            clock, dropped.
        unexpected: well-formed messages that no request was waiting for (late confirms), dropped.
        duplicate: fragments that had already arrived, dropped.
        late: fragments of scans already declared lost, or of an earlier run, dropped.
        complete_scans: scans returned.
        lost_scans: scans with a missing fragment.
        retries: requests repeated because no answer arrived.
        skipped_bytes: bytes on a serial line outside any frame.
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
    skipped_bytes: int = 0


class _Partial:
    """The fragments of one scan received so far."""

    __slots__ = ("layout", "missing", "samples")

    def __init__(self, layout: tuple[int, ...]) -> None:
        self.layout = layout
        self.samples = np.zeros(layout[0], np.int32)
        self.missing = set(range(layout[1]))


def unwrap(value: int, reference: int, bits: int) -> int:
    """The number congruent to `value` modulo 2^bits that is nearest to `reference`.

    >>> unwrap(2, 65_535, 16)
    65538
    """
    span = 1 << bits
    return reference + (value - reference + span // 2) % span - span // 2


class ScanAssembler:
    """Reassembles fragments into complete scans.

    Args:
        first_id: id of the first scan, equal to that of the CONTROL request; None uses the first one seen.
        statistics: counters to update.
        clock_ns: host clock, ns since the epoch.
        period_s: shortest time between scans, s. If given, an id ahead of the radar's clock counts as
            damaged, so it cannot make all the valid scans that follow appear late.

    Attributes:
        next_id: unwrapped id of the next scan expected; None before the first fragment.
        newest_id: unwrapped id of the newest fragment; None before the first.
        whole_scans: number of complete scans, including those still held back.
    """

    def __init__(
        self,
        first_id: int | None = None,
        statistics: Statistics | None = None,
        clock_ns: Callable[[], int] = hostclock.now_ns,
        period_s: float | None = None,
    ) -> None:
        self.statistics = statistics or Statistics()
        self._clock_ns = clock_ns
        self._period_ms = period_s * 1e3 if period_s else None
        self.next_id = first_id
        self._start: tuple[int, int] | None = None
        self._time_reference: int | None = None
        self._pending: dict[tuple[int, int], _Partial] = {}
        self._ready: dict[int, Scan] = {}
        self._newest_ready = -1
        self.whole_scans = 0
        self.newest_id: int | None = None

    def add(self, fragment: Fragment) -> list[Scan]:
        """Process one fragment; return the scans that are now complete and next in order (often none)."""
        if self.next_id is None:
            self.next_id = fragment.id
        scan_id = unwrap(fragment.id, self.next_id, 16)
        if scan_id < self.next_id:
            self.statistics.late += 1
            return []
        if scan_id in self._ready:
            self.statistics.duplicate += 1
            return []
        if not self._plausible(scan_id, fragment.timestamp_ms):
            self.statistics.malformed += 1
            return []
        partial = self._partial((scan_id, fragment.timestamp_ms), fragment.layout)
        if partial.layout != fragment.layout:
            self.statistics.malformed += 1
            return []
        if fragment.part not in partial.missing:
            self.statistics.duplicate += 1
            return []
        partial.missing.discard(fragment.part)
        start = fragment.part * SAMPLES_PER_MESSAGE
        partial.samples[start : start + len(fragment.samples)] = fragment.samples
        self.newest_id = scan_id if self.newest_id is None else max(self.newest_id, scan_id)
        if partial.missing:
            return []
        self._complete(scan_id, fragment.timestamp_ms, partial)
        return self._in_turn(held=True)

    def flush(self) -> list[Scan]:
        """The complete scans still held back, in order; incomplete scans before them are counted as lost."""
        return self._in_turn(held=False)

    def give_up_until(self, end_id: int) -> None:
        """End the run: count every scan before `end_id` that has not been returned as lost."""
        if self.next_id is not None and end_id > self.next_id:
            self._lose_until(end_id)

    def _plausible(self, scan_id: int, timestamp_ms: int) -> bool:
        """Whether the radar can have reached this id by now; always true for late packets."""
        if self._period_ms is None:
            return True
        if self._start is None:
            self._start = (self.next_id or 0, timestamp_ms)
        first_id, first_ms = self._start
        elapsed_ms = (timestamp_ms - first_ms + 2**31) % 2**32 - 2**31
        most = first_id + _SLACK_SCANS + 2 * max(elapsed_ms, 0) / self._period_ms
        return elapsed_ms < 0 or scan_id <= most

    def _partial(self, key: tuple[int, int], layout: tuple[int, ...]) -> _Partial:
        partial = self._pending.get(key)
        if partial is None:
            if len(self._pending) >= MAX_PENDING:
                del self._pending[next(iter(self._pending))]
            self._pending[key] = partial = _Partial(layout)
        return partial

    def _complete(self, scan_id: int, timestamp_ms: int, partial: _Partial) -> None:
        del self._pending[scan_id, timestamp_ms]
        self.whole_scans += 1
        reference = self._time_reference if self._time_reference is not None else timestamp_ms
        radar_time = unwrap(timestamp_ms, reference, 32)
        self._time_reference = max(radar_time, reference)
        partial.samples.flags.writeable = False
        _, _, scan_start, scan_stop, antenna, node = partial.layout
        self._ready[scan_id] = Scan(
            scan_id, radar_time, self._clock_ns(), partial.samples, scan_start, scan_stop, antenna, node
        )
        self._newest_ready = max(self._newest_ready, scan_id)

    def _in_turn(self, held: bool) -> list[Scan]:
        """The next scans in order; with `held`, only those that need not wait for an incomplete one."""
        out: list[Scan] = []
        while self._ready and self.next_id is not None:
            scan = self._ready.pop(self.next_id, None)
            if scan is not None:
                out.append(scan)
                self.next_id += 1
                continue
            until = self._given_up() if held else min(self._ready)
            if until is None:
                break
            self._lose_until(until)
        self.statistics.complete_scans += len(out)
        return out

    def _given_up(self) -> int | None:
        """Id below which missing scans are declared lost now; None while they may still arrive."""
        first = min(self._ready)
        if len(self._ready) >= MAX_READY:
            return first
        newest = self._ready[self._newest_ready]
        if newest.scan_id - (self.next_id or 0) < WINDOW:
            return None
        # The missing scans left the radar before `first` did.
        if newest.radar_time_ms - self._ready[first].radar_time_ms < HOLD_MS:
            return None
        return min(first, newest.scan_id - WINDOW + 1)

    def _lose_until(self, scan_id: int) -> None:
        assert self.next_id is not None
        self.statistics.lost_scans += scan_id - self.next_id
        self.next_id = scan_id
        for key in [k for k in self._pending if k[0] < scan_id]:
            del self._pending[key]
