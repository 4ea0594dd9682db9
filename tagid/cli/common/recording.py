"""Shared by the commands that record: from the configuration to a recording plan."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tagid.config import Config
from tagid.errors import ConfigError, StorageError
from tagid.files import make_folder

if TYPE_CHECKING:
    from tagid.metadata import ObjectInfo
    from tagid.radar.settings import RadarConfig
    from tagid.recording.plan import RecordingPlan


@dataclass(frozen=True)
class Limits:
    """Limits of a recording, besides the end of the revolution.

    Attributes:
        scans: number of scans; None to record a full revolution.
        max_seconds: longest duration, s.
    """

    scans: int | None
    max_seconds: float


def radar_url(config: Config) -> str:
    """URL of the configured radar. Raises ConfigError if there is none."""
    url = config["radar.url"]
    if not url:
        raise ConfigError(
            "no radar is configured",
            "Give --radar udp://192.168.1.100, or store it with `tagid config set radar.url udp://...`; "
            "`tagid scan --demo` shows a scan without a radar.",
        )
    return str(url)


def capture_folder(config: Config) -> Path:
    """The folder of the captures, created durably if it is missing. Raises StorageError."""
    folder = Path(config["storage.folder"] or ".")
    try:
        make_folder(folder)
    except OSError as error:
        raise StorageError(f"cannot make the folder {folder}: {error.strerror}", "Choose another.") from None
    return folder


def plan_of(config: Config, url: str, limits: Limits, about: ObjectInfo) -> RecordingPlan:
    """The recording plan. Raises ConfigError."""
    from tagid.recording.plan import RecordingPlan

    if limits.scans is not None and not 1 <= limits.scans <= 65534:
        raise ConfigError(f"--scans is {limits.scans}", "Give 1 to 65534.")
    if not 0 < limits.max_seconds <= 86400:
        raise ConfigError(f"--max-seconds is {limits.max_seconds}", "Give a positive number of seconds.")
    return RecordingPlan(
        _window(config, url),
        config["motion.axis_distance_m"],
        config["motion.antenna_height_m"],
        config["motion.antenna_separation_m"],
        config["radar.cable_delay_ps"],
        limits.scans,
        limits.max_seconds,
        config["motion.url"].public,
        about,
        config["radar.resume_s"],
    )


def _window(config: Config, url: str) -> RadarConfig | None:
    """The radar settings to request; None keeps those of a replayed recording."""
    from tagid.radar.settings import RadarConfig
    from tagid.recording.plan import plan_window

    distance = config["motion.axis_distance_m"]
    if url.startswith("replay://"):
        return None
    base = RadarConfig(
        base_integration_index=config["radar.integration"],
        transmit_gain=config["radar.gain"],
        antenna_mode=config["radar.antenna_mode"],
    )
    if distance is None:
        raise ConfigError(
            "the distance from the radar to the rotation axis is unknown",
            "Measure it to 1 or 2 cm and give --axis-distance METRES, or store it with "
            "`tagid config set motion.axis_distance_m METRES`.",
        )
    return plan_window(distance, config["imaging.extent_m"], config["radar.cable_delay_ps"], base)
