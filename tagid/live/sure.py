"""Ends a scan before the turn does, once the answer is certain.

The scans are read at fixed shares of the turn (`tagid.reading.looks`) in a separate thread. Two successive
looks have to name the same layout, with a lead that the calibration bears out.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tagid.capture import Capture
from tagid.errors import ConfigError, TagidError
from tagid.live.angles import LiveAngles
from tagid.live.engine import LiveSettings
from tagid.live.views import capture_so_far
from tagid.metadata import Ending
from tagid.motion.device import Motion
from tagid.pipeline.identify import SURE
from tagid.reading.ending import EndingCalibration
from tagid.reading.looks import LEAST_REFLECTORS, LOOKS, Look, agreed, look, part_of_turn
from tagid.recording.recorder import Watch
from tagid.secret import MotionUrl
from tagid.workers import Worker

if TYPE_CHECKING:
    from tagid.radar.assembler import Scan
    from tagid.recording.stream import ScanStream

MOST_SCALE_SIGMA = 0.035
"""Largest relative standard deviation of a device's angle scale: the calibration of early endings includes
errors of 3 %, the slip of a calibrated robot. An uncalibrated robot (6 %) is corrected by the scans of a
whole turn only."""
_WHOLE = "`until_sure` recorded the whole revolution"
_JOIN_S = 30.0


def check_angle_known(motion: Motion, motion_url: str | MotionUrl) -> None:
    """Raise ConfigError if the angle would only be known after the turn, from the scans."""
    if motion.measures or motion.nominal_s is not None:
        return
    raise ConfigError(
        f"`until_sure` needs the angle during the scan, but with the motion {motion_url} it is found in the "
        "scans after the turn",
        "Give the speed (`motion.url=free?rpm=2`), use a device that measures its angle, or omit "
        "`until_sure`.",
    )


class EarlyEnding:
    """Reads a recording at the looks and decides whether it may end; use it as a context manager.

    Without a calibration the package's own serves.

    Attributes:
        remark: why this scan cannot end early, for the user; empty if it can.
        considered: number of scans considered so far.
        looks: the looks so far.
    """

    def __init__(self, settings: LiveSettings, calibration: EndingCalibration | None = None) -> None:
        self._settings = settings
        self._calibration = calibration or EndingCalibration.shipped()
        self._angles = LiveAngles(settings.motion)
        self.remark = self._why_not()
        self.considered = 0
        self.looks: list[Look] = []
        self._ending: Ending | None = None
        self._worker: Worker | None = None

    def __enter__(self) -> EarlyEnding:
        return self

    def __exit__(self, *_: object) -> None:
        if self._worker is not None:
            self._worker.join(_JOIN_S)

    def _why_not(self) -> str:
        known, false_accept = self._settings, self._settings.imaging.false_accept
        if not known.layouts:
            return f"{_WHOLE}: no layout is enrolled"
        if max(layout.size for layout in known.layouts) < LEAST_REFLECTORS:
            return f"{_WHOLE}: no enrolled layout has {LEAST_REFLECTORS} reflectors or more"
        if not known.imaging.direction_known:
            return f"{_WHOLE}: the direction of rotation is unknown"
        if not self._calibration.reaches(false_accept):
            turns = self._calibration.turns
            return (
                f"{_WHOLE}: the calibration of early endings holds {turns} revolutions, too few for "
                f"tags.false_accept = {false_accept:g}"
            )
        return ""

    def watching(self, watch: Watch) -> Watch:
        """The callbacks of a recording with those of the early ending added."""

        def began(stream: ScanStream) -> None:
            watch.began(stream)
            self._worker = Worker(
                lambda: self._work(stream), "live-ending", self._failed, lambda: stream.ended
            )
            try:
                self._worker.start()
            except RuntimeError as error:
                self._failed(error)

        return replace(watch, began=began, enough=self.enough)

    def enough(self) -> Ending | None:
        """Why the recording may end; None while it may not."""
        return self._ending

    def _failed(self, error: BaseException) -> None:
        """Without a decision the whole turn is recorded."""
        self.remark = f"{_WHOLE}: reading ahead stopped (unexpected {type(error).__name__})"

    def _work(self, stream: ScanStream) -> None:
        while stream.wait(self.considered) and self._ending is None and not self.remark:
            scans = stream.since()
            try:
                self._consider(stream, scans)
            except TagidError as error:
                # More scans may allow what these did not.
                logging.getLogger("tagid").debug("early ending: %s", error.message)
            self.considered = len(scans)

    def _consider(self, stream: ScanStream, scans: Sequence[Scan]) -> None:
        """Take the looks that are due with the scans so far."""
        track = self._settings.motion.track()
        if track is not None and float(track.info.get("scale_sigma", 0.0)) > MOST_SCALE_SIGMA:
            self.remark = f"{_WHOLE}: the angle of the device is not calibrated (`tagid motion calibrate`)"
            return
        angles = self._angles.of(scans)
        if angles is None:
            return
        turned = float(np.abs(angles - angles[0]).max())
        while len(self.looks) < len(LOOKS) and self._ending is None and not stream.ended:
            share = LOOKS[len(self.looks)]
            if turned <= 2 * np.pi * share:
                return
            capture = replace(capture_so_far(stream.session, scans), angles_rad=angles)
            self.looks.append(self._look(capture, share))
            self._ending = self._decided()

    def _look(self, capture: Capture, share: float) -> Look:
        part = part_of_turn(capture, share)
        if part.views < self._calibration.fewest_views * share:
            # No calibration bears out an ending, so the reading would not matter.
            return Look(share, part.views)
        settings = self._settings
        return look(part, settings.layouts, share, settings.signatures)

    def _decided(self) -> Ending | None:
        """Why the looks so far are enough; None if they are not."""
        name, _ = agreed(self.looks)
        if name is None:
            return None
        newest = self.looks[-1]
        bound = self._calibration.bound(self.looks, self._settings.imaging.false_accept)
        if not (bound.reachable and bound.kept):
            return None
        return Ending(SURE, newest.share, name, bound.p_value, bound.objects)
