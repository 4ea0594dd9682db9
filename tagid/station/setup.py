"""What one scan of the station needs, as the configuration stands when it begins."""

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
    """What one scan needs.

    Attributes:
        radar_url, radar_timeout_s: the radar, and the silence after which it counts as lost.
        motion_url: what turns the object.
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
    """Where the station gets its settings from; asked anew for each scan.

    Attributes:
        config: the configuration as it stands.
        setup: the setup of a scan with a note for its capture. Raises ConfigError, UsageError, StorageError.
        demo: whether an emulated radar is used.
    """

    config: Callable[[], Config]
    setup: Callable[[str], ScanSetup]
    demo: bool = False
