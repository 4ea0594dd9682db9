"""The recording plan: radar settings, geometry, limits and file names."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from tagid.constants import CAPTURE_SUFFIX, SPEED_OF_LIGHT
from tagid.errors import ConfigError, StorageError
from tagid.metadata import ObjectInfo
from tagid.radar.resume import RESUME_S
from tagid.radar.settings import RadarConfig
from tagid.storage.journal import SUFFIX as JOURNAL_SUFFIX

_MARGIN_M = 0.35
"""Margin on both sides of the image: pulse length, autofocus, and clutter-free bins for the noise."""


@dataclass(frozen=True)
class RecordingPlan:
    """A recording plan.

    Attributes:
        config: requested radar settings; None keeps those of the radar.
        axis_distance_m, antenna_height_m: of the antenna, m; the distance may be None (unknown).
        antenna_separation_m: from the transmitting to the receiving antenna, m; 0: one antenna.
        cable_delay_ps: two-way delay to subtract from the ranges, ps.
        scans: number of scans; None to record until the motion reports a full turn.
        max_seconds: longest recording, s.
        motion: URL of the motion device, stored with the capture.
        object: metadata of the object.
        resume_s: how long to wait for a radar that was lost, s.
        renumber: use the next free name if the requested one exists.
        spent: share of the false-accept probability that readings during the recording use.
    """

    config: RadarConfig | None
    axis_distance_m: float | None
    antenna_height_m: float = 0.0
    antenna_separation_m: float = 0.0
    cable_delay_ps: float = 0.0
    scans: int | None = None
    max_seconds: float = 180.0
    motion: str = "free"
    object: ObjectInfo = field(default_factory=ObjectInfo)
    resume_s: float = RESUME_S
    renumber: bool = False
    spent: float = 0.0


def plan_window(
    axis_distance_m: float, extent_m: float, cable_delay_ps: float, base: RadarConfig
) -> RadarConfig:
    """The settings whose range window covers the object and a margin.

    Raises ConfigError if the radar would be inside the image.
    """
    reach = extent_m / np.sqrt(2) + _MARGIN_M
    if axis_distance_m <= extent_m / 2:
        raise ConfigError(
            f"the axis distance is {axis_distance_m} m, but the image reaches {extent_m / 2} m from the axis",
            "Increase the distance or reduce the extent.",
        )

    def picoseconds(range_m: float) -> int:
        return round(2e12 * range_m / SPEED_OF_LIGHT + cable_delay_ps)

    return replace(
        base,
        scan_start_ps=picoseconds(max(axis_distance_m - reach, 0.0)),
        scan_stop_ps=picoseconds(axis_distance_m + reach),
    )


def journal_beside(path: Path) -> Path:
    """The journal path for a capture file to be written.

    Raises StorageError if the capture already exists.
    """
    if path.exists():
        raise StorageError(f"{path} already exists", "Choose another name; captures are never overwritten.")
    return path.with_name(path.name.removesuffix(CAPTURE_SUFFIX) + JOURNAL_SUFFIX)


def capture_beside(journal_path: Path) -> Path:
    return journal_path.with_name(journal_path.name.removesuffix(JOURNAL_SUFFIX) + CAPTURE_SUFFIX)


def capture_path(folder: Path) -> Path:
    """The path of a new capture file, named after the second; a plan with `renumber` makes it unique."""
    return folder / time.strftime(f"scan-%Y%m%d-%H%M%S{CAPTURE_SUFFIX}")
