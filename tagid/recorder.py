"""From two devices to a capture: the radar's scans go to the journal first, then to a capture file.

Whatever ends a recording early, what arrived stays on disk and the error says where.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from tagid import __version__
from tagid.capture import Capture
from tagid.constants import RANGE_STEP_M, SPEED_OF_LIGHT
from tagid.errors import CaptureInterrupted, ConfigError, DataError, StorageError, TagidError
from tagid.intake import HostLimit, Intake
from tagid.motion.device import Motion
from tagid.motion.turntable import OVERLAP_TURNS
from tagid.radar.assembler import Scan
from tagid.radar.messages import SCAN_FOREVER
from tagid.radar.p440 import P440
from tagid.radar.resume import RESUME_S, Gap
from tagid.radar.settings import RadarConfig
from tagid.storage.hdf5 import write_capture
from tagid.storage.journal import SUFFIX as JOURNAL_SUFFIX
from tagid.storage.journal import JournalWriter, read_journal
from tagid.storage.journal_capture import journal_to_capture
from tagid.storage.journal_queue import JournalQueue

SYNC_S = 0.5
"""The disk is synced no more often than this, s: what a power cut may cost."""
CAPTURE_SUFFIX = ".tagid.h5"
_MARGIN_M = 0.35
"""Kept on both sides of the image: the pulse's length, the autofocus and clutter-free bins for the noise."""

_JUDGED_SCANS = 2000
"""Scans looked at while recording; more are thinned, so that the radar's queue never waits long."""

Progress = Callable[[int, float], None]
"""Called with (scans, seconds)."""


@dataclass(frozen=True)
class RecordingPlan:
    """What is recorded.

    Attributes:
        config: the radar settings asked for; None leaves the radar's own.
        axis_distance_m, antenna_height_m: of the antenna, m; the distance may be unknown (None).
        cable_delay_ps: two-way delay to take off the ranges, ps.
        scans: number of scans; None until the motion says that a turn is complete.
        max_seconds: longest recording, s.
        motion: URL of what turns the object, kept with the capture.
        object: what is known of the object, plain JSON values.
        resume_s: how long a radar that went away is waited for, s.
        renumber: take the next free name where the wanted one is taken.
    """

    config: RadarConfig | None
    axis_distance_m: float | None
    antenna_height_m: float = 0.0
    cable_delay_ps: float = 0.0
    scans: int | None = None
    max_seconds: float = 180.0
    motion: str = "free"
    object: dict[str, Any] = field(default_factory=dict)
    resume_s: float = RESUME_S
    renumber: bool = False


def plan_window(
    axis_distance_m: float, extent_m: float, cable_delay_ps: float, base: RadarConfig
) -> RadarConfig:
    """The settings whose range window holds the object and a margin around it.

    Raises ConfigError where the radar would stand inside the object.
    """
    reach = extent_m / np.sqrt(2) + _MARGIN_M
    if axis_distance_m <= extent_m / 2:
        raise ConfigError(
            f"the axis distance is {axis_distance_m} m, but the image reaches {extent_m / 2} m from the axis",
            "Move the radar away or make the extent smaller.",
        )

    def picoseconds(range_m: float) -> int:
        return round(2e12 * range_m / SPEED_OF_LIGHT + cable_delay_ps)

    return replace(
        base,
        scan_start_ps=picoseconds(max(axis_distance_m - reach, 0.0)),
        scan_stop_ps=picoseconds(axis_distance_m + reach),
    )


@dataclass(frozen=True)
class Watch:
    """Who looks on while scans arrive.

    Attributes:
        progress: told after every half second of scans.
        gap: told when scans arrive again after the radar was gone.
        named: called with the capture's path once its journal is created.
        resolve: gives a capture its angles, from the motion's URL; asked when the motion believes that a turn
            is complete (imaging knows whether the shortest repetition is a turn, the motion does not), and
            at the end. It raises DataError where it cannot.
    """

    progress: Progress | None = None
    resolve: Callable[[Capture, str], Capture] | None = None
    gap: Callable[[Gap], None] = lambda gap: None
    named: Callable[[Path], None] = lambda path: None


def record(
    radar: P440, motion: Motion, plan: RecordingPlan, path: Path, watch: Watch | None = None
) -> Capture:
    """Record until a turn is complete and write the capture file at `path`, with angles where they are known.

    The journal lies beside it while recording and is removed when the capture file is safe on disk. Where
    recording ends early, the capture file holds what arrived, marked as not complete, and the error says so.

    Args:
        radar: a client, not connected.
        motion: what turns the object; started before and stopped after, whatever happens.
        plan: what to record.
        path: the capture file to write; it must not exist.
        watch: who looks on.

    Raises:
        DeviceError and its kinds: the radar or the table failed. DiskFullError, StorageError: files.
        CaptureInterrupted: stopped by the user. DataError: no scan arrived.
    """
    stopped: TagidError | None = None
    if not plan.renumber:
        journal_beside(path)
    with radar:
        status = radar.status()
        taken = radar.config if plan.config is None else radar.set_config(plan.config)
        header = journal_header(plan, taken, {"serial": status.serial, "package": status.package})
        with start_journal(path, header, plan.renumber) as journal:
            journal_path, path = journal.path, capture_beside(journal.path)
            (watch or Watch()).named(path)
            try:
                with JournalQueue(journal) as queue:
                    intake = Intake(radar, queue, plan.resume_s, (watch or Watch()).gap)
                    intake.guard(journal)
                    try:
                        _receive((intake, queue), motion, (plan, header), radar.config, watch or Watch())
                    except KeyboardInterrupt:
                        text = f"stopped by the user after {intake.scans_taken} scans"
                        stopped = CaptureInterrupted(text)
                    except StorageError:
                        raise
                    except TagidError as error:
                        stopped = error
            except StorageError as error:
                raise with_recovery(error, journal_path) from error
            summary = {"radar": intake.summary()}
            if stopped is None:
                journal.close(summary)
    return _finish(journal_path, path, (summary, watch or Watch()), stopped)


def _receive(
    intake_and_queue: tuple[Intake, JournalQueue],
    motion: Motion,
    plan_and_header: tuple[RecordingPlan, dict[str, Any]],
    config: RadarConfig,
    watch: Watch,
) -> None:
    plan, header = plan_and_header
    intake, queue = intake_and_queue
    needed = 0.0
    scans: list[Scan] = []
    check_every = max(1, round(0.5 / config.scan_period_s))
    told = 0
    try:
        motion.start()
        for scan in intake.scans(plan.scans or SCAN_FOREVER, until=HostLimit(plan.max_seconds).passed):
            scans.append(scan)
            motion.check()
            if len(scans) % max(1, check_every // 5) == 0:
                told = _note_motion(queue, motion, told)
            if len(scans) % check_every:
                continue
            seconds = (scan.radar_time_ms - scans[0].radar_time_ms) * 1e-3
            if watch.progress:
                watch.progress(len(scans), seconds)
            if seconds >= plan.max_seconds:
                return
            if plan.scans is not None or seconds < needed:
                continue
            if motion.measures:
                if motion.finished([], []):
                    return
            elif needed or motion.finished(
                [s.samples for s in scans], [s.radar_time_ms * 1e-3 for s in scans]
            ):
                needed = _needed(watch, scans, header, plan)
                if seconds >= needed:
                    return
    finally:
        try:
            motion.stop()
        finally:
            _note_motion(queue, motion, told)


def _note_motion(queue: JournalQueue, motion: Motion, told: int) -> int:
    """Keep the motion's new readings; returns how many are kept now."""
    track = motion.track()
    if track is None or len(track) <= told:
        return told
    queue.put_motion(
        {
            "host_time_ns": track.host_time_ns[told:].tolist(),
            "angle_rad": track.angles_rad[told:].tolist(),
            "sigma_rad": track.sigma_rad[told:].tolist(),
            "info": track.info,
        }
    )
    return len(track)


def _needed(watch: Watch, scans: list[Scan], header: dict[str, Any], plan: RecordingPlan) -> float:
    """Seconds to record; 0 where what arrived does not tell, because then more of it is no help."""
    if not watch.resolve:
        return 0.0
    every = -(-len(scans) // _JUDGED_SCANS)
    some = scans[::every]
    capture = Capture(
        np.stack([s.samples for s in some]),
        header["range_start_m"],
        header["range_step_m"],
        axis_distance_m=plan.axis_distance_m,
        antenna_height_m=plan.antenna_height_m,
        radar_time_ms=np.array([s.radar_time_ms for s in some], dtype=np.float64),
    )
    try:
        resolved = watch.resolve(capture, plan.motion).motion["resolved"]
        return OVERLAP_TURNS * float(resolved["period_s"])
    except DataError:
        return 0.0


def journal_beside(path: Path) -> Path:
    """The journal of a capture file that is to be written.

    Raises StorageError where the capture exists already.
    """
    if path.exists():
        raise StorageError(f"{path} exists already", "Choose another name; captures are never overwritten.")
    return path.with_name(path.name.removesuffix(CAPTURE_SUFFIX) + JOURNAL_SUFFIX)


def capture_beside(journal_path: Path) -> Path:
    """The capture file that a journal's scans become."""
    return journal_path.with_name(journal_path.name.removesuffix(JOURNAL_SUFFIX) + CAPTURE_SUFFIX)


def start_journal(path: Path, header: dict[str, Any], renumber: bool = False) -> JournalWriter:
    """The journal of a capture that is to be written at `path`; creating it reserves the name.

    With `renumber` the next free name is taken instead of a taken one. Creation is exclusive, so two
    recordings that start at once in one folder get two names.

    Raises StorageError where the name is taken, or the journal cannot be created.
    """
    stem = path.name.removesuffix(CAPTURE_SUFFIX)
    for number in range(1, 1000 if renumber else 2):
        wanted = path if number == 1 else path.with_name(f"{stem}-{number}{CAPTURE_SUFFIX}")
        if renumber and wanted.exists():
            continue
        journal_path = journal_beside(wanted)
        try:
            journal = JournalWriter(journal_path, header, sync_seconds=SYNC_S)
        except StorageError as error:
            if not journal_path.is_file():
                raise
            if renumber:
                continue
            raise StorageError(
                f"{journal_path} exists: another recording is writing it, or one was interrupted",
                f"Choose another name; if no recording runs, `tagid recover {journal_path}`.",
            ) from error
        if not wanted.exists():
            return journal
        # Another recording of this name ended between the two checks.
        journal.__exit__(None, None, None)
        journal_path.unlink(missing_ok=True)
    raise StorageError(f"{path} and the names after it are taken", "Choose another folder.")


def journal_header(plan: RecordingPlan, taken: RadarConfig, radar: dict[str, Any]) -> dict[str, Any]:
    """What a journal says of its scans; `radar` is what the radar says of itself."""
    asked = None if plan.config is None else asdict(plan.config)
    return {
        "range_start_m": taken.range_start_m(plan.cable_delay_ps),
        "range_step_m": RANGE_STEP_M,
        "axis_distance_m": plan.axis_distance_m,
        "antenna_height_m": plan.antenna_height_m,
        "uuid": str(uuid.uuid4()),
        "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "tool_version": __version__,
        "radar": {
            **radar,
            "config": asdict(taken),
            "config_asked": asked,
            "cable_delay_ps": plan.cable_delay_ps,
        },
        "motion": {"url": plan.motion},
        "object": plan.object,
    }


def _finish(
    journal_path: Path, path: Path, end: tuple[dict[str, Any], Watch], stopped: TagidError | None
) -> Capture:
    """Turn the journal into the capture file; the journal goes only when that is safe on disk."""
    journal = read_journal(journal_path)
    if not journal.scans:
        journal_path.unlink(missing_ok=True)
        raise stopped or DataError(
            "no complete scan arrived", "Check the network for lost packets with `tagid doctor`."
        )
    capture = journal_to_capture(journal)
    summary, watch = end
    if stopped is not None:
        capture = replace(capture, radar={**capture.radar, **summary["radar"]})
    if watch.resolve and (stopped is None or "track" in capture.motion):
        try:
            capture = watch.resolve(capture, capture.motion["url"])
        except DataError as error:
            kept = {key: value for key, value in capture.motion.items() if key != "track"}
            capture = replace(capture, motion={**kept, "not_resolved": error.message})
    try:
        write_capture(path, capture)
    except StorageError as error:
        raise with_recovery(error, journal_path) from error
    journal_path.unlink(missing_ok=True)
    if stopped is not None:
        raise with_remedy(stopped, f"The {capture.views} scans that arrived are in {path}.") from stopped
    return capture


def with_remedy(error: TagidError, remedy: str) -> TagidError:
    """The same error with more to do next."""
    return type(error)(error.message, f"{error.remedy} {remedy}".strip())


def with_recovery(error: TagidError, journal_path: Path) -> TagidError:
    """The same error with how to recover the journal, where there is one."""
    if not journal_path.exists():
        return error
    return with_remedy(error, f"Free space, then `tagid recover {journal_path}`.")


def capture_path(folder: Path, now: float | None = None) -> Path:
    """The path of a new capture file, named after the second; a plan with `renumber` makes it unique."""
    return folder / time.strftime(f"scan-%Y%m%d-%H%M%S{CAPTURE_SUFFIX}", time.localtime(now))
