"""Long recordings: scans go to the journal and are not kept; capture files are written from it at the end.

Memory does not grow with the length of the recording.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tagid.errors import DataError, StorageError, TagidError
from tagid.intake import HostLimit, Intake
from tagid.radar.messages import SCAN_FOREVER
from tagid.radar.p440 import P440
from tagid.radar.resume import Gap
from tagid.recorder import (
    CAPTURE_SUFFIX,
    RecordingPlan,
    capture_beside,
    journal_beside,
    journal_header,
    start_journal,
    with_recovery,
    with_remedy,
)
from tagid.storage.journal import JournalWriter
from tagid.storage.journal_capture import PART_BYTES, WrittenCaptures, write_captures
from tagid.storage.journal_queue import JournalQueue


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
    """How far it is.

    Attributes:
        scans: in the journal.
        seconds: since the first, on the radar's clock, s.
        lost: scans that did not come whole.
        journal_bytes: size of the journal.
    """

    scans: int
    seconds: float
    lost: int
    journal_bytes: int


@dataclass(frozen=True)
class RecordingWatch:
    """Who looks on and who ends it.

    Attributes:
        progress: told about twice a second of scans.
        gap: told when scans arrive again after the radar was gone.
        stop: asked about ten times per second, also while no scan comes; True ends the recording, which is
            complete where it had no limit.
        named: called with the path of the first capture file once its journal is created.
    """

    progress: Callable[[RecordingState], None] = lambda state: None
    stop: Callable[[], bool] = lambda: False
    gap: Callable[[Gap], None] = lambda gap: None
    named: Callable[[Path], None] = lambda path: None


def part_path(first: Path, part: int) -> Path:
    """The path of part 1, 2, ... of a recording that is too long for one file; `first` is that of part 1.

    Raises StorageError where it is taken.
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
    """Record until a limit or until told to stop, in constant memory, and write the capture file or files.

    The journal lies beside them while recording and goes when they are safe on disk. Where the radar fails,
    what arrived is written as not complete, and the error says where.

    Args:
        radar: not connected yet.
        plan: settings and geometry; its scans, seconds and motion are not used.
        limits: when it ends.
        path: of the first capture file.
        watch: who looks on.

    Raises:
        DeviceError and its kinds: the radar failed. DiskFullError, StorageError: files; the journal stays.
        DataError: no scan arrived.
    """
    watch = watch or RecordingWatch()
    if not plan.renumber:
        journal_beside(path)
    failed: TagidError | None = None
    whole = False
    with radar:
        status = radar.status()
        taken = radar.config if plan.config is None else radar.set_config(plan.config)
        header = journal_header(plan, taken, {"serial": status.serial, "package": status.package})
        with start_journal(path, header, plan.renumber) as journal:
            journal_path, path = journal.path, capture_beside(journal.path)
            watch.named(path)
            try:
                with JournalQueue(journal) as queue:
                    intake = Intake(radar, queue, plan.resume_s, watch.gap)
                    intake.guard(journal)
                    try:
                        whole = _receive(intake, limits, journal, watch)
                    except StorageError:
                        raise
                    except TagidError as error:
                        failed = error
            except StorageError as error:
                raise with_recovery(error, journal_path) from error
            counters = intake.summary()
            if failed is None and whole:
                journal.close({"radar": counters})
    if not journal.scans:
        journal_path.unlink(missing_ok=True)
        raise failed or DataError(
            "no complete scan arrived", "Check the network for lost packets with `tagid radar monitor`."
        )
    return _finish(journal_path, path, (limits, counters), failed)


def _receive(intake: Intake, limits: RecordingLimits, journal: JournalWriter, watch: RecordingWatch) -> bool:
    """Whether the recording came to its planned end."""
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
            watch.progress(RecordingState(intake.scans_taken, seconds, intake.scans_lost, journal.size))
        if done:
            return True
    return limit.passed() or (limits.scans is None and limits.seconds is None)


def _finish(
    journal_path: Path,
    path: Path,
    ending: tuple[RecordingLimits, dict[str, Any]],
    failed: TagidError | None,
) -> WrittenCaptures:
    """The capture files of the journal, which goes only when they are safe on disk."""
    limits, counters = ending
    try:
        written = write_captures(
            journal_path, lambda part: part_path(path, part), counters, limits.part_bytes
        )
    except StorageError as error:
        raise with_recovery(error, journal_path) from error
    journal_path.unlink(missing_ok=True)
    if failed is not None:
        places = ", ".join(str(each) for each in written.paths)
        raise with_remedy(failed, f"The {written.views} scans that arrived are in {places}.") from failed
    return written
