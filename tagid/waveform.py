"""The transmitted pulse as a function of time, nominal or measured.

Shared by simulation and imaging, so that both use the same pulse.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Pulse
from tagid.constants import BANDWIDTH_HZ, CENTER_FREQUENCY_HZ
from tagid.signal import from_positive, positive_spectrum


@lru_cache(maxsize=8)
def nominal_pulse(
    center_frequency_hz: float = CENTER_FREQUENCY_HZ, bandwidth_hz: float = BANDWIDTH_HZ
) -> Pulse:
    """Gaussian-windowed cosine s(t) = exp(-t^2 / (2 tau^2)) cos(2 pi fc t) (paper, eq. 1).

    tau follows from the -10 dB width B of the power spectrum: tau = sqrt(ln 10) / (pi B)
    (the paper does not give tau).

    Args:
        center_frequency_hz: fc, Hz.
        bandwidth_hz: B, the -10 dB two-sided bandwidth, Hz.
    """
    tau = np.sqrt(np.log(10)) / (np.pi * bandwidth_hz)
    step = 1 / (16 * (center_frequency_hz + bandwidth_hz))
    half = int(np.ceil(5 * tau / step))
    t = np.arange(-half, half + 1) * step
    samples = np.exp(-(t**2) / (2 * tau**2)) * np.cos(2 * np.pi * center_frequency_hz * t)
    samples.flags.writeable = False  # those of the last bands are kept
    return Pulse(samples, step)


def analytic_pulse(pulse: Pulse, oversampling: int = 1) -> NDArray[np.complex128]:
    """Analytic signal of the pulse (no negative frequencies) on a grid `oversampling` times finer.

    Returns:
        (n * oversampling,) complex128; time zero is at index (n // 2) * oversampling.
    """
    n = len(pulse.samples)
    return from_positive(positive_spectrum(pulse.samples, 2 * n), 2 * n, n, oversampling)


_CYCLES = 0.01
"""Periods of the highest frequency between two samples that are interpolated linearly."""


def _highest_frequency_hz(pulse: Pulse) -> float:
    """Frequency under which 99.9 % of the pulse's energy lies."""
    length = 2 * len(pulse.samples)
    energy = np.cumsum(np.abs(positive_spectrum(pulse.samples, length)) ** 2)
    return float(np.searchsorted(energy, 0.999 * energy[-1]) / (length * pulse.step))


def pulse_at(pulse: Pulse, time_s: NDArray[np.floating]) -> NDArray[np.complex128]:
    """Analytic pulse at times of any shape (s; zero at the pulse's middle sample), zero outside it.

    The pulse is resampled to a hundredth of a period or less by the Fourier transform (2 ps at 5 GHz), then
    interpolated linearly; the error is below 0.1 %.
    """
    oversampling = max(1, int(np.ceil(pulse.step * _highest_frequency_hz(pulse) / _CYCLES)))
    z = analytic_pulse(pulse, oversampling)
    position = np.asarray(time_s) / pulse.step * oversampling + (len(pulse.samples) // 2) * oversampling
    index = np.arange(len(z))
    real = np.interp(position, index, z.real, left=0.0, right=0.0)
    return np.asarray(real + 1j * np.interp(position, index, z.imag, left=0.0, right=0.0))
