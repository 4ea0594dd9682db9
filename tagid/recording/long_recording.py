"""Long recordings: scans go to the journal and are not kept; capture files are written from it at the end.

Memory does not grow with the length of the recording.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from tagid import interrupts
from tagid.constants import CAPTURE_SUFFIX
from tagid.errors import DataError, StorageError
from tagid.metadata import ScanGap
from tagid.radar.messages import SCAN_FOREVER
from tagid.radar.p440 import P440
from tagid.recording.intake import HostLimit
from tagid.recording.plan import RecordingPlan, journal_beside
from tagid.recording.session import (
    Recorded,
    Session,
    check_all_read,
    record_to_journal,
    where_kept,
    with_recovery,
    with_remedy,
)
from tagid.storage.journal_capture import PART_BYTES, WrittenCaptures, write_captures


@dataclass(frozen=True)
class RecordingLimits:
    """When a long recording ends.

    Attributes:
        scans: after so many; None never.
        seconds: after so long on the radar's clock, or a second later on the host's, s; None never.
        interval_us: time between scans, us; 0 as fast as the settings allow.
        part_bytes: samples in one capture file, bytes; a longer recording becomes several.
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
        progress: told about twice a second of scans.
        gap: told when scans arrive again after the radar was gone.
        stop: asked about ten times per second, also while no scan comes; True ends the recording, which is
            complete where it had no limit.
        named: called with the path of the first capture file once its journal is created.
    """

    progress: Callable[[RecordingState], None] = lambda state: None
    stop: Callable[[], bool] = lambda: False
    gap: Callable[[ScanGap], None] = lambda gap: None
    named: Callable[[Path], None] = lambda path: None


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
    if not plan.renumber:
        journal_beside(path)
    kept = [path]

    def named(taken: Path) -> None:
        kept.append(taken)
        watch.named(taken)

    try:
        with interrupts.deferred() as signals:

            def receive(session: Session) -> bool:
                return _receive(session, limits, watch)

            told = replace(watch, named=named)
            recorded = record_to_journal(radar, plan, path, receive, told, signals)
            return _finish(recorded, limits)
    except KeyboardInterrupt as stop:
        raise interrupts.stopped_by_user(stop, where_kept(kept[-1])) from stop


def _receive(session: Session, limits: RecordingLimits, watch: RecordingWatch) -> bool:
    """Whether the recording ended as requested."""
    intake = session.intake
    period_s = max(intake.config.scan_period_s, limits.interval_us * 1e-6)
    check_every = max(1, round(0.5 / period_s))
    first_ms: int | None = None
    limit = HostLimit(limits.seconds)
    for scan in intake.scans(SCAN_FOREVER, limits.interval_us, lambda: watch.stop() or limit.passed()):
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
    return limit.passed() or (limits.scans is None and limits.seconds is None)


def _finish(recorded: Recorded, limits: RecordingLimits) -> WrittenCaptures:
    """Make the capture files of the journal, which is removed only when they were read back and compared."""
    ended_by, journal_path, path = recorded.ended_by, recorded.journal, recorded.path
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
        raise with_recovery(error, journal_path) from error
    journal_path.unlink(missing_ok=True)
    if ended_by is not None:
        places = ", ".join(str(each) for each in written.paths)
        raise with_remedy(ended_by, f"The {written.views} scans that arrived are in {places}.") from ended_by
    return written
