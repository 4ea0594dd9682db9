"""Records one turn from radar and motion device: first to the journal, then to a capture file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tagid import interrupts
from tagid.capture import Capture
from tagid.constants import RANGE_STEP_M
from tagid.errors import CaptureInterrupted, DataError
from tagid.metadata import Ending, ScanGap, Track
from tagid.motion.device import Motion
from tagid.motion.turntable import OVERLAP_TURNS
from tagid.radar.assembler import Scan
from tagid.radar.messages import SCAN_FOREVER
from tagid.radar.p440 import P440
from tagid.recording.intake import host_limit
from tagid.recording.plan import RecordingPlan
from tagid.recording.session import Recorded, Session, Written, run_recording
from tagid.recording.stream import ScanStream
from tagid.storage.hdf5 import write_capture
from tagid.storage.journal_capture import read_journal_capture

_JUDGED_SCANS = 2000
"""Maximum number of scans examined during recording; more are decimated to keep the radar's queue short."""

ScanProgress = Callable[[int, float], None]
"""Called with (scans, seconds)."""


@dataclass(frozen=True)
class Watch:
    """Callbacks of a recording.

    Attributes:
        progress: called after every half second of scans.
        gap: called when scans arrive again after the radar was lost.
        named: called with the capture's path once its journal is created.
        resolve: gives a capture its angles, from the motion's URL; called when the motion considers a turn
            complete (imaging can tell whether the shortest repetition is a turn, the motion cannot), and
            at the end. It raises DataError if that is not possible.
        began: called with the recording's scans once the radar is configured, before the motion starts; they
            are read in another thread, and end after the motion, before the capture file is written.
        stop: called about ten times per second; True ends the recording early, as a stop signal does.
        enough: called with every scan and about ten times per second; a value ends the recording, which is
            then complete, and is stored with it.
    """

    progress: ScanProgress | None = None
    resolve: Callable[[Capture, str], Capture] | None = None
    gap: Callable[[ScanGap], None] = lambda gap: None
    named: Callable[[Path], None] = lambda path: None
    began: Callable[[ScanStream], None] = lambda stream: None
    stop: Callable[[], bool] = lambda: False
    enough: Callable[[], Ending | None] = lambda: None


def record(
    radar: P440, motion: Motion, plan: RecordingPlan, path: Path, watch: Watch | None = None
) -> Capture:
    """Record until a turn is complete and write the capture file at `path`, with angles if they are known.

    The journal is next to it while recording, and is removed after the capture file was read back and
    compared. If recording ends early, the capture file holds the received scans, marked as incomplete, and
    the error says so. A stop signal takes effect while scans arrive; later ones are delayed until the file is
    written.

    Args:
        radar: a client, not connected.
        motion: motion device; started before and always stopped after.
        plan: what to record.
        path: the capture file to write; it must not exist.
        watch: callbacks.

    Raises:
        DeviceError and its subclasses: the radar or the table failed. DiskFullError, StorageError: files.
        CaptureInterrupted: stopped by the user. DataError: no scan arrived.
    """
    watch = watch or Watch()

    def receive(session: Session) -> bool:
        stream = ScanStream(session)
        try:
            watch.began(stream)
            _OneTurn(stream, motion, watch).run()
        finally:
            stream.end()
        return True

    def write(recorded: Recorded) -> Written[Capture]:
        capture = _with_angles(recorded, watch)
        write_capture(recorded.path, capture)
        return capture, capture.views, (recorded.path,)

    return run_recording(radar, plan, path, receive, write, gap=watch.gap, named=watch.named)


class _OneTurn:
    """Takes scans and motion readings until a turn is complete."""

    def __init__(self, stream: ScanStream, motion: Motion, watch: Watch) -> None:
        self._stream = stream
        self._session = stream.session
        self._plan = stream.session.plan
        self._motion = motion
        self._watch = watch
        self._needed_s = 0.0
        self._readings_kept = 0

    def run(self) -> None:
        check_every = max(1, round(0.5 / self._session.config.scan_period_s))
        try:
            if self._watch.stop():
                raise CaptureInterrupted("stopped before the first scan")
            self._motion.start()
            late = host_limit(self._plan.max_seconds)

            def ends() -> bool:
                return late() or self._watch.stop() or self._is_enough()

            for scan in self._session.intake.scans(self._plan.scans or SCAN_FOREVER, until=ends):
                self._stream.append(scan)
                self._motion.check()
                if self._watch.stop():
                    break
                if self._is_enough():
                    return
                if len(self._stream) % max(1, check_every // 5) == 0:
                    self._keep_readings()
                if len(self._stream) % check_every == 0 and (ending := self._ending()):
                    self._session.intake.ended = ending
                    return
                self._stream.await_next()
            if self._watch.stop():
                raise CaptureInterrupted(f"stopped after {len(self._stream)} scans")
            if not self._is_enough():
                self._session.intake.ended = self._ended("limit")
        finally:
            with interrupts.deferred():
                try:
                    self._motion.stop()
                finally:
                    self._keep_readings()

    def _is_enough(self) -> bool:
        """Whether the watch needs no more scans; its reason is kept."""
        intake = self._session.intake
        intake.ended = intake.ended or self._watch.enough()
        return intake.ended is not None

    def _ending(self) -> Ending | None:
        """Why the recording is complete with the newest scan; None if it is not."""
        scans = self._stream.since()
        seconds = (scans[-1].radar_time_ms - scans[0].radar_time_ms) * 1e-3
        if self._watch.progress:
            self._watch.progress(len(scans), seconds)
        if seconds >= self._plan.max_seconds:
            return self._ended("limit")
        if self._plan.scans is not None or seconds < self._needed_s:
            return None
        if self._motion.measures:
            return self._ended("turn") if self._motion.finished([], []) else None
        samples = [scan.samples for scan in scans]
        times = [scan.radar_time_ms * 1e-3 for scan in scans]
        if not (self._needed_s or self._motion.finished(samples, times)):
            return None
        self._needed_s = self._needed_seconds(scans)
        if seconds < self._needed_s:
            return None
        # Where nothing repeats within the longest time, no turn is known to be complete.
        return self._ended("turn" if self._needed_s or not self._watch.resolve else "limit")

    def _ended(self, reason: str) -> Ending:
        return Ending(reason, spent=self._plan.spent or None)

    def _keep_readings(self) -> None:
        """Write the new motion readings to the journal."""
        track = self._motion.track()
        kept = self._readings_kept
        if track is None or len(track) <= kept:
            return
        new = Track(track.host_time_ns[kept:], track.angles_rad[kept:], track.sigma_rad[kept:], track.info)
        self._session.queue.put_motion(new.to_json())
        self._readings_kept = len(track)

    def _needed_seconds(self, scans: list[Scan]) -> float:
        """Seconds to record; 0 if the scans do not show it, because more scans would not help."""
        if not self._watch.resolve:
            return 0.0
        some = scans[:: -(-len(scans) // _JUDGED_SCANS)]
        capture = Capture(
            np.stack([scan.samples for scan in some]),
            self._session.config.range_start_m(self._plan.cable_delay_ps),
            RANGE_STEP_M,
            axis_distance_m=self._plan.axis_distance_m,
            antenna_height_m=self._plan.antenna_height_m,
            antenna_separation_m=self._plan.antenna_separation_m,
            radar_time_ms=np.array([scan.radar_time_ms for scan in some], dtype=np.float64),
        )
        try:
            resolved = self._watch.resolve(capture, self._plan.motion).motion.resolved
        except DataError:
            return 0.0
        return OVERLAP_TURNS * (resolved.period_s or 0.0) if resolved else 0.0


def _with_angles(recorded: Recorded, watch: Watch) -> Capture:
    """The capture of a journal, with angles if they are known."""
    ended_by = recorded.ended_by
    capture = read_journal_capture(recorded.journal)
    if ended_by is not None:
        capture = replace(capture, radar=capture.radar.with_known(recorded.counters))
    if watch.resolve and (ended_by is None or capture.motion.track is not None):
        try:
            return watch.resolve(capture, capture.motion.url or "free")
        except DataError as error:
            return replace(capture, motion=capture.motion.without_track(not_resolved=error.message))
    return capture
