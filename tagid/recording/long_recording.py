"""Recording for hours: every scan goes to the journal only, and capture files are written at the end.

Memory does not grow with the duration, so that a recording can run all day.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tagid import interrupts
from tagid.errors import DataError, StorageError
from tagid.metadata import ScanGap
from tagid.radar.messages import SCAN_FOREVER
from tagid.radar.p440 import P440
from tagid.recording.plan import RecordingPlan, journal_beside
from tagid.recording.session import (
    Recorded,
    Session,
    check_all_read,
    record_to_journal,
    recover_remedy,
    where_kept,
    with_remedy,
)
from tagid.storage.hdf5 import SUFFIX as CAPTURE_SUFFIX
from tagid.storage.journal_capture import PART_BYTES, WrittenCaptures, write_captures


@dataclass(frozen=True)
class RecordingLimits:
    """When a long recording ends.

    Attributes:
        scans: maximum number of scans; None for no limit.
        seconds: maximum duration on the radar's clock, s; None for no limit.
        interval_us: time between scans, us; 0 for the highest rate of the settings.
        part_bytes: samples in one capture file, bytes; longer recordings are split.
    """

    scans: int | None = None
    seconds: float | None = None
    interval_us: int = 0
    part_bytes: int = PART_BYTES


@dataclass(frozen=True)
class RecordingState:
    """Progress of a recording.

    Attributes:
        scans: in the journal.
        seconds: since the first scan, on the radar's clock, s.
        lost: lost or incomplete scans.
        journal_bytes: size of the journal.
    """

    scans: int
    seconds: float
    lost: int
    journal_bytes: int


@dataclass(frozen=True)
class RecordingWatch:
    """Callbacks of a recording.

    Attributes:
        progress: called about twice per second of scans.
        gap: called when scans arrive again after the radar was lost.
        stop: called after every scan; True ends the recording, which is complete if it had no limit.
    """

    progress: Callable[[RecordingState], None] = lambda state: None
    stop: Callable[[], bool] = lambda: False
    gap: Callable[[ScanGap], None] = lambda gap: None


def part_path(first: Path, part: int) -> Path:
    """The path of part 1, 2, ... of a split recording; `first` is that of part 1.

    Raises StorageError if it exists.
    """
    if part == 1:
        return first
    path = first.with_name(f"{first.name.removesuffix(CAPTURE_SUFFIX)}.part{part}{CAPTURE_SUFFIX}")
    if path.exists():
        raise StorageError(f"{path} exists already", "Move it away; captures are never overwritten.")
    return path


def record_long(
    radar: P440, plan: RecordingPlan, limits: RecordingLimits, path: Path, watch: RecordingWatch | None = None
) -> WrittenCaptures:
    """Record until a limit or a stop request, in constant memory, and write the capture file or files.

    The journal is next to them while recording, and is removed after all of them were read back and compared.
    If the radar fails, the received scans are written as incomplete, and the error says where. A stop signal
    takes effect while scans arrive; later ones are delayed until the files are written.

    Args:
        radar: not connected yet.
        plan: settings and geometry; its scans, seconds and motion are not used.
        limits: limits of the recording.
        path: path of the first capture file.
        watch: callbacks.

    Raises:
        DeviceError and its kinds: the radar failed. DiskFullError, StorageError: files; the journal is kept.
        DataError: no scan arrived.
    """
    watch = watch or RecordingWatch()
    journal_path = journal_beside(path)
    try:
        with interrupts.deferred() as signals:

            def receive(session: Session) -> bool:
                return _receive(session, limits, watch)

            recorded = record_to_journal(radar, plan, journal_path, receive, watch.gap, signals)
            return _finish(journal_path, path, limits, recorded)
    except KeyboardInterrupt as stop:
        raise interrupts.stopped_by_user(stop, where_kept(path, journal_path)) from stop


def _receive(session: Session, limits: RecordingLimits, watch: RecordingWatch) -> bool:
    """Whether the recording ended as requested."""
    intake = session.intake
    period_s = max(intake.config.scan_period_s, limits.interval_us * 1e-6)
    check_every = max(1, round(0.5 / period_s))
    first_ms: int | None = None
    for scan in intake.scans(SCAN_FOREVER, limits.interval_us):
        first_ms = scan.radar_time_ms if first_ms is None else first_ms
        seconds = (scan.radar_time_ms - first_ms) * 1e-3
        done = limits.scans is not None and intake.scans_taken >= limits.scans
        done |= limits.seconds is not None and seconds >= limits.seconds
        if done or intake.scans_taken % check_every == 0:
            watch.progress(
                RecordingState(intake.scans_taken, seconds, intake.scans_lost, session.journal.size)
            )
        if done:
            return True
        if watch.stop():
            break
    return limits.scans is None and limits.seconds is None


def _finish(journal_path: Path, path: Path, limits: RecordingLimits, recorded: Recorded) -> WrittenCaptures:
    """Write the capture files of the journal; the journal is removed only after read-back and comparison."""
    ended_by = recorded.ended_by
    if not recorded.scans:
        journal_path.unlink(missing_ok=True)
        raise ended_by or DataError(
            "no complete scan arrived", "Check the network for lost packets with `tagid radar monitor`."
        )
    try:
        written = write_captures(
            journal_path, lambda part: part_path(path, part), recorded.counters, limits.part_bytes
        )
        check_all_read(journal_path, written.views, recorded.scans)
    except StorageError as error:
        raise with_remedy(error, recover_remedy(journal_path)) from error
    journal_path.unlink(missing_ok=True)
    if ended_by is not None:
        places = ", ".join(str(each) for each in written.paths)
        raise with_remedy(ended_by, f"The {written.views} scans that arrived are in {places}.") from ended_by
    return written
