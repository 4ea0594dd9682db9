"""Fits a uniform clock to the radar's whole-millisecond timestamps.

A scan takes 21.573 ms and is stamped in whole milliseconds: one stamp is off by up to 1 ms, but the radar
scans uniformly, so a line through all stamps is accurate to microseconds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError

OUTLIER_MS = 1.5
"""Stamps further from the line than rounding (1 ms) plus jitter are outliers."""
WRAP_MS = 2.0**32
"""The radar's clock is a u32 of milliseconds (P440 MRM API)."""


@dataclass(frozen=True, eq=False)
class UniformClock:
    """A clock time = t0 + period * index.

    Attributes:
        times_s: (scans,) time of each scan since the first one, s.
        index: (scans,) whole scan periods since the first scan; gaps are lost scans.
        period_s: scan period, s.
        period_sigma_s: its standard deviation, s.
        sigma_s: standard deviation of times_s at the ends, the worst case, s.
        residual_ms: RMS of stamp minus line, ms; 0.29 for pure rounding.
        outliers: number of stamps not used.
    """

    times_s: NDArray[np.float64]
    index: NDArray[np.int64]
    period_s: float
    period_sigma_s: float
    sigma_s: float
    residual_ms: float
    outliers: int


def fit_clock(
    radar_time_ms: NDArray[np.floating], scan_id: NDArray[np.integer] | None = None
) -> UniformClock:
    """Fit the uniform clock, least squares without outliers (the first scan is often one).

    The stamps (scans,) are whole ms; wraps of the u32 counter are removed. Without unwrapped scan numbers
    (scans,), lost scans are inferred from time gaps. Raises DataError: fewer than two scans, stamps that do
    not advance, ids that do not increase.
    """
    stamps = np.array(radar_time_ms, dtype=np.float64)
    if stamps.ndim != 1 or len(stamps) < 2 or not np.isfinite(stamps).all():
        raise DataError(
            f"a clock cannot be fitted through {stamps.size} timestamps", "Record at least two scans."
        )
    if scan_id is not None and (len(scan_id) != len(stamps) or (np.diff(scan_id) <= 0).any()):
        raise DataError(
            "scan numbers do not increase, or their number differs from that of the timestamps",
            "If the file holds several recordings, one after the other, store each in a file of its own.",
        )
    stamps = stamps + WRAP_MS * np.concatenate([[0], np.cumsum(np.diff(stamps) < -WRAP_MS / 2)])
    guess = float(np.median(np.diff(stamps) / (1 if scan_id is None else np.diff(scan_id))))
    if guess <= 0:
        raise DataError(
            "the radar's timestamps do not advance",
            "Give the scan period, or record with a radar that timestamps its scans.",
        )
    if scan_id is None:
        steps = np.maximum(np.rint(np.diff(stamps) / guess), 1)
        index = np.concatenate([[0], np.cumsum(steps)]).astype(np.int64)
    else:
        index = np.asarray(scan_id, dtype=np.int64) - int(scan_id[0])
    # A robust start: the median slope over long baselines is robust against a few bad stamps.
    half = len(stamps) // 2
    slope = float(
        np.median(
            (stamps[half:] - stamps[: len(stamps) - half]) / (index[half:] - index[: len(stamps) - half])
        )
    )
    offset = float(np.median(stamps - slope * index))
    used = np.ones(len(stamps), dtype=bool)
    for _ in range(4):
        inliers = np.abs(stamps - offset - slope * index) <= OUTLIER_MS
        if np.count_nonzero(inliers) < max(2, len(stamps) // 2):
            # No uniform clock within rounding: keep every stamp; the residual shows it.
            inliers = np.ones(len(stamps), dtype=bool)
        slope, offset = (
            np.polyfit(index[inliers], stamps[inliers], 1) if inliers.sum() > 2 else (slope, offset)
        )
        if np.array_equal(inliers, used):
            break
        used = inliers
    residual = stamps[used] - offset - slope * index[used]
    rms = float(np.sqrt(np.mean(residual**2)))
    # Rounding is uniform with std 1/sqrt(12) ms; a smaller residual (few stamps) is chance.
    noise_ms = max(rms, 1 / np.sqrt(12))
    spread = float(np.sqrt(np.sum((index[used] - index[used].mean()) ** 2))) or 1.0
    period_sigma = noise_ms / spread
    reach = max(abs(index[-1] - index[used].mean()), abs(index[0] - index[used].mean()))
    sigma = np.hypot(noise_ms / np.sqrt(np.count_nonzero(used)), period_sigma * reach)
    return UniformClock(
        times_s=np.asarray(index * slope * 1e-3, dtype=np.float64),
        index=index,
        period_s=float(slope) * 1e-3,
        period_sigma_s=period_sigma * 1e-3,
        sigma_s=float(sigma) * 1e-3,
        residual_ms=rms,
        outliers=int(np.count_nonzero(~used)),
    )
