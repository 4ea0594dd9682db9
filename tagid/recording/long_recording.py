"""Long recordings: scans are stored only in the journal; capture files are written from it at the end.

Memory does not grow with the length of the recording.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tagid.constants import CAPTURE_SUFFIX
from tagid.errors import StorageError
from tagid.radar.messages import SCAN_FOREVER
from tagid.radar.p440 import P440
from tagid.recording.intake import host_limit
from tagid.recording.plan import RecordingPlan
from tagid.recording.session import Recorded, Session, Written, run_recording
from tagid.storage.journal_capture import PART_BYTES, WrittenCaptures, write_captures


@dataclass(frozen=True)
class RecordingLimits:
    """Limits of a long recording.

    Attributes:
        scans: number of scans; None for no limit.
        seconds: duration on the radar's clock, or one second more on the host's, s; None for no limit.
        interval_us: time between scans, us; 0 as fast as the settings allow.
        part_bytes: samples per capture file, bytes; a longer recording is split.
    """

    scans: int | None = None
    seconds: float | None = None
    interval_us: int = 0
    part_bytes: int = PART_BYTES


@dataclass(frozen=True)
class RecordingState:
    """Progress of a recording.

    Attributes:
        scans: scans in the journal.
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
        stop: called about ten times per second, also while no scan arrives; True ends the recording, which is
            complete if it had no limit.
    """

    progress: Callable[[RecordingState], None] = lambda state: None
    stop: Callable[[], bool] = lambda: False


def part_path(first: Path, part: int) -> Path:
    """The path of part 1, 2, ... of a split recording; `first` is that of part 1.

    Raises StorageError if it exists.
    """
    if part == 1:
        return first
    path = first.with_name(f"{first.name.removesuffix(CAPTURE_SUFFIX)}.part{part}{CAPTURE_SUFFIX}")
    if path.exists():
        raise StorageError(f"{path} already exists", "Move it; captures are never overwritten.")
    return path


def record_long(
    radar: P440, plan: RecordingPlan, limits: RecordingLimits, path: Path, watch: RecordingWatch | None = None
) -> WrittenCaptures:
    """Record until a limit or a stop request, in constant memory, and write the capture file or files.

    The journal is next to them during recording, and is removed once all of them were read back and compared.
    If the radar fails, the received scans are written as incomplete, and the error says where. A stop signal
    takes effect while scans arrive; later ones are delayed until the files are written.

    The radar is not yet connected, and `path` is that of the first capture file. Scans, seconds and motion of
    the plan are not used.

    Raises:
        DeviceError or a subclass: the radar failed. DiskFullError, StorageError: files; the journal is kept.
        DataError: no scan arrived.
    """
    watch = watch or RecordingWatch()

    def receive(session: Session) -> bool:
        return _receive(session, limits, watch)

    def write(recorded: Recorded) -> Written[WrittenCaptures]:
        written = write_captures(
            recorded.journal,
            lambda part: part_path(recorded.path, part),
            recorded.counters,
            limits.part_bytes,
        )
        return written, written.views, written.paths

    return run_recording(radar, plan, path, receive, write)


def _receive(session: Session, limits: RecordingLimits, watch: RecordingWatch) -> bool:
    """Whether the recording ended as requested."""
    intake = session.intake
    period_s = max(session.config.scan_period_s, limits.interval_us * 1e-6)
    check_every = max(1, round(0.5 / period_s))
    first_ms: int | None = None
    late = host_limit(limits.seconds)
    for scan in intake.scans(SCAN_FOREVER, limits.interval_us, lambda: watch.stop() or late()):
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
    return late() or (limits.scans is None and limits.seconds is None)
