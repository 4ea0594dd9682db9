"""One scan of the station in a separate thread: record, read, draw, store."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

from tagid.capture import Capture
from tagid.errors import CaptureInterrupted, DeviceError, TagidError
from tagid.live.engine import LiveSettings, LiveView
from tagid.live.sure import EarlyEnding, check_angle_known
from tagid.metadata import ScanGap
from tagid.motion.device import Motion
from tagid.motion.urls import open_motion
from tagid.operate.turn import (
    Answer,
    Drawn,
    draw,
    draw_residuals_of,
    picture_of,
    read,
    record_turn,
    residuals_beside,
)
from tagid.operate.words import ending_words
from tagid.operate.workplace import Workplace
from tagid.pipeline.answer import Identification
from tagid.pipeline.turn import resolve_turn
from tagid.reading.looks import SPENT
from tagid.recording.plan import RecordingPlan
from tagid.recording.recorder import Watch
from tagid.station.background import BackgroundRun
from tagid.station.errors import reported

Then = Callable[[Path, Capture, Identification], None]
COMMAND = "station"
"""Name of the station's runs in the history."""
_RADAR_S = 60.0
"""Longest wait for a health check; its own waits for a radar are shorter, s."""


@contextmanager
def radar_alone(radar: threading.Lock, stop: threading.Event) -> Iterator[None]:
    """Hold the radar, which a health check may be using. Raises CaptureInterrupted, DeviceError."""
    end = time.monotonic() + _RADAR_S
    while not radar.acquire(timeout=0.1):
        if stop.is_set():
            raise CaptureInterrupted("stopped before the first scan")
        if time.monotonic() > end:
            raise DeviceError("the health check still uses the radar", "Check the radar's connection.")
    try:
        yield
    finally:
        radar.release()


class Run(BackgroundRun):
    """A running or finished scan, or the reading of a file.

    Attributes:
        number: counts the station's scans.
        motion: the device that rotates the object, for the live view.
        view: with the state of the recording.
        file: name of the file that is read; empty for a scan.
        remark: on files that could not be written; empty if none.
        residuals: the picture of what competing hypotheses leave of the echo; None if there is none.
        device_failed: whether the radar or the motion failed.
    """

    file = ""

    def __init__(self, number: int, place: Workplace, motion: Motion) -> None:
        self.number = number
        self.motion = motion
        self._place = place
        self._setup = place.setup(as_recorded=True)
        enrolled = self._setup.enrolled
        self._needs = LiveSettings(
            motion, enrolled.layouts, enrolled.signatures, enrolled.version, self._setup.imaging
        )
        self.view = LiveView(self._needs)
        self.remark = ""
        self.residuals: Path | None = None
        self.device_failed = False
        super().__init__(f"station-scan-{number}")

    def _fail(self, error: BaseException) -> None:
        self.device_failed = isinstance(error, DeviceError)
        self.view.fail(reported(error))

    def _draw(self, answer: Answer, path: Path) -> tuple[Drawn | None, list[str]]:
        """The image with its picture and that of the residuals beside the capture, and what failed."""
        png = picture_of(path)
        try:
            drawn = draw(answer, png)
            draw_residuals_of(answer.identification, residuals_beside(png))
        except TagidError as error:
            return None, [f"no picture: {error.message}"]
        if residuals_beside(png).is_file():
            self.residuals = residuals_beside(png)
        return drawn, []


class ScanRun(Run):
    """A scan of the object on the table, which may end as soon as the answer is certain.

    Args:
        radar: held while the radar is used, so that a health check does not disturb the scan.
        then: called on the scan's thread with the capture's file, the capture with angles, and its answer, if
            neither the recording nor the reading failed.

    Raises ConfigError if the answer cannot be certain before the end, because the angle is not known.
    """

    def __init__(
        self,
        number: int,
        place: Workplace,
        plan: RecordingPlan,
        radar: threading.Lock,
        then: Then | None = None,
        until_sure: bool = False,
    ) -> None:
        super().__init__(number, place, open_motion(place.config["motion.url"]))
        self._then = then
        self._plan = plan
        self._radar = radar
        self._until_sure = until_sure
        if until_sure:
            check_angle_known(self.motion, plan.motion)
            self._plan = replace(plan, spent=SPENT)

    def _run(self) -> None:
        picture: Drawn | None = None
        with self.view:
            remarks = []
            with radar_alone(self._radar, self._stop), ExitStack() as ending:
                watch = self._watch()
                early = ending.enter_context(EarlyEnding(self._needs)) if self._until_sure else None
                if early is not None:
                    watch = early.watching(watch)
                recorded = record_turn(self._place, self._plan, self.motion, watch)
            if early is not None:
                if words := ending_words(recorded.capture.radar.ended):
                    self.view.note(f"ended {words}")
                remarks += [early.remark] if early.remark else []
            answer = read(self._setup, recorded.capture, recorded.path, self.view)
            remarks += answer.remarks
            if answer.error is None:
                picture, failed = self._draw(answer, recorded.path)
                remarks += failed
            radar = {"radar": self._place.radar_url(), "motion": self._plan.motion}
            remarks += self._place.remember(COMMAND, [answer.to_dict()], radar)
            self.remark = "; ".join(remarks)
            if answer.error is not None:
                # The recording is stored; only the reading failed.
                raise answer.error
        if picture is not None:
            self.view.show(picture.result.image)
        if self._then is not None and answer.prepared is not None:
            self._then(recorded.path, answer.prepared.given, answer.identification)

    def _watch(self) -> Watch:
        view = self.view

        def gap(gap: ScanGap) -> None:
            view.note(f"the radar was disconnected for {gap.seconds:.1f} s; the recording continues")

        resolve = view.resolving(resolve_turn)
        return Watch(gap=gap, resolve=resolve, began=view.began, stop=self._stop.is_set)
