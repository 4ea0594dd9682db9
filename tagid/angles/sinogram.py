"""Slow-time autocorrelation of a sinogram: the similarity of scans at a given time lag.

It is normalised to the energy of the overlap and split into groups of range bins, so that the period search
can compare lags of any length and estimate its own scatter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError

GROUPS = 12
MAX_GAP_FACTOR = 20
"""Scans on the uniform grid may be at most this many times those received; more indicates wrong times."""


@dataclass(frozen=True, eq=False)
class Autocorrelation:
    """Correlation of scans that are k scan periods apart.

    Attributes:
        step_s: time between lags, s.
        scans: length of the uniform grid, lost scans included.
        products: (groups, lags) sum over scans and a group's bins of x_i x_{i+k}.
        norm: (lags,) geometric mean of the energies of both ends of the overlap.
        coherence: expected correlation of identical echoes: signal / (signal + noise).
        noise: (lags,) standard deviation of the correlation of noise alone, from the number of independent
            samples in the overlap.
        repeated: (lags,) as `coherence`, of the scans that overlap: an echo may be weak in just these.
    """

    step_s: float
    scans: int
    products: NDArray[np.float64]
    norm: NDArray[np.float64]
    coherence: float
    noise: NDArray[np.float64]
    repeated: NDArray[np.float64]

    @property
    def values(self) -> NDArray[np.float64]:
        """(lags,) normalised correlation, 1 at lag 0."""
        return np.asarray(self.products.sum(axis=0) / self.norm)

    def without(self, group: int) -> NDArray[np.float64]:
        """The products without one group of bins, for the jackknife; the norm does not shift peaks."""
        return np.asarray((self.products.sum(axis=0) - self.products[group]) / self.norm)


def uniform_grid(
    samples: NDArray[np.generic], times_s: NDArray[np.floating]
) -> tuple[NDArray[np.float32], NDArray[np.bool_], float]:
    """Scans on a uniform time grid, lost ones are zero.

    Returns (scans, bins) float32 (of complex samples real and imaginary parts side by side), (scans,) True
    where received, and the step in s. Raises DataError: times not increasing, not as many as scans, or too
    uneven for one grid.
    """
    x = np.asarray(samples)
    t = np.asarray(times_s, dtype=np.float64)
    if x.ndim != 2 or t.shape != (len(x),) or len(x) < 8:
        raise DataError(
            f"the period cannot be searched in samples {x.shape} with times {t.shape}",
            "Record at least one full turn and a third.",
        )
    if not np.isfinite(t).all() or (np.diff(t) <= 0).any():
        raise DataError("the times of the scans do not increase")
    step = float(np.median(np.diff(t)))
    index = np.rint((t - t[0]) / step).astype(np.int64)
    if index[-1] >= MAX_GAP_FACTOR * len(x):
        raise DataError(
            "most of the scans were lost: the period cannot be searched", "Check the link, and record again."
        )
    flat = np.concatenate([x.real, x.imag], axis=1) if np.iscomplexobj(x) else x
    # Rounding to the grid may put two scans of a jittered clock on one position; the later one is kept.
    grid = np.zeros((index[-1] + 1, flat.shape[1]), dtype=np.float32)
    grid[index] = flat
    received = np.zeros(len(grid), dtype=bool)
    received[index] = True
    return grid, received, (t[-1] - t[0]) / index[-1]


def _repeating_share(x: NDArray[Any], both: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(columns,) share of each column's slow-time energy that correlates between scans; 0 for pure noise.

    The product of neighbouring scans is unbiased by noise; its scatter in pure noise columns shows how
    large a chance value can get.
    """
    signal = np.einsum("ib,ib->b", x[1:][both], x[:-1][both].conj()).real.astype(np.float64)
    energy = np.einsum("ib,ib->b", x[1:][both], x[1:][both].conj()).real.astype(np.float64)
    ratio = signal / np.maximum(energy, np.finfo(np.float64).tiny)
    floor = 2.5 / np.sqrt(max(1, int(np.count_nonzero(both))))
    return np.asarray(np.where(ratio > floor, np.clip(ratio, 0, 1), 0.0))


def _band_filtered(x: NDArray[np.float32], both: NDArray[np.bool_], parts: int) -> NDArray[np.float32]:
    """Range profiles filtered to the frequencies that repeat: the pulse's own band.

    The band is estimated from the data, so that it fits any radar. Neighbouring frequencies are averaged,
    because a band is smooth and noise is not.
    """
    bins = x.shape[1] // parts
    split = x.reshape(len(x), parts, bins)
    spectrum = np.fft.rfft(split, axis=2)
    share = np.mean([_repeating_share(spectrum[:, p], both) for p in range(parts)], axis=0)
    width = max(1, bins // 32)
    share = np.convolve(share, np.ones(width) / width, "same")
    if not share.any():
        return x
    return np.asarray(np.fft.irfft(spectrum * share, bins, axis=2).reshape(x.shape), dtype=np.float32)


def moving_echo(x: NDArray[np.float32], both: NDArray[np.bool_], parts: int = 1) -> NDArray[np.float32]:
    """(scans, columns) of scans (scans, bins), without their mean, in which an echo changes, weighted by its
    share of their energy; no columns where nothing correlates between scans.

    `both` (scans - 1,) says where a scan and the next one were received; `parts` is 2 where real and
    imaginary parts are side by side.
    """
    x = _band_filtered(x, both, parts)
    weights = _repeating_share(x, both)
    chosen = np.flatnonzero(weights)
    return np.asarray(x[:, chosen] * weights[chosen].astype(np.float32))


def _slow_time_lowpass(x: NDArray[np.float32]) -> tuple[NDArray[np.float32], float]:
    """Scans after a low-pass that keeps 98 % of the energy above the noise's flat slow-time spectrum, and the
    remaining number of independent noise samples per scan, 0..1.
    """
    spectrum = np.fft.rfft(x, axis=0)
    power = (np.abs(spectrum) ** 2).sum(axis=1)
    # The upper half is noise only, if the scan rate exceeds the Nyquist rate of the echoes.
    noise = float(np.median(power[len(power) // 2 :]))
    excess = np.cumsum(np.maximum(power - 1.3 * noise, 0))
    if excess[-1] <= 0:
        return x, 1.0
    cutoff = int(np.searchsorted(excess, 0.98 * excess[-1])) + 2
    gain = 1 / (1 + (np.arange(len(power)) / (1.2 * cutoff)) ** 8)
    independent = float(np.sum(gain**2) ** 2 / np.sum(gain**4) / len(gain))
    return np.asarray(np.fft.irfft(spectrum * gain[:, None], len(x), axis=0), dtype=np.float32), independent


def autocorrelate(samples: NDArray[np.generic], times_s: NDArray[np.floating]) -> Autocorrelation:
    """Autocorrelation over slow time of the mean-removed sinogram (scans, bins), real RF or complex.

    Gaps between the increasing times (scans,), s, are lost scans. Raises DataError: see `uniform_grid`; or
    nothing in the scans moves.
    """
    x, received, step = uniform_grid(samples, times_s)
    x[received] -= x[received].mean(axis=0)
    both = received[1:] & received[:-1]
    x = moving_echo(x, both, 2 if np.iscomplexobj(samples) else 1)
    if x.shape[1] == 0:
        raise DataError(
            "nothing in the scans moves: the period cannot be found",
            "Check that the table turns and that the range window covers it.",
        )
    signal = _signal_energy(x, both)
    x, independent = _slow_time_lowpass(x)
    n = len(x)
    size = 1 << (2 * n - 1).bit_length()
    energy = np.einsum("ib,ib->b", x, x)
    # Groups of neighbouring bins with about the same energy each: neighbours share echoes.
    group = np.minimum((np.cumsum(energy) / energy.sum() * GROUPS).astype(int), GROUPS - 1)
    products = np.zeros((GROUPS, n))
    for g in range(GROUPS):
        part = x[:, group == g]
        if part.shape[1]:
            power = np.zeros(size // 2 + 1)
            for begin in range(0, part.shape[1], 64):  # bounded memory: 64 bins at a time
                power += (np.abs(np.fft.rfft(part[:, begin : begin + 64], size, axis=0)) ** 2).sum(axis=1)
            products[g] = np.fft.irfft(power, size)[:n]
    scan_energy = np.einsum("ib,ib->i", x, x).astype(np.float64)
    e, m = np.fft.rfft(scan_energy, size), np.fft.rfft(received.astype(np.float64), size)
    early = np.fft.irfft(e.conj() * m, size)[:n]  # energy of scans with a partner k later
    late = np.fft.irfft(m.conj() * e, size)[:n]
    tiny = 1e-9 * scan_energy.sum()
    norm = np.sqrt(np.maximum(early, tiny) * np.maximum(late, tiny))
    coherence = float(np.clip(signal / scan_energy.sum(), 1e-3, 1.0))
    overlap = np.maximum(np.fft.irfft(np.abs(m) ** 2, size)[:n], 1.0)
    noise_energy = (1 - coherence) * scan_energy.sum() / np.count_nonzero(received)
    repeated = np.clip(1 - noise_energy * overlap / norm, 0, 1)
    noise = 1 / np.sqrt(np.maximum(overlap * independent * _independent_bins(x), 1.0))
    return Autocorrelation(step, n, products, norm, coherence, noise, repeated)


def _independent_bins(x: NDArray[np.float32]) -> float:
    """Effective number of independent range samples, (tr C)^2 / ||C||^2 of their covariance C."""
    covariance = x.T @ x
    return float(np.trace(covariance) ** 2 / np.sum(covariance.astype(np.float64) ** 2))


def _signal_energy(x: NDArray[np.float32], both: NDArray[np.bool_]) -> float:
    """Noise-free energy: products of scans 1 and 2 apart, fitted back to lag zero by an even parabola."""
    lag_one = float(np.einsum("ib,ib->", x[1:][both], x[:-1][both]))
    pairs = both[1:] & both[:-1]
    lag_two = float(np.einsum("ib,ib->", x[2:][pairs], x[:-2][pairs]))
    mean_one = lag_one / max(1, int(np.count_nonzero(both)))
    mean_two = lag_two / max(1, int(np.count_nonzero(pairs)))
    received = int(np.count_nonzero((x != 0).any(axis=1)))
    return received * max(mean_one, (4 * mean_one - mean_two) / 3)
