"""Live state of a radar: the last scans, and figures that show whether it works correctly.

Scans are received on one thread and drawn on another, so that neither waits for the other.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tagid.radar.assembler import Scan, Statistics
from tagid.radar.settings import RadarConfig
from tagid.signal import analytic, noise_power_of, over_noise_db

ROWS: Final = 200
"""Number of rows kept for the waterfall; more than any terminal displays."""

_ROWS_PER_SECOND: Final = 20.0
_JUDGED: Final = 32
_JUDGE_EVERY_S: Final = 0.5
_CLIP_WINDOW_S: Final = 2.0
_RATE_SCANS: Final = 200
_FADE: Final = 0.05


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A snapshot of the monitor.

    Attributes:
        rows: (n, bins) float32 envelope, counts, the newest first; n is at most `ROWS`.
        range_m: one-way range of the first and the last bin, m.
        scans, lost: complete scans and lost ones since the start.
        scan_rate_hz: rate of the last scans, by the radar's clock; None before the second scan.
        snr_db: strongest return over the noise, see `tagid.signal.over_noise_db`, dB; None if there is none.
            Not the SNR of a turn: the last scans see a small part of it, and static echoes count.
        peak_m: its range, m.
        clipped_fraction: fraction of clipped samples in the two seconds up to the last scan.
        temperature_c: board temperature; None until the radar has reported it.
        silent_s: time since the last scan, s.
        seconds: time since the start, s.
        note: the last event; empty if none.
    """

    rows: NDArray[np.float32]
    range_m: tuple[float, float]
    scans: int
    lost: int
    scan_rate_hz: float | None
    snr_db: float | None
    peak_m: float | None
    clipped_fraction: float
    temperature_c: float | None
    silent_s: float
    seconds: float
    note: str

    @property
    def strongest(self) -> str:
        """The strongest return over the noise, in words."""
        if self.snr_db is None:
            return "echo -"
        return f"echo {self.snr_db:.1f} dB at {self.peak_m:.2f} m"

    @property
    def lost_fraction(self) -> float:
        return self.lost / max(self.scans + self.lost, 1)


class Monitor:
    """Receives scans and returns snapshots; safe to use from two threads, in bounded memory.

    Args:
        cable_delay_ps: two-way delay subtracted from the ranges, ps.
        changing: subtract the running mean, to show only changes.
        clock: returns the time, s.
    """

    def __init__(
        self,
        config: RadarConfig,
        cable_delay_ps: float = 0.0,
        changing: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._config = config
        start = config.range_start_m(cable_delay_ps)
        self._range_m = start, start + (config.samples - 1) * config.range_step_m
        self._changing = changing
        self._clock = clock
        self._lock = threading.Lock()
        self._rows: deque[NDArray[np.float32]] = deque(maxlen=ROWS)
        self._recent: deque[NDArray[np.int32]] = deque(maxlen=_JUDGED)
        self._times: deque[int] = deque(maxlen=_RATE_SCANS)
        self._ids: deque[int] = deque(maxlen=_RATE_SCANS)
        self._clipped: deque[tuple[float, int]] = deque(maxlen=4096)
        self._mean: NDArray[np.float64] | None = None
        self._began = self._last = clock()
        self._row_due = self._judge_due = 0.0
        self._snr: tuple[float | None, float | None] = None, None
        self._scans = self._lost = 0
        self.temperature_c: float | None = None
        self.note = ""

    def add(self, scan: Scan, statistics: Statistics) -> None:
        now = self._clock()
        clip = self._config.clip_counts
        clipped = int(np.count_nonzero((scan.samples >= clip) | (scan.samples <= -clip)))
        row = None
        if self._changing:
            self._mean = (
                scan.samples.astype(np.float64)
                if self._mean is None
                else self._mean + _FADE * (scan.samples - self._mean)
            )
        if now >= self._row_due:
            self._row_due = now + 1 / _ROWS_PER_SECOND
            shown = scan.samples if self._mean is None else scan.samples - self._mean
            row = np.abs(analytic(shown[None])[0])
        with self._lock:
            self._last = now
            self._scans += 1
            self._lost = statistics.lost_scans
            self._recent.append(scan.samples)
            self._times.append(scan.radar_time_ms)
            self._ids.append(scan.scan_id)
            self._clipped.append((now, clipped))
            if row is not None:
                self._rows.appendleft(row)
        if now >= self._judge_due:
            self._judge_due = now + _JUDGE_EVERY_S
            self._snr = self._judged()

    def snapshot(self) -> Snapshot:
        now = self._clock()
        with self._lock:
            rows = np.array(self._rows) if self._rows else np.zeros((0, self._config.samples), np.float32)
            counted = [count for at, count in self._clipped if self._last - at <= _CLIP_WINDOW_S]
            rate = None
            if len(self._times) > 1 and self._times[-1] > self._times[0]:
                rate = (self._ids[-1] - self._ids[0]) / ((self._times[-1] - self._times[0]) * 1e-3)
            return Snapshot(
                rows,
                self._range_m,
                self._scans,
                self._lost,
                rate,
                *self._snr,
                sum(counted) / max(len(counted) * self._config.samples, 1),
                self.temperature_c,
                now - self._last,
                now - self._began,
                self.note,
            )

    def _judged(self) -> tuple[float | None, float | None]:
        """The strongest return in the last scans: over the noise, dB, and its range, m."""
        with self._lock:
            recent = np.array(self._recent, dtype=np.float64)
        if len(recent) < 3:
            return None, None
        if self._mean is not None:
            recent -= self._mean
        signal = analytic(recent)
        strongest, peak = over_noise_db(signal, noise_power_of(signal))
        if strongest is None or peak is None or not math.isfinite(strongest):
            return None, None
        return strongest, self._range_m[0] + peak * self._config.range_step_m
