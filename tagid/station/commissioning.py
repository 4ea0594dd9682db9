"""A step of the commissioning, with the functions of `tagid commission`, and the state of all steps."""

from __future__ import annotations

import threading
from dataclasses import dataclass, fields

from tagid.commissioning.bench import Bench, Tape, TapeChanges
from tagid.commissioning.pictures import to_svg
from tagid.commissioning.steps import Step, goes_on, reports_by_title, run_step
from tagid.config import Config, data_folder
from tagid.errors import CaptureInterrupted, TagidError, UsageError
from tagid.motion.urls import open_motion
from tagid.operate.workplace import Workplace
from tagid.rig import installed_profile
from tagid.station.background import BackgroundRun
from tagid.station.errors import NoSuchItemError, reported
from tagid.station.scans import radar_alone

TAPE_NUMBERS = tuple(field.name for field in fields(Tape) if field.name != "target")
"""Lengths of `Tape` that a page may give."""


@dataclass(frozen=True)
class StepProgress:
    """How far a step is.

    Attributes:
        step: its name; None before the first one.
        share: 0 to 1; 0 where the step does not tell.
        remark: what it does.
        error: why it ended without a report; None if it did not.
    """

    step: str | None
    share: float = 0.0
    remark: str = ""
    error: TagidError | None = None


def results_page(config: Config) -> bytes:
    """The results so far as a PDF. Raises NoSuchItemError before the first one; StorageError, ConfigError."""
    from tagid.commissioning.page import to_pdf

    reports = reports_by_title(Bench(config, {}))
    if not reports:
        raise NoSuchItemError("no step was done yet", "Start the first one.")
    return to_pdf(reports, installed_profile(data_folder()))


def results_picture(config: Config, step: str, number: int) -> bytes:
    """A picture of a step's report as SVG. Raises NoSuchItemError, StorageError, ConfigError."""
    report = Bench(config, {}).report(step)
    if report is None or number >= len(report.pictures):
        raise NoSuchItemError(f"the step {step} has no such picture", "Do the step, then ask again.")
    return to_svg(report.pictures[number]).encode()


class CommissioningRun(BackgroundRun):
    """One step, and those after it for which nobody has to do anything.

    The tape is what the person measured now; `radar` is held while the radar is used; `progress` is the
    newest state.

    Raises:
        UsageError: a distance is out of range, or the step would move a device, which no page can stop.
        ConfigError, StorageError: see `Bench`.
    """

    def __init__(self, place: Workplace, step: Step, tape: TapeChanges, radar: threading.Lock) -> None:
        super().__init__("station-commissioning")
        if step.turns and open_motion(place.config["motion.url"]).moves:
            raise UsageError(
                f"the step {step.name} moves {place.config['motion.url'].public}",
                f"Stand beside it and do this step with `tagid commission --step {step.name}`.",
            )
        self._step, self._radar = step, radar
        self.progress = StepProgress(step.name)
        self._bench = Bench(place.config, tape, progress=self._advance, stop=self._stop.is_set)

    def _advance(self, done: float, total: float, remark: str) -> None:
        if self._stop.is_set():
            raise CaptureInterrupted("stopped before the end of the step; earlier results are kept")
        self.progress = StepProgress(self._step.name, done / total, remark)

    def _run(self) -> None:
        with radar_alone(self._radar, self._stop):
            step: Step | None = self._step
            while step is not None:
                self._step, self.progress = step, StepProgress(step.name)
                run_step(step, self._bench)
                step = goes_on(step, self._bench)

    def _fail(self, error: BaseException) -> None:
        self.progress = StepProgress(self._step.name, error=reported(error))
