"""Passes scans from the radar to the journal and records all losses, in constant memory.

All recording commands use it, so that losses, gaps and slow disks are reported in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from typing import Final

from tagid.capture import ViewFlag
from tagid.metadata import RadarInfo, ScanGap
from tagid.radar.assembler import Scan
from tagid.radar.messages import SCAN_FOREVER
from tagid.radar.p440 import P440
from tagid.radar.resume import RESUME_S, steady_scans
from tagid.radar.settings import RadarConfig
from tagid.storage.journal import JournalScan
from tagid.storage.journal_queue import JournalQueue, drop_note

_MOST_GAPS: Final = 1000
"""Gaps described individually; all are counted."""


class Intake:
    """One recording's scans.

    Args:
        radar: connected and configured.
        queue: leads to the journal.
        resume_s: longest wait for a lost radar, s.
        on_gap: called for each gap when scans arrive again.

    Attributes:
        scans_taken: number of scans put into the queue.
        gap_count: number of times the radar was lost.
        gaps: the first 1000 gaps.
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
        self._radar = radar
        self._queue = queue
        self._resume_s = resume_s
        self._on_gap = on_gap

    @property
    def config(self) -> RadarConfig:
        """The radar's settings."""
        return self._radar.config

    @property
    def scans_lost(self) -> int:
        """Number of lost or incomplete scans."""
        return self._radar.statistics.lost_scans

    def scans(self, count: int = SCAN_FOREVER, interval_us: int = 0) -> Iterator[Scan]:
        """The scans of a run, each already queued for the disk; dropped ones are skipped.

        Raises what `steady_scans` and `JournalQueue.put` raise.
        """
        clip = self._radar.config.clip_counts
        last_id: int | None = None
        gaps_before = self.gap_count
        for scan in steady_scans(self._radar, count, interval_us, self._resume_s, self._gap):
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

    def counted(self, info: RadarInfo | None = None) -> RadarInfo:
        """The radar's metadata with the counters of this recording."""
        statistics = asdict(self._radar.statistics)
        return replace(
            info or RadarInfo(),
            statistics=statistics,
            scans_lost=statistics["lost_scans"],
            scans_dropped=self._queue.dropped,
            gap_count=self.gap_count,
            gaps=tuple(self.gaps),
        )

    def _gap(self, gap: ScanGap) -> None:
        self.gap_count += 1
        if len(self.gaps) < _MOST_GAPS:
            self.gaps.append(gap)
        self._on_gap(gap)


def notes(radar: RadarInfo) -> list[str]:
    """Remarks on a recording for the user, one sentence each."""
    found = []
    if radar.scans_lost:
        found.append(f"{radar.scans_lost} scans were lost between radar and computer")
    if radar.scans_dropped:
        found.append(drop_note(radar.scans_dropped))
    if radar.gap_count:
        seconds = sum(gap.seconds for gap in radar.gaps)
        times = "once" if radar.gap_count == 1 else f"{radar.gap_count} times"
        why = radar.gaps[0].reason if radar.gaps else ""
        found.append(
            f"the radar was lost {times}, for {seconds:.1f} s in total; recording then continued ({why})"
        )
    return found
