"""Settings of one scan of the station, from the configuration at its start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tagid.config import Config
from tagid.pipeline.load import LoadSettings
from tagid.pipeline.settings import ImagingSettings
from tagid.recording.plan import RecordingPlan


@dataclass(frozen=True, eq=False)
class ScanSetup:
    """Settings of one scan.

    Attributes:
        radar_url, radar_timeout_s: the radar, and the time without data after which it counts as lost.
        motion_url: the device that rotates the object.
        plan: the recording plan.
        folder: where captures are written.
        loading, imaging: settings of reading and imaging.
    """

    radar_url: str
    radar_timeout_s: float
    motion_url: str
    plan: RecordingPlan
    folder: Path
    loading: LoadSettings
    imaging: ImagingSettings


@dataclass(frozen=True)
class Source:
    """Source of the station's settings; queried for each scan.

    Attributes:
        config: the current configuration.
        setup: the setup of a scan with a note for its capture. Raises ConfigError, UsageError, StorageError.
        demo: whether an emulated radar is used.
    """

    config: Callable[[], Config]
    setup: Callable[[str], ScanSetup]
    demo: bool = False
