"""The analytic signal of real RF samples, its noise and SNR, and peaks between samples.

Defined once, so that scale, padding, the treatment of the mean and the SNR are the same everywhere.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

_ROWS = 256
"""Rows transformed at once: bounds the memory of a long recording to a few tens of MB."""
_BLOCK_BINS = 16


def positive_spectrum(samples: NDArray[np.floating], length: int) -> NDArray[np.complex128]:
    """(..., length // 2 + 1) DFT of real samples, zero-padded to `length`, positive frequencies doubled.

    Frequency zero and, for an even length, the Nyquist frequency keep their weight (Marple, IEEE Trans.
    Signal Processing 47, 1999).
    """
    spectrum = np.fft.rfft(np.asarray(samples, dtype=np.float64), length, axis=-1)
    spectrum[..., 1 : (length + 1) // 2] *= 2
    return np.asarray(spectrum, dtype=np.complex128)


def from_positive(
    spectrum: NDArray[np.complex128], length: int, bins: int, oversampling: int = 1
) -> NDArray[np.complex128]:
    """(..., bins * oversampling) analytic signal of a `positive_spectrum` of `length` on a finer grid."""
    fine = np.zeros((*spectrum.shape[:-1], length * oversampling), dtype=np.complex128)
    fine[..., : spectrum.shape[-1]] = spectrum
    signal = np.fft.ifft(fine, axis=-1)[..., : bins * oversampling]
    return np.asarray(signal * oversampling, dtype=np.complex128)


def analytic(samples: NDArray[np.generic]) -> NDArray[np.complex64]:
    """The analytic signal along the last axis, (views, bins); complex samples are assumed to be analytic.

    The transform is padded to twice the length: without padding, an echo in the first bins also appears at
    the far end of the window. Each row's mean is subtracted before and added after, so that an offset has no
    edges. Within a few bins of an edge the noise of the imaginary part is down to half its power.
    """
    if np.iscomplexobj(samples):
        return np.asarray(samples, dtype=np.complex64)
    bins = samples.shape[-1]
    result = np.empty(samples.shape, dtype=np.complex64)
    for first in range(0, len(samples), _ROWS):
        part = np.asarray(samples[first : first + _ROWS], dtype=np.float64)
        mean = part.mean(axis=-1, keepdims=True)
        spectrum = positive_spectrum(part - mean, 2 * bins)
        result[first : first + _ROWS] = from_positive(spectrum, 2 * bins, bins) + mean
    return result


def noise_power_of(signal: NDArray[np.complex64]) -> float | None:
    """Noise power of one analytic sample, (views, bins) -> counts^2; None for a single view.

    Second differences over slow time cancel static and linearly drifting echoes, and multiply the power of
    white noise by 6 (first differences, with two views: by 2). Strong rotating echoes remain, so the power is
    estimated in blocks of 16 bins, and the lower quartile of the blocks is returned.
    """
    views, bins = signal.shape
    if views < 2:
        return None
    change, gain = (np.diff(signal, axis=0), 2.0) if views == 2 else (np.diff(signal, 2, axis=0), 6.0)
    power = (np.abs(change) ** 2).mean(axis=0, dtype=np.float64) / gain
    starts = np.arange(0, max(bins - _BLOCK_BINS + 1, 1), _BLOCK_BINS)
    widths = np.diff(np.append(starts, bins))
    blocks = np.add.reduceat(power, starts) / widths
    # The analytic signal has less noise at the edges of the window.
    return float(np.percentile(blocks[1:-1] if len(blocks) > 4 else blocks, 25))


def changing_power(echo: NDArray[np.complexfloating]) -> float:
    """max_r P(r) of `snr_db`, P(r) = mean_v |e(v, r) - mean_v e(v, r)|^2, of noise-free e (views, bins)."""
    power = float((np.abs(echo - echo.mean(axis=0)) ** 2).mean(axis=0).max(initial=0.0))
    rounding = 1e-9 * float(np.abs(echo).max(initial=0.0))
    return power if power > rounding**2 else 0.0


def snr_db(signal: NDArray[np.complexfloating], noise_power: float | None) -> tuple[float | None, int | None]:
    """The SNR of a recording, (dB, range bin); (None, None) if nothing changes beyond the noise.

    SNR = 10 log10(max_r P(r) / sigma^2), with P(r) the squared envelope of the changing echo at range r, mean
    over the scans, see `changing_power`, and sigma the standard deviation of the noise in one real sample of
    one scan; without matched filter, without averaging of scans. A mean power is free of bias by noise, which
    raises the largest sample of every scan; it is below the peak where an echo moves through range.

    Args:
        signal: (views, bins) analytic signal of one turn or more.
        noise_power: of one analytic sample, 2 sigma^2, see `noise_power_of`; None if it is not known.
    """
    return over_noise_db(signal - signal.mean(axis=0), noise_power)


def over_noise_db(
    signal: NDArray[np.complexfloating], noise_power: float | None
) -> tuple[float | None, int | None]:
    """The strongest return in the units of `snr_db`, whether it changes or not, (dB, bin).

    The noise power is subtracted. (None, None) if it is not known, or if no bin exceeds it by six standard
    errors of its mean: the lower quartile is 2 to 3 % low, so among some hundred bins noise alone exceeds
    five in about one recording of 150.
    """
    if not noise_power:
        return None, None
    power = (np.abs(signal) ** 2).mean(axis=0, dtype=np.float64)
    peak = int(power.argmax())
    ratio = float(power[peak]) / noise_power - 1
    return (10 * math.log10(2 * ratio), peak) if ratio > 6 / math.sqrt(len(signal)) else (None, None)


def median(
    values: NDArray[np.floating], axis: int | None = None, keepdims: bool = False
) -> NDArray[np.floating]:
    """The median along an axis, or of all values, none of which is NaN.

    `np.median` gives the same, but loads `numpy.ma` for its test for NaN, which takes 20 ms.
    """
    given = np.ravel(values) if axis is None else np.asarray(values)
    along = -1 if axis is None else axis
    count = given.shape[along]
    middle = [count // 2] if count % 2 else [count // 2 - 1, count // 2]
    sorted_ = np.partition(given, middle, axis=along)
    if given.ndim == 1 and not keepdims:
        # As the mean of the two, at a fraction of the cost of numpy's functions for it.
        return np.asarray((sorted_[middle[0]] + sorted_[middle[-1]]) / 2)
    return np.asarray(np.take(sorted_, middle, axis=along).mean(axis=along, keepdims=keepdims))


def vertex(before: float, at: float, after: float) -> float:
    """Vertex of the parabola through three samples, in samples from the middle one.

    If the middle sample is the largest or smallest of the three, the vertex is within half a sample of it. 0
    if the three are on a line.
    """
    bend = before - 2 * at + after
    return 0.5 * (before - after) / bend if bend else 0.0


def peak_place(envelope: NDArray[np.floating], low: int = 0, high: int | None = None) -> float:
    """Position of the maximum of an envelope (n,) in low..high, refined by the parabola at its neighbours."""
    last = len(envelope) - 1
    best = low + int(envelope[low : (last if high is None else high) + 1].argmax())
    return best + float(vertex(*envelope[best - 1 : best + 2])) if 0 < best < last else float(best)


def fitted_peak(at: NDArray[np.float64], values: NDArray[np.float64], best: int, half: int) -> float:
    """Position of the maximum of noisy samples: vertex of the least-squares parabola around the best one.

    Args:
        at: (n,) positions, ascending.
        values: (n,) samples, n > 2 `half`.
        best: index of the largest sample.
        half: number of samples used on each side; fewer on one side and more on the other near an end.

    Returns:
        The vertex, within the samples used; `at[best]` if the parabola has no maximum.
    """
    middle = int(np.clip(best, half, len(at) - 1 - half))
    part = slice(middle - half, middle + half + 1)
    bend, slope, _ = np.polyfit(at[part] - at[middle], values[part], 2)
    if bend >= 0:
        return float(at[best])
    return float(np.clip(at[middle] - slope / (2 * bend), at[part][0], at[part][-1]))
