"""Where an emulated radar gets its samples: a simulated scene, or a recording replayed sample for sample.

The emulator knows only these protocols, so the radar package depends on neither simulation nor storage.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError
from tagid.radar.settings import RadarConfig


class ScanSource(Protocol):
    """A scene in front of the emulated antenna."""

    def scan(self, index: int, time_s: float, config: RadarConfig) -> NDArray[np.int32]:
        """(config.samples,) counts of scan `index` of this run, taken `time_s` after the radar's boot."""
        ...


@runtime_checkable
class FollowingSource(Protocol):
    """A source whose object another program on this machine rotates: it needs its times on a shared clock."""

    def follow(self, monotonic: Callable[[float], float]) -> None:
        """Set the function from the radar's time since boot to time.monotonic()."""
        ...


class RecordingSource:
    """Replays a recording: a source with a fixed window and its own clock.

    Args:
        samples: (views, bins) int32, counts.
        config: settings of the recording; GET_CONFIG returns these regardless of SET_CONFIG, so a client that
            reads back its settings learns the recording's window.
        timestamps_ms: (views,) radar clock; None counts scan periods from zero.
        loop: repeat without end.

    Raises DataError if the samples do not fit the window of the settings.
    """

    def __init__(
        self,
        samples: NDArray[np.int32],
        config: RadarConfig,
        timestamps_ms: NDArray[np.floating] | NDArray[np.integer] | None = None,
        loop: bool = False,
    ) -> None:
        if samples.ndim != 2 or not len(samples) or samples.shape[1] != config.samples:
            raise DataError(
                f"a recording of shape {samples.shape} does not fit a window of {config.samples} samples",
                "Replay a P440 recording with its own settings.",
            )
        if not np.issubdtype(samples.dtype, np.integer):
            raise DataError(
                f"a recording of {samples.dtype} cannot be replayed", "Replay raw counts (int32), not floats."
            )
        self._samples = np.ascontiguousarray(samples, np.int32)
        self.config = config
        self._loop = loop
        if timestamps_ms is None:
            times = np.arange(len(samples)) * config.scan_period_s * 1e3
        elif timestamps_ms.shape != (len(samples),):
            raise DataError(f"timestamps have shape {timestamps_ms.shape}, expected ({len(samples)},)")
        else:
            times = np.asarray(timestamps_ms, np.float64)
        self._times = np.floor(times).astype(np.int64)
        step = config.scan_period_s * 1e3 if len(times) < 2 else float(np.median(np.diff(times)))
        self._duration = int(self._times[-1] - self._times[0] + max(round(step), 1))

    @property
    def views(self) -> int:
        return len(self._samples)

    def has(self, index: int) -> bool:
        """Whether scan `index` exists: always when looping."""
        return self._loop or index < self.views

    def timestamp_ms(self, index: int) -> int:
        """The recorded clock of scan `index`, ms; repetitions follow each other without a gap."""
        turns, view = divmod(index, self.views)
        return int(self._times[view]) + turns * self._duration

    def scan(self, index: int, time_s: float, config: RadarConfig) -> NDArray[np.int32]:
        view: NDArray[np.int32] = self._samples[index % self.views]
        return view
