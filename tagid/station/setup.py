"""Settings of the station, from the configuration at the start of each scan, report or enrolment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tagid.config import Config
from tagid.pipeline.load import LoadSettings
from tagid.pipeline.settings import ImagingSettings
from tagid.recording.plan import RecordingPlan
from tagid.secret import MotionUrl


@dataclass(frozen=True, eq=False)
class ReadingSetup:
    """Settings of reading captures.

    Attributes:
        folder: where captures and reports are written.
        loading, imaging: settings of reading and imaging.
    """

    folder: Path
    loading: LoadSettings
    imaging: ImagingSettings


@dataclass(frozen=True, eq=False)
class ScanSetup:
    """Settings of one scan.

    Attributes:
        radar_url, radar_timeout_s: the radar, and the time without data after which it counts as lost.
        motion_url: the device that rotates the object.
        plan: the recording plan.
        reading: settings of reading the capture.
    """

    radar_url: str
    radar_timeout_s: float
    motion_url: str | MotionUrl
    plan: RecordingPlan
    reading: ReadingSetup


@dataclass(frozen=True)
class Source:
    """Source of the station's settings; queried whenever they are needed.

    Attributes:
        config: the current configuration.
        reading: settings of reading captures; available without a radar. Raises ConfigError, UsageError,
            StorageError.
        scan: settings of a scan with a note for its capture. Raises as `reading` does.
        demo: whether an emulated radar is used.
    """

    config: Callable[[], Config]
    reading: Callable[[], ReadingSetup]
    scan: Callable[[str], ScanSetup]
    demo: bool = False
