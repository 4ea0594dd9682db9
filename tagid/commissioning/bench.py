"""The rig under test: its settings, what the person measured by tape, and where results are kept.

Every step writes its report and its recording into one folder, so that a later step, or a later day, goes on
from there.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture, Pulse
from tagid.commissioning.rows import Row, StepReport
from tagid.commissioning.targets import Target, parse_target
from tagid.config import Config, data_folder
from tagid.constants import CAPTURE_SUFFIX, SAMPLE_STEP_S
from tagid.errors import ConfigError, FileFormatError, StorageError, UsageError
from tagid.files import make_folder, parse_json, read_bytes, storage_error, write_bytes
from tagid.operate.turn import Recorded, record_turn
from tagid.operate.workplace import Workplace
from tagid.radar.assembler import Scan
from tagid.recording.calibration import LONGEST_DELAY_PS, calibration_window, take_scans
from tagid.recording.plan import RecordingPlan
from tagid.recording.radars import open_radar
from tagid.recording.recorder import Watch
from tagid.recording.stream import ScanStream
from tagid.rig import Measured
from tagid.signal import analytic
from tagid.storage.hdf5 import read_capture, write_capture
from tagid.types import Progress

FOLDER: Final = "commissioning"
STEP_NAMES: Final = ("link", "room", "target", "turning", "card", "result")
"""In their order."""
_MAX_BYTES: Final = 1 << 20
REACH_M: Final = 0.6
"""Half of the window around axis and target: image, pulse, and ranges for the noise."""

_ECHO_WIDTH: Final = 24
"""Characters of an `echo_line`, from the nearest range of the window to the farthest."""
_LEVELS: Final = "▁▂▃▄▅▆▇█"
_STEP_DB: Final = 6.0


@dataclass(frozen=True)
class Tape:
    """What the person tells, remembered from step to step.

    Attributes:
        target: the reference target, see `parse_target`.
        target_distance_m: antennas to the target, in a straight line, m.
        axis_distance_m: antennas to rotation axis, horizontally, m.
        antenna_height_m: antennas above the reflectors' plane, m.
        antenna_separation_m: between transmitting and receiving antenna, m.
        error_m: standard error of the tape measure, m.
    """

    target: str = "octahedron:40mm"
    target_distance_m: float | None = None
    axis_distance_m: float | None = None
    antenna_height_m: float = 0.0
    antenna_separation_m: float = 0.0
    error_m: float = 0.005

    def __post_init__(self) -> None:
        parse_target(self.target)
        for name, value in (("target", self.target_distance_m), ("rotation axis", self.axis_distance_m)):
            if value is not None and not 0.1 <= value <= 20:
                raise UsageError(f"the distance to the {name} is {value:g} m", "Give 0.1 to 20, in metres.")
        if not abs(self.antenna_height_m) <= 10:
            raise UsageError(
                f"the antenna height is {self.antenna_height_m:g} m", "Give -10 to 10, in metres."
            )
        if not 0 <= self.antenna_separation_m <= 10:
            raise UsageError(
                f"the antennas' separation is {self.antenna_separation_m:g} m", "Give 0 to 10, in metres."
            )
        if not 0 < self.error_m <= 0.1:
            raise UsageError(f"the error of the tape is {self.error_m:g} m", "Give up to 0.1 m, e.g. 0.005.")


TapeChanges = Mapping[str, str | float | None]
"""Values of `Tape` that the person gave now, by their names; None, or no entry, where not given."""


class Bench:
    """A rig while it is commissioned.

    Args:
        config: settings of radar and motion.
        changes: what the person measured by tape now; `tape` is what was measured now or before.
        seconds: how long the link is watched.
        scans: of a recording of a scene that stands still.
        stop: whether to end a recording; asked about ten times per second.

    Raises StorageError: the folder cannot be read. ConfigError: it holds damaged files.
    """

    def __init__(
        self,
        config: Config,
        changes: TapeChanges,
        seconds: float = 30.0,
        scans: int = 200,
        progress: Progress = lambda done, total, remark: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        self.config, self.seconds, self.scans, self.progress = config, seconds, scans, progress
        self.stop = stop
        self.folder = data_folder() / FOLDER
        given: dict[str, Any] = {name: value for name, value in changes.items() if value is not None}
        try:
            self.tape = replace(Tape(**(self._read("tape") or {})), **given)
        except TypeError:
            raise _damaged(self.folder / "tape.json") from None
        if self.tape.axis_distance_m is None and config["motion.axis_distance_m"] is not None:
            self.tape = replace(self.tape, axis_distance_m=config["motion.axis_distance_m"])
        if given:
            self._write("tape", asdict(self.tape))

    @property
    def target(self) -> Target:
        """The reference target."""
        return parse_target(self.tape.target)

    def axis_distance_m(self) -> float:
        """Distance to the axis by tape. Raises ConfigError if nobody measured it."""
        if self.tape.axis_distance_m is None:
            raise ConfigError(
                "the distance from the antennas to the rotation axis is unknown",
                "Measure it to 1 or 2 cm, horizontally: `axis_distance=METRES`.",
            )
        return self.tape.axis_distance_m

    def report(self, step: str) -> StepReport | None:
        """The stored report of a step; None if it was not done. Raises StorageError, ConfigError."""
        data = self._read(step)
        try:
            return None if data is None else StepReport.from_json(data)
        except (KeyError, TypeError, ValueError, AttributeError):
            raise _damaged(self.folder / f"{step}.json") from None

    def reports(self) -> dict[str, StepReport]:
        """The stored reports of the steps that were done, by their names. Raises as `report`."""
        every = {step: self.report(step) for step in STEP_NAMES}
        return {step: report for step, report in every.items() if report is not None}

    def keep(self, report: StepReport) -> None:
        """Store the report of a step. Raises StorageError, DiskFullError."""
        self._write(report.step, report.to_json())

    def value(self, step: str, name: str) -> Measured | None:
        """A value that an earlier step measured; None if it was not done or measured none."""
        report = self.report(step)
        return None if report is None else report.values.get(name)

    def pulse(self) -> Pulse | None:
        """The pulse that the step `target` measured."""
        report = self.report("target")
        return None if report is None or not report.pulse else Pulse(np.array(report.pulse), SAMPLE_STEP_S)

    def recording(self, name: str) -> Capture:
        """A recording of an earlier step. Raises ConfigError if it cannot be read."""
        try:
            return read_capture(self.folder / f"{name}{CAPTURE_SUFFIX}")
        except (StorageError, FileFormatError) as error:
            raise ConfigError(error.message, f"Repeat the step {name}.") from None

    def keep_recording(self, name: str, capture: Capture) -> str:
        """Store the recording of a step, in place of an earlier one; returns the file's name."""
        path = self.folder / f"{name}{CAPTURE_SUFFIX}"
        make_folder(self.folder)
        write_capture(path, capture)
        return path.name

    def keep_file(self, name: str, recorded: Path) -> str:
        """As `keep_recording`, of a file that was just recorded. Raises StorageError."""
        path = self.folder / f"{name}{CAPTURE_SUFFIX}"
        try:
            recorded.replace(path)
        except OSError as error:
            raise storage_error(error, path, "keeping") from None
        return path.name

    def workplace(self, **settings: Any) -> Workplace:
        """A workplace with what was measured so far; captures go to the folder of the commissioning.

        Args:
            settings: by their names with dots written as double underscores; they precede all others.
        """
        known: dict[str, Any] = {
            name: value.value for name, value in self.config.values.items() if value.source != "default"
        }
        known |= {
            "motion.axis_distance_m": self.axis_distance_m(),
            "motion.antenna_height_m": self.tape.antenna_height_m,
            "motion.antenna_separation_m": self.tape.antenna_separation_m,
            "storage.folder": str(self.folder),
        }
        delay = self.value("target", "path_delay_ps")
        if delay is not None:
            known["radar.cable_delay_ps"] = delay.value
        return Workplace({**known, **{name.replace("__", "."): value for name, value in settings.items()}})

    def take_turn(self, place: Workplace, plan: RecordingPlan, remark: str) -> Recorded:
        """A recording of the table as it turns. Raises as `record_turn`."""
        asked, streams = plan.scans, list[ScanStream]()

        def advance(scans: int, seconds: float) -> None:
            newest = [echo_line(scan.samples) for stream in streams for scan in stream.since(scans - 1)[:1]]
            words = f"{remark}, {scans} scans {''.join(newest)}"
            self.progress(min(scans, asked or 0), asked or 1, words)

        watch = Watch(progress=advance, began=streams.append, stop=self.stop)
        return record_turn(place, plan, watch=watch)

    def take_still(self, what: str) -> Capture:
        """Scans of a scene that stands still, with a window for axis and target and any usual delay.

        Raises DeviceError and its subclasses, DataError, ConfigError.
        """
        axis = self.axis_distance_m()
        distances = [max(axis - REACH_M, 0.0), axis + REACH_M]
        if self.tape.target_distance_m is not None:
            distances.append(self.tape.target_distance_m)
        config, place = self.config, self.workplace()
        with open_radar(place.radar_url(), config["radar.timeout_s"]) as radar:
            base = radar.config.configured(config)
            radar.set_config(calibration_window(distances, LONGEST_DELAY_PS, base))

            def advance(done: int, scan: Scan) -> None:
                self.progress(done, self.scans, f"{what}, {done} scans {echo_line(scan.samples)}")

            return take_scans(radar, self.scans, advance)

    def _read(self, name: str) -> Any:
        path = self.folder / f"{name}.json"
        if not path.exists():
            return None
        try:
            return parse_json(read_bytes(path, _MAX_BYTES), str(path))
        except FileFormatError:
            raise _damaged(path) from None

    def _write(self, name: str, data: dict[str, Any]) -> None:
        make_folder(self.folder)
        write_bytes(self.folder / f"{name}.json", (json.dumps(data, indent=1) + "\n").encode())


def reported(step: str, rows: list[Row], **more: Any) -> StepReport:
    """The report of a step that ends now."""
    return StepReport(step, datetime.now(UTC).isoformat(timespec="seconds"), tuple(rows), **more)


def radar_facts(capture: Capture) -> dict[str, str | int]:
    """Which radar recorded a capture, for a report."""
    serial = capture.radar.serial
    return {} if serial is None else {"serial": serial}


def _damaged(path: Path) -> ConfigError:
    return ConfigError(f"{path} is damaged", "Delete it and repeat that step.")


def echo_line(samples: NDArray[np.generic]) -> str:
    """A scan as text: the largest echo of every part of the window, in steps of 6 dB below the greatest.

    >>> echo_line(np.where(np.arange(240) == 200, 100, 1))[20]
    '█'
    """
    envelope = np.abs(analytic(np.asarray(samples)[None]))[0]
    peaks = np.array([part.max() for part in np.array_split(envelope, _ECHO_WIDTH) if part.size])
    below = -20 * np.log10(np.maximum(peaks, 1e-9) / max(float(envelope.max()), 1e-9))
    steps = np.clip(len(_LEVELS) - 1 - below // _STEP_DB, 0, None).astype(int)
    return "".join(_LEVELS[step] for step in steps)
