"""The recording of one turn from any source: the value that devices produce and imaging consumes.

It is frozen and validated when made, so that later code can rely on shapes and units.
"""

from __future__ import annotations

import enum
import uuid as uuid_module
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tagid._version import __version__
from tagid.constants import BANDWIDTH_HZ, CENTER_FREQUENCY_HZ, SPEED_OF_LIGHT
from tagid.errors import DataError
from tagid.geometry import Aperture
from tagid.metadata import MotionInfo, ObjectInfo, RadarInfo


class ViewFlag(enum.IntFlag):
    """Known problems of a view (uint8 in files)."""

    NONE = 0
    CLIPPED = 1
    AFTER_LOSS = 2
    FIRST = 4
    AFTER_GAP = 8


@dataclass(frozen=True, eq=False)
class Pulse:
    """A transmitted pulse as received from a point target, antennas included.

    Attributes:
        samples: (n,) float64 real RF amplitude; the middle sample n // 2 is time zero.
        step: sampling interval, s.
    """

    samples: NDArray[np.float64]
    step: float

    def __post_init__(self) -> None:
        if self.samples.ndim != 1 or len(self.samples) < 2:
            raise DataError(f"pulse has shape {self.samples.shape}, expected (n,) with n > 1")
        if not np.isfinite(self.samples).all() or not np.any(self.samples):
            raise DataError("pulse is zero or not finite")
        if not (np.isfinite(self.step) and self.step > 0):
            raise DataError(f"pulse step is {self.step} s, expected a positive number")


_BOUNDS: Final = {
    "range_step_m": (1e-9, 1e6),
    "range_start_m": (-1e7, 1e7),
    "axis_distance_m": (1e-6, 1e7),
    "antenna_height_m": (-1e7, 1e7),
    "antenna_separation_m": (0, 1e7),
    "center_frequency_hz": (1, 1e15),
    "bandwidth_hz": (1, 1e15),
    "wave_speed_m_s": (1, 3.1e8),
}
"""Least and greatest value of each attribute, from sound in a tank to light in vacuum: what is beyond is of
another unit, or overflows."""


@dataclass(frozen=True, eq=False)
class Capture:
    """Range profiles of one recording, with the known geometry and times.

    Attributes:
        samples: (views, bins) int32 or float32 real RF counts, or complex64 analytic.
        range_start_m: one-way range of bin 0 after subtracting the cable delay, m.
        range_step_m: one-way range between bins, m.
        angles_rad: (views,) object angle, rad; None if unknown (yet).
        angle_sigma_rad: (views,) standard deviation of the angles, rad; None if unknown.
        axis_distance_m: radar to rotation axis, m; None if unknown.
        antenna_height_m: antenna height above the object's plane, m.
        antenna_separation_m: horizontal distance from the transmitting to the receiving antenna of a radar
            beside a turntable, m; 0: one antenna for both. `axis_distance_m` goes to the middle between them.
        antenna_positions_m: (views, 3) antenna positions in the object's frame, m, instead of angles; those
            of the transmitter where the receiver has its own.
        receive_positions_m: (views, 3) positions of the receiving antenna, m; None where it is the same one.
        host_time_ns: (views,) int64 arrival time on the host, ns since the epoch; None if unknown.
        radar_time_ms: (views,) float64 radar clock, ms (whole on a P440); None if unknown.
        scan_id: (views,) int64 unwrapped scan number, gaps are lost scans; None if unknown.
        flags: (views,) uint8 of `ViewFlag`.
        center_frequency_hz, bandwidth_hz: the band of the pulse, Hz.
        wave_speed_m_s: speed of the wave in the medium, m/s; ranges follow from delays with it.
        pulse: the pulse, where it came with the data.
        radar, motion, object: what is known of each (`tagid.metadata`).
        uuid, created_utc, tool_version: provenance.
        complete: False while recording or if the end is missing.
    """

    samples: NDArray[Any]
    range_start_m: float
    range_step_m: float
    angles_rad: NDArray[np.float64] | None = None
    angle_sigma_rad: NDArray[np.float64] | None = None
    axis_distance_m: float | None = None
    antenna_height_m: float = 0.0
    antenna_separation_m: float = 0.0
    antenna_positions_m: NDArray[np.float64] | None = None
    receive_positions_m: NDArray[np.float64] | None = None
    host_time_ns: NDArray[np.int64] | None = None
    radar_time_ms: NDArray[np.float64] | None = None
    scan_id: NDArray[np.int64] | None = None
    flags: NDArray[np.uint8] | None = None
    center_frequency_hz: float = CENTER_FREQUENCY_HZ
    bandwidth_hz: float = BANDWIDTH_HZ
    wave_speed_m_s: float = SPEED_OF_LIGHT
    pulse: Pulse | None = None
    radar: RadarInfo = field(default_factory=RadarInfo)
    motion: MotionInfo = field(default_factory=MotionInfo)
    object: ObjectInfo = field(default_factory=ObjectInfo)
    uuid: str = field(default_factory=lambda: str(uuid_module.uuid4()))
    created_utc: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="microseconds"))
    tool_version: str = __version__
    complete: bool = True

    def __post_init__(self) -> None:
        s = self.samples
        if s.ndim != 2 or s.shape[0] < 1 or s.shape[1] < 1:
            raise DataError(f"samples have shape {s.shape}, expected (views, bins)")
        if s.dtype not in (np.dtype(np.int32), np.dtype(np.float32), np.dtype(np.complex64)):
            raise DataError(f"samples have dtype {s.dtype}, expected int32, float32 or complex64")
        if not np.isfinite(s).all():
            bad = np.flatnonzero(~np.isfinite(s).all(axis=1))
            raise DataError(
                f"{len(bad)} of {len(s)} views hold non-finite samples, the first is view {bad[0]} (from 0)",
                "Leave these views out, with their angles or positions.",
            )
        if not (np.isfinite(self.range_step_m) and self.range_step_m > 0):
            raise DataError(f"range step is {self.range_step_m} m, expected a positive number")
        if not np.isfinite(self.range_start_m):
            raise DataError(f"range start is {self.range_start_m} m, expected a number")
        for name in ("axis_distance_m", "center_frequency_hz", "bandwidth_hz", "wave_speed_m_s"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise DataError(f"{name} is {value}, expected a positive number")
        if not np.isfinite(self.antenna_height_m):
            raise DataError(f"antenna_height_m is {self.antenna_height_m}, expected a number")
        for name, (low, high) in _BOUNDS.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise DataError(f"{name} is {value:g}, expected {low:g} to {high:g}")
        for name in ("angles_rad", "angle_sigma_rad", "host_time_ns", "radar_time_ms", "scan_id", "flags"):
            value = getattr(self, name)
            if value is None:
                continue
            if value.shape != (len(s),):
                raise DataError(f"{name} has shape {value.shape}, expected ({len(s)},)")
            if not np.isfinite(value).all():
                raise DataError(f"{name} is not finite")
        for name in ("antenna_positions_m", "receive_positions_m"):
            positions = getattr(self, name)
            if positions is not None and (positions.shape != (len(s), 3) or not np.isfinite(positions).all()):
                raise DataError(f"{name} has shape {positions.shape}, expected ({len(s)}, 3), finite")
        if self.receive_positions_m is not None and self.antenna_positions_m is None:
            raise DataError("receive_positions_m need the positions of the transmitting antenna beside them")
        if self.angles_rad is not None and self.antenna_positions_m is not None:
            raise DataError("a capture has angles or antenna positions, not both")

    def __repr__(self) -> str:
        reach = f"{self.ranges_m[0]:.3f} to {self.ranges_m[-1]:.3f} m"
        return f"<Capture of {self.views} views, {self.bins} bins from {reach}, {self.uuid}>"

    @property
    def views(self) -> int:
        """Number of views (scans)."""
        return int(self.samples.shape[0])

    @property
    def bins(self) -> int:
        """Number of range bins."""
        return int(self.samples.shape[1])

    @property
    def ranges_m(self) -> NDArray[np.float64]:
        """(bins,) one-way range of every bin, m."""
        return self.range_start_m + self.range_step_m * np.arange(self.bins, dtype=np.float64)

    @property
    def wavelength_m(self) -> float:
        """Wavelength of the centre frequency in the medium, m."""
        return self.wave_speed_m_s / self.center_frequency_hz

    def aperture(self) -> Aperture:
        """The antenna positions of the views; DataError if neither angles nor positions are known."""
        if self.antenna_positions_m is not None:
            if self.receive_positions_m is not None:
                return Aperture.two_antennas(self.antenna_positions_m, self.receive_positions_m)
            return Aperture(self.antenna_positions_m)
        if self.angles_rad is None:
            raise DataError(
                "the capture holds no angles",
                "Specify the motion: `motion.url=free` (period from the data) or `motion.url=free?rpm=2`.",
            )
        if self.axis_distance_m is None:
            raise DataError(
                "the distance from the radar to the rotation axis is unknown",
                "Give it with `motion.axis_distance_m=METRES`.",
            )
        return Aperture.turntable(
            self.angles_rad, self.axis_distance_m, self.antenna_height_m, self.antenna_separation_m
        )

    def shifted(self, shift_m: NDArray[np.float64]) -> Capture:
        """The capture with its free antenna positions relative to a point (3,), m."""
        if self.antenna_positions_m is None:
            raise DataError("the capture has no antenna positions to shift")
        other = self.receive_positions_m
        return replace(
            self,
            antenna_positions_m=self.antenna_positions_m - shift_m,
            receive_positions_m=None if other is None else other - shift_m,
        )

    def select(self, views: NDArray[np.integer] | slice) -> Capture:
        """The capture with selected views only; the provenance is kept."""
        geometry = ("angles_rad", "angle_sigma_rad", "antenna_positions_m", "receive_positions_m")
        parts: dict[str, Any] = {
            name: None if getattr(self, name) is None else getattr(self, name)[views]
            for name in (*geometry, "host_time_ns", "radar_time_ms", "scan_id", "flags")
        }
        return replace(self, samples=self.samples[views], **parts)
