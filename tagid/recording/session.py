"""Common part of all recordings: radar -> queue -> journal, kept until its files are verified.

If a recording ends early, the received scans stay on disk and the error says where.
"""

from __future__ import annotations

import logging
import uuid
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from tagid import files, interrupts
from tagid._version import __version__
from tagid.constants import CAPTURE_SUFFIX, RANGE_STEP_M
from tagid.errors import CaptureInterrupted, DataError, StorageError, TagidError
from tagid.metadata import METADATA_VERSION, MotionInfo, RadarInfo, ScanGap
from tagid.radar.p440 import P440
from tagid.radar.settings import RadarConfig
from tagid.recording.intake import Intake
from tagid.recording.plan import RecordingPlan, capture_beside, journal_beside
from tagid.storage.journal import SUFFIX as JOURNAL_SUFFIX
from tagid.storage.journal import JournalWriter, being_recorded
from tagid.storage.journal_queue import JournalQueue
from tagid.storage.metadata import VERSION_KEY

_Result = TypeVar("_Result")
Written = tuple[_Result, int, tuple[Path, ...]]
"""What a recording returns, the number of scans read back from its journal, and the capture files."""

SYNC_S = 0.5
"""Time between two syncs of the disk, s: a power cut loses only scans written within this time."""


@dataclass(frozen=True)
class Session:
    """A running recording.

    Attributes:
        config: the radar's settings in force.
        intake: source of the scans.
        queue: accepts motion readings.
    """

    plan: RecordingPlan
    config: RadarConfig
    intake: Intake
    queue: JournalQueue
    journal: JournalWriter


@dataclass(frozen=True)
class Recorded:
    """Summary of a journal after the last scan.

    Attributes:
        journal, path: paths of the journal and of its capture file.
        scans: number of scans accepted for it.
        ended_by: error that ended the recording early; None if it is complete.
    """

    journal: Path
    path: Path
    scans: int
    counters: RadarInfo
    ended_by: TagidError | None


def run_recording(
    radar: P440,
    plan: RecordingPlan,
    path: Path,
    receive: Callable[[Session], bool],
    write: Callable[[Recorded], Written[_Result]],
    *,
    gap: Callable[[ScanGap], None] = lambda gap: None,
    named: Callable[[Path], None] = lambda path: None,
) -> _Result:
    """Record into a journal, write its capture files, and remove it once they were read back and compared.

    A stop signal takes effect while the radar is configured and while scans arrive, not while the journal is
    opened or closed or a file is written; later ones are delayed until the files are written.

    Args:
        radar: not yet connected.
        plan, path: what to record, and the first capture file.
        receive: takes the scans; returns whether the recording is complete.
        write: writes the capture files of the journal.
        gap, named: as in `tagid.recording.recorder.Watch`.

    Raises:
        DeviceError or a subclass: the radar failed; the received scans are in the files that the error names.
        DiskFullError, StorageError: files; the journal is kept. CaptureInterrupted: stopped by the user.
        DataError: no scan arrived.
    """
    if not plan.renumber:
        journal_beside(path)
    taken = [path]
    try:
        with interrupts.deferred() as signals, ExitStack() as marked:
            with ExitStack() as connected:
                with signals.listening():
                    connected.enter_context(radar)
                    header = _configure(radar, plan)
                with start_journal(path, header, plan.renumber) as journal:
                    marked.enter_context(journal.locked())
                    taken.append(capture_beside(journal.path))
                    named(taken[-1])
                    recorded = _fill(journal, radar, plan, receive, gap, signals)
            return _keep(recorded, write)
    except KeyboardInterrupt as stop:
        raise interrupts.stopped_by_user(stop, where_kept(taken[-1])) from stop


def _configure(radar: P440, plan: RecordingPlan) -> dict[str, Any]:
    """Configure a connected radar; returns the header of the journal."""
    status, config = radar.status(), radar.config
    if plan.config is not None:
        asked = plan.config.on(config)
        plan, config = replace(plan, config=asked), radar.set_config(asked)
    return journal_header(plan, config, RadarInfo(serial=status.serial, package=status.package))


def _fill(
    journal: JournalWriter,
    radar: P440,
    plan: RecordingPlan,
    receive: Callable[[Session], bool],
    gap: Callable[[ScanGap], None],
    signals: interrupts.Deferred,
) -> Recorded:
    """Write the scans to the journal, with its end record if `receive` reports a complete recording."""
    ended_by: TagidError | None = None
    complete = False
    try:
        with JournalQueue(journal) as queue:
            intake = Intake(radar, queue, plan.resume_s, gap)
            try:
                with signals.listening():
                    complete = receive(Session(plan, radar.config, intake, queue, journal))
            except KeyboardInterrupt:
                ended_by = CaptureInterrupted(f"stopped by the user after {intake.scans_taken} scans")
            except StorageError:
                raise
            except TagidError as error:
                ended_by = error
            except Exception as error:
                # A fault in what watches a recording must not cost its scans.
                logging.getLogger("tagid").debug("recording", exc_info=True)
                ended_by = TagidError.unexpected(error)
    except StorageError as error:
        raise with_recovery(error, journal.path) from error
    counters = intake.counted()
    if ended_by is None and complete:
        journal.close({"radar": counters.to_json()})
    return Recorded(journal.path, capture_beside(journal.path), intake.scans_taken, counters, ended_by)


def _keep(recorded: Recorded, write: Callable[[Recorded], Written[_Result]]) -> _Result:
    """Write the capture files of the journal, which is removed only once they are verified."""
    ended_by, journal = recorded.ended_by, recorded.journal
    if not recorded.scans:
        journal.unlink(missing_ok=True)
        raise ended_by or DataError(
            "no complete scan arrived", "Check the network for lost packets with `tagid radar monitor`."
        )
    try:
        result, views, paths = write(recorded)
        check_all_read(journal, views, recorded.scans)
    except StorageError as error:
        raise with_recovery(error, journal) from error
    journal.unlink(missing_ok=True)
    if ended_by is not None:
        files_made = ", ".join(map(str, paths))
        raise ended_by.with_remedy(f"The {views} scans that arrived are in {files_made}.") from ended_by
    return result


def start_journal(path: Path, header: dict[str, Any], renumber: bool = False) -> JournalWriter:
    """The journal of a capture that is to be written at `path`; creating it reserves the name.

    With `renumber` the next free name is used if the name exists. Creation is exclusive, so two
    recordings that start at once in one folder get two names.

    Raises StorageError if the name exists, or the journal cannot be created.
    """
    stem = path.name.removesuffix(CAPTURE_SUFFIX)
    for number in range(1, 1000 if renumber else 2):
        wanted = path if number == 1 else path.with_name(f"{stem}-{number}{CAPTURE_SUFFIX}")
        if renumber and wanted.exists():
            continue
        journal_path = journal_beside(wanted)
        files.check_regular(journal_path)  # opening a pipe may wait for ever
        try:
            journal = JournalWriter(journal_path, header, sync_every=1, sync_seconds=SYNC_S)
        except StorageError as error:
            if not journal_path.is_file():
                raise
            if renumber:
                continue
            if being_recorded(journal_path):
                raise StorageError(
                    f"{journal_path} exists: another recording is writing it", "Choose another name."
                ) from error
            raise StorageError(
                f"{journal_path} exists: a recording was interrupted",
                f"`tagid recover {journal_path}` writes its capture file; or choose another name.",
            ) from error
        if not wanted.exists():
            return journal
        # Another recording of this name ended between the two checks.
        journal.__exit__(None, None, None)
        journal_path.unlink(missing_ok=True)
    raise StorageError(f"{path} and the names after it already exist", "Choose another folder.")


def journal_header(plan: RecordingPlan, taken: RadarConfig, radar: RadarInfo) -> dict[str, Any]:
    """The header of a recording's journal: all of its capture that is known before the first scan.

    `taken` are the radar's settings in force.
    """
    info = replace(
        radar,
        config=taken.stored(),
        config_asked=None if plan.config is None else plan.config.stored(),
        cable_delay_ps=plan.cable_delay_ps,
    )
    return {
        "range_start_m": taken.range_start_m(plan.cable_delay_ps),
        "range_step_m": RANGE_STEP_M,
        "axis_distance_m": plan.axis_distance_m,
        "antenna_height_m": plan.antenna_height_m,
        "antenna_separation_m": plan.antenna_separation_m or None,
        "uuid": str(uuid.uuid4()),
        "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "tool_version": __version__,
        VERSION_KEY: METADATA_VERSION,
        "radar": info.to_json(),
        "motion": MotionInfo(url=plan.motion).to_json(),
        "object": plan.object.to_json(),
    }


def check_all_read(journal: Path, read: int, accepted: int) -> None:
    """Raises StorageError if fewer scans were read from a journal than accepted; it must then be kept."""
    if read < accepted:
        raise StorageError(
            f"{journal}: only {read} of the {accepted} recorded scans could be read back",
            "The disk may be faulty; the capture file holds those that could be read.",
        )


def recover_remedy(journal: Path) -> str:
    """The remedy if the capture file of a journal could not be written."""
    return f"The scans are kept in {journal}; `tagid recover {journal}` writes the capture file."


def where_kept(path: Path) -> str:
    """Where the scans of a capture are after a stop signal outside the recording itself."""
    journal = path.with_name(path.name.removesuffix(CAPTURE_SUFFIX) + JOURNAL_SUFFIX)
    if path.exists():
        return f"The recording is complete in {path}."
    return recover_remedy(journal) if journal.exists() else ""


def with_recovery(error: TagidError, journal: Path) -> TagidError:
    """The same error with how to recover the journal, if there is one."""
    return error.with_remedy(recover_remedy(journal)) if journal.exists() else error
