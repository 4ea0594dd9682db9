"""The echo over range before a scan: where the object is, and whether anything moves."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import TagidError
from tagid.operate.workplace import Workplace
from tagid.radar.resume import steady_scans
from tagid.recording.monitoring import Monitor
from tagid.recording.radars import open_radar
from tagid.station.background import BackgroundRun
from tagid.station.errors import reported
from tagid.station.scans import radar_alone

if TYPE_CHECKING:
    from tagid.radar.p440 import P440
    from tagid.radar.settings import RadarConfig

LONGEST_S = 120.0
"""Time after which a profile ends, s: the radar does not transmit for a page that was forgotten."""
_FAR_M = 3.0
_BEHIND_M = 1.0
"""The profile goes to _FAR_M, or this far beyond the axis: an axis distance that is wrong is seen there."""
_ROWS = 10
"""Rows of the monitor, half a second, in one curve."""
_EVERY_S = 0.2


@dataclass(frozen=True, eq=False)
class Profile:
    """The echo over range.

    Attributes:
        range_m: one-way range of the first and the last bin, m.
        echo_db: (bins,) envelope over one count, dB; empty before the first scan.
        moving_db: the same of what changes.
        axis_m: distance of the rotation axis, m; None if it is not set.
        object_m: nearest and farthest range of the image, m; None if the axis distance is not set.
        error: why it ended; None if it did not, or ended as requested.
    """

    range_m: tuple[float, float] = (0.0, 0.0)
    echo_db: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    moving_db: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    axis_m: float | None = None
    object_m: tuple[float, float] | None = None
    scans: int = 0
    error: TagidError | None = None


class ProfileRun(BackgroundRun):
    """Receives scans that are not stored; the radar keeps its window until the next scan sets its own.

    The lock `radar` is held while the radar is used; `profile` is the newest state.

    Raises ConfigError if no radar is configured.
    """

    def __init__(self, place: Workplace, radar: threading.Lock) -> None:
        config = place.config
        self._place, self._radar = place, radar
        self._url = place.radar_url()
        axis = config["motion.axis_distance_m"]
        half = config["imaging.extent_m"] / 2
        ends = None if axis is None else (max(axis - half, 0.0), axis + half)
        self.profile = Profile(axis_m=axis, object_m=ends)
        super().__init__("station-profile")

    def _fail(self, error: BaseException) -> None:
        if not self._stop.is_set():
            self.profile = replace(self.profile, error=reported(error))

    def _run(self) -> None:
        config = self._place.config
        until = time.monotonic() + LONGEST_S
        with (
            radar_alone(self._radar, self._stop),
            open_radar(self._url, config["radar.timeout_s"]) as radar,
        ):
            if not self._url.startswith("replay://"):
                radar.set_config(self._window(radar.config))
            self._follow(radar, until)

    def _window(self, base: RadarConfig) -> RadarConfig:
        config = self._place.config
        delay = config["radar.cable_delay_ps"]
        stop_m = max(_FAR_M, (self.profile.axis_m or 0.0) + _BEHIND_M)
        return replace(
            base.configured(config),
            scan_start_ps=round(delay),
            scan_stop_ps=round(2e12 * stop_m / SPEED_OF_LIGHT + delay),
            persist=0,
        )

    def _follow(self, radar: P440, until: float) -> None:
        delay = self._place.config["radar.cable_delay_ps"]
        every, moving = Monitor(radar.config, delay), Monitor(radar.config, delay, changing=True)

        def ends() -> bool:
            return self._stop.is_set() or time.monotonic() > until

        due = 0.0
        for scan in steady_scans(radar, until=ends):
            every.add(scan, radar.statistics)
            moving.add(scan, radar.statistics)
            now = time.monotonic()
            if now >= due:
                due = now + _EVERY_S
                seen = every.snapshot()
                self.profile = replace(
                    self.profile,
                    range_m=seen.range_m,
                    echo_db=_decibels(seen.rows),
                    moving_db=_decibels(moving.snapshot().rows),
                    scans=seen.scans,
                )
            if ends():
                return


def _decibels(rows: NDArray[np.float32]) -> NDArray[np.float64]:
    """(bins,) dB of the root mean square of the newest rows over one count."""
    newest = rows[:_ROWS].astype(np.float64)
    return np.asarray(10 * np.log10(np.maximum((newest**2).mean(axis=0), 1.0)))
