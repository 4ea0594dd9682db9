"""One scan of the station in a separate thread: record, read, draw, store."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tagid.capture import Capture
from tagid.config import data_folder
from tagid.constants import CAPTURE_SUFFIX
from tagid.errors import CaptureInterrupted, DeviceError, TagidError
from tagid.live.engine import LiveSettings, LiveView
from tagid.live.state import LiveState, Phase
from tagid.metadata import ScanGap
from tagid.motion.device import Motion
from tagid.motion.urls import open_motion
from tagid.pipeline.answer import Identification
from tagid.pipeline.diagnosis import recording_remarks, with_causes
from tagid.pipeline.identify import identify
from tagid.pipeline.load import load_capture
from tagid.pipeline.prepared import PreparedCapture
from tagid.pipeline.turn import resolve_turn
from tagid.recording.intake import notes
from tagid.recording.plan import capture_path
from tagid.recording.radars import open_radar
from tagid.recording.recorder import Watch, record
from tagid.report.picture import Marker, draw_image
from tagid.station.errors import begin, reported
from tagid.station.setup import ScanSetup
from tagid.storage.history import FILE_NAME, History
from tagid.tags.enrolling.registry import Registry
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
        setup: settings of the scan.
        radar: held while the radar is used, so that a health check does not disturb the scan.
        then: called on the scan's thread with the capture's file, the capture with angles, and its answer, if
            neither the recording nor the reading failed.

    Attributes:
        number: as given.
        motion: the device that rotates the object.
    """

    def __init__(
        self, number: int, setup: ScanSetup, radar: threading.Lock, then: Then | None = None
    ) -> None:
        self.number = number
        self._then = then
        self.motion: Motion = open_motion(setup.motion_url)
        self._setup = setup
        self._radar = radar
        self._known = Registry(data_folder() / "registry.sqlite").contents()
        settings = LiveSettings(
            self.motion,
            self._known.layouts,
            self._known.signatures,
            self._known.version,
            setup.reading.imaging,
        )
        self._view = LiveView(settings)
        self._stop = threading.Event()
        self._last_scan_at: float | None = None
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
        """Seconds since the last scan during the recording; 0 otherwise."""
        if self.state.phase is not Phase.TURNING or self._last_scan_at is None:
            return 0.0
        return time.monotonic() - self._last_scan_at

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
        setup, paths = self._setup, [Path()]
        with self._view:
            with self._radar_alone():
                capture = record(
                    open_radar(setup.radar_url, setup.radar_timeout_s),
                    self.motion,
                    setup.plan,
                    capture_path(setup.reading.folder),
                    self._watch(paths.append),
                )
            try:
                loaded = load_capture(capture, setup.reading.loading)
                prepared = PreparedCapture(loaded, setup.reading.imaging)
                answer = identify(
                    prepared,
                    self._known.layouts,
                    registry_version=self._known.version,
                    signatures=self._known.signatures,
                )
            except TagidError as error:
                # The recording is stored; only the reading failed.
                entry = {"code": error.code, "message": error.message, "remedy": error.remedy}
                self._remember(Identification("failed", None, capture.uuid, None, error=entry), paths[-1])
                raise
            self._view.settle(loaded, answer)
        answer = with_causes(answer, prepared, self._known.layouts)
        self._view.explain(answer)
        self._remark = "; ".join((*notes(capture.radar), *recording_remarks(loaded)))
        self._draw(answer, paths[-1])
        self._remember(answer, paths[-1])
        if self._then is not None:
            self._then(paths[-1], loaded, answer)

    def _watch(self, named: Callable[[Path], None]) -> Watch:
        view = self._view

        def gap(gap: ScanGap) -> None:
            view.note(f"the radar was disconnected for {gap.seconds:.1f} s; the recording continues")

        def resolve(capture: Capture, motion: str) -> Capture:
            return resolve_turn(capture, motion)

        return Watch(
            gap=gap,
            named=named,
            resolve=view.resolving(resolve),
            began=view.began,
            scan=self._took,
            ended=view.ended,
            stop=self._stop.is_set,
        )

    def _took(self, scan: Any) -> None:
        self._last_scan_at = time.monotonic()
        self._view.scan(scan)

    def _draw(self, answer: Identification, path: Path) -> None:
        """Write the picture of the last frame next to the capture."""
        image = self.state.image
        if image is None:
            return
        reading = answer.reading
        found = reading.reflectors if reading is not None else ()
        markers = [Marker(p.x_m, p.y_m, str(i + 1), p.matched) for i, p in enumerate(found)]
        title = reading.layout if reading is not None and reading.layout else answer.status.replace("_", " ")
        try:
            draw_image(image.values, image.grid.extent, picture_of(path), str(title), markers)
        except TagidError as error:
            self._remark = f"{self._remark}; no picture: {error.message}".lstrip("; ")

    def _remember(self, answer: Identification, path: Path) -> None:
        setup = self._setup
        try:
            history = History(data_folder() / FILE_NAME)
            run = history.begin(COMMAND, {"radar": setup.radar_url, "motion": setup.plan.motion})
            history.add(run, [{"file": str(path), **answer.to_dict()}])
        except TagidError as error:
            self._remark = f"{self._remark}; not stored in the history: {error.message}".lstrip("; ")


def picture_of(capture: Path) -> Path:
    """The picture that belongs to a capture file."""
    return capture.with_name(f"{capture.name.removesuffix(CAPTURE_SUFFIX)}.png")
