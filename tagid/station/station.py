"""The station without its web page: sequential scans, the operator's lock, health, history.

All methods are called from the web server's threads; scans, health checks and the interlock, which stops the
motion when the operator is lost, run in threads of their own.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from tagid.commissioning.bench import TapeChanges
from tagid.commissioning.steps import Step
from tagid.config import data_folder
from tagid.doctor import Finding, examine
from tagid.errors import StorageError, TagidError, UsageError
from tagid.files import read_bytes
from tagid.metadata import ObjectInfo
from tagid.operate.turn import picture_of, residuals_beside
from tagid.operate.workplace import TURN_S, Workplace, open_registry
from tagid.station.commissioning import CommissioningRun
from tagid.station.demo import DemoObject
from tagid.station.enrolling import Enrolling
from tagid.station.errors import (
    BusyError,
    InterlockError,
    NoSuchItemError,
    NotOperatorError,
    OverloadedError,
    begin,
    reported,
)
from tagid.station.operators import Operators
from tagid.station.profile import ProfileRun
from tagid.station.reports import ReportRun, Reports
from tagid.station.scans import COMMAND, Run, ScanRun, Then
from tagid.station.settings import Kind, Search, Settings
from tagid.station.stored import ReceivedRun, ReplayRun
from tagid.station.wiring import Wiring, wiring
from tagid.storage.history import FILE_NAME, Filter, History, HistoryEntry
from tagid.workers import Worker


@dataclass(frozen=True)
class Source:
    """Source of the station's settings; queried whenever they are needed.

    Attributes:
        place: a workplace with the current settings. Raises ConfigError, UsageError, StorageError.
        max_seconds: longest recording, s.
        demo: the objects of the demonstration; none with a real radar.
    """

    place: Callable[[], Workplace]
    max_seconds: float = TURN_S
    demo: tuple[DemoObject, ...] = ()

    def of_object(self, name: str, number: int) -> Workplace:
        """The workplace of a scan, by its number.

        The name is that of an object of the demonstration; empty for the first, or with a real radar.

        Raises UsageError for an unknown object, and as `place`.
        """
        place = self.place()
        shown = next((demo_object for demo_object in self.demo if demo_object.name == name or not name), None)
        if shown is None and name:
            raise UsageError(f"there is no object {name[:40]!r} to scan", "Only a demonstration has objects.")
        return place if shown is None else shown.placed(place, number)


HEALTH_EVERY_S = 20.0
"""Time between two health checks while a browser is connected, s."""
MISSING_EVERY_S = 4.0
"""The same while the radar is missing: the page shows soon that it is back."""
HISTORY_LIMIT = 200
INTERLOCK_S = 0.1
"""Time between two looks of the interlock, s."""
MAX_CONNECTIONS = 32
"""Maximum number of WebSocket connections."""
_PICTURE_BYTES = 4 << 20
_NO_RESIDUALS = "there is no picture of the hypotheses"
_STOP_S = 30.0
_NOTE_LENGTH = 200


@dataclass(frozen=True)
class Health:
    """The last health check.

    Attributes:
        findings: of `tagid.doctor`.
        checked_at: monotonic seconds; None before the first one.
        wiring: how to connect the radar; None unless it is missing.
        recovered: number of the scan that a device made fail, if the radar was missing and answers again.
    """

    findings: tuple[Finding, ...] = ()
    checked_at: float | None = None
    wiring: Wiring | None = None
    recovered: int | None = None

    @property
    def radar(self) -> bool | None:
        """Whether the radar answers; None if that is not known."""
        return next((finding.answers for finding in self.findings if finding.answers is not None), None)


class Station:
    """The station.

    Attributes:
        operators: connections and the lock.
        scan: the newest scan, or reading of a file; None before the first one.
        profile: the newest range profile; None before the first one.
        commissioning: the newest step of the commissioning; None before the first one of this station.
        failure: why the station ended on its own; None if it did not.
    """

    def __init__(self, source: Source, check: Callable[..., list[Finding]] = examine) -> None:
        self.source = source
        self.operators = Operators()
        self.enrolling = Enrolling(open_registry, lambda: source.place().imaging())
        self.reports = Reports()
        self._check = check
        self._radar = threading.Lock()
        self.settings = Settings(self._radar)
        self._starting = threading.Lock()
        self.scan: Run | None = None
        self.profile: ProfileRun | None = None
        self.commissioning: CommissioningRun | None = None
        self._count = 0
        self.health = Health()
        self._checker: Worker | None = None
        self._health_due = 0.0
        self._failed_seen = 0
        self._over = threading.Event()
        self.failure: TagidError | None = None
        self._interlock = Worker(
            self._watch_operator,
            "station-interlock",
            lambda error: self.fail("the operator interlock", error),
        )

    def begin(self) -> None:
        """Start the interlock. Raises OverloadedError."""
        begin(self._interlock)

    def fail(self, part: str, error: BaseException) -> None:
        """End the station because a part of it died: the motion stops, and nothing is started any more."""
        if self.failure is None:
            self.failure = TagidError(
                f"{part} died: {type(error).__name__}: {error}", "Start the station again."
            )
        self._over.set()
        self.stop()

    def start(self, key: str | None, note: str = "", demo_object: str = "") -> int:
        """Start a scan; returns its number.

        The key is that of the requesting browser, None for a script without a connection. The note is stored
        with the capture. The object is one of a demonstration; empty for the first one.

        Raises:
            BusyError: a scan is running.
            NotOperatorError: another browser operates, or the scan moves a device and the key has no lock.
            InterlockError: the scan would move a device, and nothing would stop it.
            OverloadedError: the system allows no further thread.
            ConfigError, UsageError, StorageError: see `Source.place`.
        """
        with self._starting:
            return self._start(key, note, demo_object)

    def start_capture(self, key: str | None) -> int:
        """Start a scan whose capture is added to the enrollment; returns its number.

        Raises as `start`, and EnrolmentError if the enrollment takes no capture.
        """
        with self._starting:
            note, add = self.enrolling.expect()
            # The last object of a demonstration is the one that is not enrolled.
            demo_object = self.source.demo[-1].name if self.source.demo else ""
            return self._start(key, note, demo_object, add)

    def start_replay(self, key: str | None, number: int) -> int:
        """Show the capture of an entry of the history as if it was recorded now; returns its number.

        Raises as `capture` and `ReplayRun`; BusyError, NotOperatorError, OverloadedError.
        """
        with self._starting:
            self.check_free(key)
            path = self.capture(number)
            return self._begin(ReplayRun(self._count + 1, self.source.place(), path))

    def identify_received(self, path: Path) -> int:
        """Identify a file in the station's folder that a browser sent; returns its number.

        The file is removed if it cannot be read, and with BusyError, OverloadedError, and what
        `Source.place` raises.
        """
        try:
            with self._starting:
                self._check_idle()
                return self._begin(ReceivedRun(self._count + 1, self.source.place(), path))
        except BaseException:
            path.unlink(missing_ok=True)
            raise

    def _start(self, key: str | None, note: str, demo_object: str, then: Then | None = None) -> int:
        self.check_free(key)
        place = self.source.of_object(demo_object, self._count)
        about = ObjectInfo(note=note[:_NOTE_LENGTH] or None, demo=bool(self.source.demo) or None)
        plan = place.plan(max_seconds=self.source.max_seconds, about=about)
        # An enrollment needs whole turns.
        until_sure = then is None and place.config["station.until_sure"] == "yes"
        run = ScanRun(self._count + 1, place, plan, self._radar, then, until_sure)
        if run.motion.moves and not self.operators.holds(key):
            raise NotOperatorError(
                "the scan would move the table or robot, and no browser operates the station",
                "Start it on the page, or send the key of an open WebSocket connection.",
            )
        if run.motion.moves and not self._interlock.alive:
            raise _ending()
        return self._begin(run)

    @property
    def _scanning(self) -> bool:
        return self.scan is not None and self.scan.running

    def _check_scan(self) -> None:
        if self._scanning:
            raise BusyError("a scan is running", "Wait for its end, or stop it.")

    def _check_idle(self) -> None:
        """Raise BusyError while a scan or a step of the commissioning is running."""
        self._check_scan()
        if self.commissioning is not None and self.commissioning.running:
            raise BusyError("a step of the commissioning is running", "Wait for its end, or stop it.")

    def check_free(self, key: str | None) -> None:
        """Take the lock for a browser. Raises BusyError, NotOperatorError."""
        self._check_idle()
        self.operate(key)

    def _check_open(self) -> None:
        """Raise InterlockError while the station is ending."""
        if self._over.is_set():
            raise _ending()

    def _begin(self, run: Run) -> int:
        """Start a run; returns its number. Raises InterlockError, OverloadedError."""
        self._check_open()
        self.stop_profile()
        run.start()
        self._count, self.scan = run.number, run
        if self._over.is_set():  # since it was asked above
            run.stop()
        return run.number

    def start_profile(self, key: str | None) -> None:
        """Show the echo over range until a scan begins, it is stopped, or `profile.LONGEST_S` has passed.

        Raises BusyError, NotOperatorError, OverloadedError; ConfigError if no radar is configured.
        """
        with self._starting:
            self.check_free(key)
            self._check_open()
            if self.profile is not None and self.profile.running:
                return
            run = ProfileRun(self.source.of_object("", self._count), self._radar)
            run.start()
            self.profile = run

    def stop_profile(self) -> None:
        """End the range profile; every connection may."""
        if self.profile is not None:
            self.profile.stop()

    def start_commissioning(self, key: str | None, step: Step, tape: TapeChanges) -> None:
        """Begin a step of the commissioning.

        Raises BusyError, NotOperatorError, InterlockError, OverloadedError, and as `CommissioningRun`.
        """
        with self._starting:
            self.check_free(key)
            self._check_open()
            run = CommissioningRun(self.source.of_object("", self._count), step, tape, self._radar)
            self.stop_profile()
            run.start()
            self.commissioning = run

    def stop_commissioning(self) -> None:
        """End the running step of the commissioning; every connection may."""
        if self.commissioning is not None:
            self.commissioning.stop()

    def find_devices(self, key: str | None, kind: Kind) -> Search:
        """Search for radars, or robots and tables. Raises as `start_profile` and `Settings.find`."""
        self.check_free(key)
        self.stop_profile()
        return self.settings.find(kind, self.source.place().config)

    def change_settings(self, key: str | None, changes: dict[str, object]) -> None:
        """Change settings of the page. Raises BusyError, NotOperatorError, and as `Settings.change`."""
        with self._starting:
            self.check_free(key)
            self.settings.change(changes, self.source.place().config)
            self.stop_profile()
            self._health_due = 0.0

    def operate(self, key: str | None) -> None:
        """Take the lock for a browser if it is free; a script without a connection (None) may act while it
        is.

        Raises NotOperatorError if another browser operates.
        """
        if key is not None:
            self.operators.take(key)
        if self.operators.taken and not self.operators.holds(key):
            raise NotOperatorError(
                "another browser operates the station", "Take over there, or wait until it is closed."
            )

    def start_report(self, key: str | None, entries: tuple[int, ...]) -> ReportRun:
        """Begin a report over entries of the history.

        Entries without a scan in the station's folder are left out, and the report says how many.

        Raises NotOperatorError, BusyError, UsageError, StorageError.
        """
        self.operate(key)
        place, captures = self.source.place(), self.captures(entries)
        files = {entry.id: Path(entry.file) for entry in self.history(Filter(numbers=entries))}
        selected = set(entries)
        missing = sum(files.get(number) not in captures for number in selected)
        where = f"their captures are not among the scans in {place.folder()}"
        left_out = f"{missing} of {len(selected)} left out: {where}" if missing else ""
        return self.reports.start(captures, left_out, place)

    def stop(self) -> None:
        """Stop the running scan; every connection may. Its capture is kept."""
        if self.scan is not None:
            self.scan.stop()

    def take_over(self, key: str) -> bool:
        """Give the lock to a connection; not from a connected operator while a scan is running."""
        return self.operators.take(key, force=not self._scanning)

    def release(self, key: str) -> None:
        """Release the lock of a connection. Raises BusyError while a scan is running."""
        self._check_scan()
        self.operators.release(key)

    def tick(self) -> None:
        """Begin a health check when one is due; called a few times per second."""
        now = time.monotonic()
        idle = not self._scanning and not self._measuring
        waiting = self._checker is None or not self._checker.alive
        if idle and self.scan is not None and self.scan.device_failed and self._failed_seen != self._count:
            self._failed_seen, self._health_due = self._count, now
        due = self.operators.connected and idle and waiting and not self._over.is_set()
        if due and now >= self._health_due:
            self._health_due = now + (MISSING_EVERY_S if self.health.wiring else HEALTH_EVERY_S)
            self._checker = Worker(self._examine, "station-health", self._unchecked)
            try:
                begin(self._checker)
            except OverloadedError as error:
                self._unchecked(error)

    @property
    def _measuring(self) -> bool:
        """Whether the range profile or the commissioning uses the radar."""
        return any(run is not None and run.running for run in (self.profile, self.commissioning))

    def _unchecked(self, error: BaseException) -> None:
        """Show why there is no health check; the next one is due as usual."""
        problem = reported(error)
        text = f"the health check failed: {problem.message}"
        finding = Finding("health check", "problem", text, problem.remedy)
        self.health = replace(self.health, findings=(finding,), checked_at=time.monotonic())

    def _watch_operator(self) -> None:
        """The interlock: stop a motion without an operator. Its thread does nothing else."""
        while not self._over.wait(INTERLOCK_S):
            lost = self.operators.expire() or not self.operators.taken
            run = self.scan
            if lost and run is not None and run.running and run.motion.moves:
                run.stop()

    def _examine(self) -> None:
        url: str | None = None
        with self._radar:
            try:
                config = self.source.place().config
                url = config["radar.url"]
                findings = tuple(self._check(config))
            except TagidError as error:
                findings = (Finding("configuration", "problem", error.message, error.remedy),)
        before, run = self.health, self.scan
        health = Health(findings, time.monotonic(), None, before.recovered)
        if health.radar is False:
            health = replace(health, wiring=wiring(url))
            self._health_due = min(self._health_due, time.monotonic() + MISSING_EVERY_S)
        elif health.radar and before.wiring is not None and run is not None and run.device_failed:
            health = replace(health, recovered=run.number)
        self.health = health

    def history(self, wanted: Filter) -> list[HistoryEntry]:
        """Entries of the history, newest first, at most `HISTORY_LIMIT`. Raises StorageError, UsageError."""
        return list(History(data_folder() / FILE_NAME).find(wanted))

    def available(self, entries: list[HistoryEntry]) -> list[tuple[bool, bool, bool]]:
        """Whether the station gives out the capture, the picture and the residuals of each entry."""
        try:
            folder = self.source.place().folder()
        except TagidError:  # a damaged configuration, which Health shows
            return [(False, False, False)] * len(entries)
        paths = [_own_file(entry, folder) for entry in entries]
        return [
            (path.is_file(), picture_of(path).is_file(), residuals_beside(picture_of(path)).is_file())
            if path
            else (False, False, False)
            for path in paths
        ]

    def picture(self, number: int) -> bytes:
        """The picture of an entry of the history, PNG. Raises NoSuchItemError."""
        return _png(picture_of(self._capture(number)), f"there is no picture of entry {number}")

    def residuals(self, number: int) -> bytes:
        """The picture of what the hypotheses leave of an entry's echo, PNG. Raises NoSuchItemError."""
        return _png(residuals_beside(picture_of(self._capture(number))), _NO_RESIDUALS)

    def scan_residuals(self) -> bytes:
        """The same of the newest scan. Raises NoSuchItemError."""
        if self.scan is None or self.scan.residuals is None:
            raise NoSuchItemError("the newest scan has no picture of its hypotheses")
        return _png(self.scan.residuals, _NO_RESIDUALS)

    def capture(self, number: int) -> Path:
        """The capture file of an entry of the history. Raises NoSuchItemError."""
        path = self._capture(number)
        if not path.is_file():
            raise NoSuchItemError(f"the capture of entry {number} is no longer on the disk")
        return path

    def captures(self, entries: tuple[int, ...]) -> list[Path]:
        """The capture files of entries of the history, each once, without those no longer on the disk."""
        folder = self.source.place().folder()
        known = {entry.id: entry for entry in self.history(Filter(numbers=entries))}
        files: dict[Path, None] = {}
        for number in entries:
            path = _own_file(known[number], folder) if number in known else None
            if path is not None and path.is_file():
                files[path] = None
        return list(files)

    def _capture(self, number: int) -> Path:
        entries = self.history(Filter(numbers=(number,)))
        path = _own_file(entries[0], self.source.place().folder()) if entries else None
        if path is None:
            raise NoSuchItemError(f"the station has no capture of entry {number}")
        return path

    def close(self) -> None:
        """Stop a running scan and a running report, and wait for their ends; no health check follows."""
        self._over.set()
        self.stop()
        self.stop_profile()
        self.stop_commissioning()
        self._interlock.join(_STOP_S)
        self.reports.close(_STOP_S)
        if self.scan is not None:
            self.scan.join(_STOP_S)
        for measuring in (self.profile, self.commissioning):
            if measuring is not None:
                measuring.join(_STOP_S)
        if self._checker is not None:
            self._checker.join(_STOP_S)


def _ending() -> InterlockError:
    return InterlockError("the station is ending", "Start it again.")


def _png(path: Path, missing: str) -> bytes:
    try:
        return read_bytes(path, _PICTURE_BYTES)
    except StorageError as error:
        raise NoSuchItemError(missing) from error


def _own_file(entry: HistoryEntry, folder: Path) -> Path | None:
    """The file of an entry of the history; None unless it is a scan in the station's folder."""
    path = Path(entry.file)
    is_scan = entry.command in (COMMAND, "scan") and path.resolve().parent == folder.resolve()
    return path if is_scan else None
