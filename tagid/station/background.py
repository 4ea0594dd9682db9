"""Work of the station in a thread of its own: begun once, stopped on request, waited for."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod

from tagid.station.errors import begin
from tagid.workers import Worker


class BackgroundRun(ABC):
    """One piece of work."""

    def __init__(self, name: str) -> None:
        self._stop = threading.Event()
        self._thread = Worker(self._run, name, self._fail)

    def start(self) -> None:
        """Begin. Raises OverloadedError."""
        begin(self._thread)

    def stop(self) -> None:
        """Request its end; what is done by then is kept."""
        self._stop.set()

    def join(self, seconds: float) -> None:
        self._thread.join(seconds)

    @property
    def running(self) -> bool:
        return self._thread.alive

    @abstractmethod
    def _run(self) -> None:
        """The work, on its thread."""

    @abstractmethod
    def _fail(self, error: BaseException) -> None:
        """What ended the work."""
