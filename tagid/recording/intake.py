"""Scans from the radar into the journal, in constant memory; losses, gaps and dropped scans are counted.

Every command that records uses this module, so that a loss, a gap or a slow disk is reported the same way.
"""

from __future__ import annotations

import math
import stat
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Final

from tagid.capture import ViewFlag
from tagid.errors import StorageError
from tagid.metadata import Ending, RadarInfo, ScanGap
from tagid.radar.assembler import Scan
from tagid.radar.messages import SCAN_FOREVER
from tagid.radar.p440 import P440
from tagid.radar.resume import RESUME_S, steady_scans
from tagid.storage.journal import JournalScan
from tagid.storage.journal_queue import JournalQueue

_MOST_GAPS: Final = 1000
"""Maximum number of gaps described individually; all are counted."""

_HOST_SLACK_S: Final = 1.0
"""Delay after the radar's clock at which the host's clock ends a recording, s: transport takes time."""
_GUARD_EVERY_S: Final = 0.5


def host_limit(seconds: float | None) -> Callable[[], bool]:
    """Whether a time and a second of slack have passed on the host's clock; None: never.

    For a radar whose own clock or scans have stopped.
    """
    end = math.inf if seconds is None else time.monotonic() + seconds + _HOST_SLACK_S
    return lambda: time.monotonic() >= end


class Intake:
    """One recording's scans, from a connected radar, for which it waits `resume_s` at most if it is lost.

    Attributes:
        scans_taken: number of scans put into the queue.
        gap_count: number of times the radar was lost.
        gaps: the first 1000 gaps.
        ended: why the recording ended; set by the one who takes the scans.
    """

    def __init__(
        self,
        radar: P440,
        queue: JournalQueue,
        resume_s: float = RESUME_S,
        on_gap: Callable[[ScanGap], None] = lambda gap: None,
    ) -> None:
        self.scans_taken = 0
        self.gap_count = 0
        self.gaps: list[ScanGap] = []
        self.ended: Ending | None = None
        self._radar = radar
        self._queue = queue
        self._resume_s = resume_s
        self._on_gap = on_gap
        self._guard_at = 0.0

    @property
    def scans_lost(self) -> int:
        """Number of lost or incomplete scans."""
        return self._radar.statistics.lost_scans

    def scans(
        self,
        count: int = SCAN_FOREVER,
        interval_us: int = 0,
        until: Callable[[], bool] = lambda: False,
    ) -> Iterator[Scan]:
        """The scans of a run, each put into the journal's queue before it is yielded; dropped scans are not.

        `until` is called about ten times per second, also while no scan arrives; True ends the run. Raises
        the errors of `steady_scans` and `JournalQueue.put`.
        """
        clip = self._radar.config.clip_counts
        last_id: int | None = None
        gaps_before = self.gap_count

        def ends() -> bool:
            self._queue.check()
            self._check_journal()
            return until()

        for scan in steady_scans(self._radar, count, interval_us, self._resume_s, self._gap, ends):
            flags = ViewFlag.NONE
            if int(scan.samples.max()) >= clip or int(scan.samples.min()) <= -clip:
                flags |= ViewFlag.CLIPPED
            if last_id is None:
                flags |= ViewFlag.FIRST
            elif scan.scan_id != last_id + 1:
                flags |= ViewFlag.AFTER_LOSS
            if self.gap_count != gaps_before:
                flags |= ViewFlag.AFTER_GAP
            item = JournalScan(
                scan.scan_id, scan.host_time_ns, float(scan.radar_time_ms), int(flags), scan.samples
            )
            if not self._queue.put(item):
                continue
            last_id, gaps_before = scan.scan_id, self.gap_count
            self.scans_taken += 1
            yield scan

    def counted(self) -> RadarInfo:
        """The counters of this recording."""
        statistics = asdict(self._radar.statistics)
        return RadarInfo(
            statistics=statistics,
            scans_lost=statistics["lost_scans"],
            scans_dropped=self._queue.dropped,
            gap_count=self.gap_count,
            gaps=tuple(self.gaps),
            ended=self.ended,
        )

    def _check_journal(self) -> None:
        """Raises StorageError if the journal's file was removed, replaced or cut; looks twice a second."""
        if time.monotonic() < self._guard_at:
            return
        self._guard_at = time.monotonic() + _GUARD_EVERY_S
        path, written = self._queue.journal.path, self._queue.journal.size
        try:
            there = path.stat()
        except OSError:
            lost = "vanished"
        else:
            if not stat.S_ISREG(there.st_mode) or there.st_size >= written:
                return
            lost = f"shrank to {there.st_size} of {written} bytes"
        raise StorageError(
            f"{path} {lost} while it was recorded to",
            "Check the folder and its disk (was it deleted, moved or unmounted?), then record again.",
        )

    def _gap(self, gap: ScanGap) -> None:
        self.gap_count += 1
        if len(self.gaps) < _MOST_GAPS:
            self.gaps.append(gap)
        self._on_gap(gap)
