"""One scan of the station in a separate thread: record, read, draw, store."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from tagid.capture import Capture
from tagid.errors import CaptureInterrupted, DeviceError, TagidError
from tagid.live.engine import LiveSettings, LiveView
from tagid.live.state import LiveState
from tagid.metadata import ScanGap
from tagid.motion.device import Motion
from tagid.motion.urls import open_motion
from tagid.operate.turn import Drawn, draw, picture_of, read, record_turn
from tagid.operate.workplace import Workplace
from tagid.pipeline.answer import Identification
from tagid.pipeline.turn import resolve_turn
from tagid.recording.plan import RecordingPlan
from tagid.recording.recorder import Watch
from tagid.station.errors import begin, reported
from tagid.workers import Worker

Then = Callable[[Path, Capture, Identification], None]
COMMAND = "station"
"""Name of the station's runs in the history."""
_RADAR_S = 60.0
"""Longest wait for a health check; its own waits for a radar are shorter, s."""


class ScanRun:
    """A running or finished scan.

    Args:
        number: counts the station's scans.
        place: settings, registry, history and folder.
        plan: of the recording.
        radar: held while the radar is used, so that a health check does not disturb the scan.
        then: called on the scan's thread with the capture's file, the capture with angles, and its answer, if
            neither the recording nor the reading failed.

    Attributes:
        number: as given.
        motion: the device that rotates the object.
    """

    def __init__(
        self,
        number: int,
        place: Workplace,
        plan: RecordingPlan,
        radar: threading.Lock,
        then: Then | None = None,
    ) -> None:
        self.number = number
        self._then = then
        self._place, self._plan = place, plan
        self.motion: Motion = open_motion(place.config["motion.url"])
        self._radar = radar
        self._setup = place.setup(as_recorded=True)
        enrolled = self._setup.enrolled
        settings = LiveSettings(
            self.motion, enrolled.layouts, enrolled.signatures, enrolled.version, self._setup.imaging
        )
        self._view = LiveView(settings)
        self._stop = threading.Event()
        self._remark = ""
        self._device_failed = False
        self._thread = Worker(self._run, f"station-scan-{number}", self._fail)

    def start(self) -> None:
        """Begin. Raises OverloadedError."""
        begin(self._thread)

    def stop(self) -> None:
        """Request its end; the motion stops, and the recorded scans are kept."""
        self._stop.set()

    def join(self, seconds: float) -> None:
        """Wait for its end."""
        self._thread.join(seconds)

    @property
    def running(self) -> bool:
        """Whether it still records, reads or writes."""
        return self._thread.alive

    @property
    def state(self) -> LiveState:
        """The newest state."""
        return self._view.state

    @property
    def remark(self) -> str:
        """Remark on files that could not be written; empty if none."""
        return self._remark

    @property
    def device_failed(self) -> bool:
        """Whether the radar or the motion failed."""
        return self._device_failed

    @property
    def silent_s(self) -> float:
        """Seconds for which the recording has waited for its next scan; 0 while it does not wait."""
        return self._view.silent_s

    def _fail(self, error: BaseException) -> None:
        self._device_failed = isinstance(error, DeviceError)
        self._view.fail(reported(error))

    @contextmanager
    def _radar_alone(self) -> Iterator[None]:
        """Hold the radar, which a health check may be using. Raises CaptureInterrupted, DeviceError."""
        end = time.monotonic() + _RADAR_S
        while not self._radar.acquire(timeout=0.1):
            if self._stop.is_set():
                raise CaptureInterrupted("stopped before the first scan")
            if time.monotonic() > end:
                raise DeviceError("the health check still uses the radar", "Check the radar's connection.")
        try:
            yield
        finally:
            self._radar.release()

    def _run(self) -> None:
        picture: Drawn | None = None
        with self._view:
            with self._radar_alone():
                recorded = record_turn(self._place, self._plan, self.motion, self._watch())
            answer = read(self._setup, recorded.capture, recorded.path, self._view)
            remarks = list(answer.remarks)
            if answer.error is None:
                try:
                    picture = draw(answer, picture_of(recorded.path))
                except TagidError as error:
                    remarks.append(f"no picture: {error.message}")
            radar = {"radar": self._place.radar_url(), "motion": self._plan.motion}
            remarks += self._place.remember(COMMAND, [answer.to_dict()], radar)
            self._remark = "; ".join(remarks)
            if answer.error is not None:
                # The recording is stored; only the reading failed.
                raise answer.error
        if picture is not None:
            self._view.show(picture.result.image)
        if self._then is not None and answer.prepared is not None:
            self._then(recorded.path, answer.prepared.given, answer.identification)

    def _watch(self) -> Watch:
        view = self._view

        def gap(gap: ScanGap) -> None:
            view.note(f"the radar was disconnected for {gap.seconds:.1f} s; the recording continues")

        def resolve(capture: Capture, motion: str) -> Capture:
            return resolve_turn(capture, motion)

        return Watch(
            gap=gap,
            resolve=view.resolving(resolve),
            began=view.began,
            stop=self._stop.is_set,
        )
