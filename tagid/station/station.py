"""The station without its web page: sequential scans, the operator's lock, health, history.

All methods are called from the web server's thread; scans and health checks run in separate threads.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tagid.config import data_folder
from tagid.doctor import Finding, examine
from tagid.errors import StorageError, TagidError, UsageError
from tagid.files import read_bytes
from tagid.station.operators import NotOperatorError, Operators
from tagid.station.scans import COMMAND, ScanRun, picture_of
from tagid.station.setup import Source
from tagid.storage.history import FILE_NAME, Filter, History

HEALTH_EVERY_S = 20.0
"""Time between two health checks while a browser is connected, s."""
HISTORY_LIMIT = 200
_PICTURE_BYTES = 4 << 20
_STOP_S = 30.0
_NOTE_LENGTH = 200


class BusyError(UsageError):
    """A scan is running."""

    code = "busy"


class NoSuchItemError(UsageError):
    """The history has no such entry, or it has no picture."""

    code = "not_found"


@dataclass(frozen=True)
class Health:
    """The last health check.

    Attributes:
        findings: of `tagid.doctor`.
        checked_at: monotonic seconds; None before the first one.
    """

    findings: tuple[Finding, ...] = ()
    checked_at: float | None = None


class Station:
    """The station.

    Args:
        source: source of the settings.
        check: the health check.
    """

    def __init__(self, source: Source, check: Callable[..., list[Finding]] = examine) -> None:
        self.source = source
        self.operators = Operators()
        self._check = check
        self._radar = threading.Lock()
        self._starting = threading.Lock()
        self._scan: ScanRun | None = None
        self._count = 0
        self._health = Health()
        self._health_thread: threading.Thread | None = None
        self._health_due = 0.0

    @property
    def scan(self) -> ScanRun | None:
        """The newest scan; None before the first one."""
        return self._scan

    @property
    def health(self) -> Health:
        """The newest health check."""
        return self._health

    def start(self, key: str | None, note: str = "") -> int:
        """Start a scan; returns its number.

        Args:
            key: of the requesting browser; None for a script without a connection.
            note: text stored with the capture.

        Raises:
            BusyError: a scan is running.
            NotOperatorError: another browser operates, or the scan moves a device and the key has no lock.
            ConfigError, UsageError, StorageError: see `Source.setup`.
        """
        with self._starting:
            return self._start(key, note)

    def _start(self, key: str | None, note: str) -> int:
        if self._scan is not None and self._scan.running:
            raise BusyError("a scan is running", "Wait for its end, or stop it.")
        if key is not None:
            self.operators.take(key)
        if self.operators.taken and not self.operators.holds(key):
            raise NotOperatorError(
                "another browser operates the station", "Take over there, or wait until it is closed."
            )
        setup = self.source.setup(note[:_NOTE_LENGTH])
        run = ScanRun(self._count + 1, setup, self._radar)
        if run.motion.moves and not self.operators.holds(key):
            raise NotOperatorError(
                "the scan would move the table or robot, and no browser operates the station",
                "Start it on the page, or send the key of an open WebSocket connection.",
            )
        self._count = run.number
        run.start()
        self._scan = run
        return run.number

    def stop(self) -> None:
        """Stop the running scan; every connection may. Its capture is kept."""
        if self._scan is not None:
            self._scan.stop()

    def take_over(self, key: str) -> bool:
        """Give the lock to a connection; not from a connected operator while a scan is running."""
        busy = self._scan is not None and self._scan.running
        return self.operators.take(key, force=not busy)

    def release(self, key: str) -> None:
        """Release the lock of a connection. Raises BusyError while a scan is running."""
        if self._scan is not None and self._scan.running:
            raise BusyError("a scan is running", "Wait for its end, or stop it.")
        self.operators.release(key)

    def tick(self) -> None:
        """Periodic work: called a few times per second."""
        run = self._scan if self._scan is not None and self._scan.running else None
        if self.operators.expire() and run is not None and run.motion.moves:
            run.stop()
        now = time.monotonic()
        idle = run is None
        waiting = self._health_thread is None or not self._health_thread.is_alive()
        if self.operators.connected and idle and waiting and now >= self._health_due:
            self._health_due = now + HEALTH_EVERY_S
            self._health_thread = threading.Thread(target=self._examine, name="station-health", daemon=True)
            self._health_thread.start()

    def _examine(self) -> None:
        with self._radar:
            try:
                findings = tuple(self._check(self.source.config()))
            except TagidError as error:
                findings = (Finding("configuration", "problem", error.message, error.remedy),)
            except Exception:
                logging.getLogger("tagid").debug("health check", exc_info=True)
                return
        self._health = Health(findings, time.monotonic())

    def history(self, wanted: Filter) -> list[dict[str, Any]]:
        """Entries of the history, newest first, at most `HISTORY_LIMIT`. Raises StorageError."""
        return list(History(data_folder() / FILE_NAME).find(wanted))

    def picture(self, number: int) -> bytes:
        """The picture of an entry of the history, PNG.

        The path comes from the history and must be a picture that the station wrote next to its captures.

        Raises NoSuchItemError.
        """
        rows = self.history(Filter(number=number, limit=1))
        if not rows or rows[0]["command"] not in (COMMAND, "scan"):
            raise NoSuchItemError(f"there is no picture of entry {number}")
        path = picture_of(Path(rows[0]["file"]))
        folder = self.source.setup("").folder.resolve()
        if path.resolve().parent != folder:
            raise NoSuchItemError(f"the picture of entry {number} is in another folder")
        try:
            return read_bytes(path, _PICTURE_BYTES)
        except StorageError as error:
            raise NoSuchItemError(f"there is no picture of entry {number}") from error

    def close(self) -> None:
        """Stop a running scan, and wait for its end."""
        self.stop()
        if self._scan is not None:
            self._scan.join(_STOP_S)
        if self._health_thread is not None:
            self._health_thread.join(_STOP_S)
