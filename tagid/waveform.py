"""The transmitted pulse as a function of time, nominal or measured.

Simulation and imaging must mean the same pulse, so both take it from here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Pulse
from tagid.constants import BANDWIDTH_HZ, CENTER_FREQUENCY_HZ


def nominal_pulse(
    center_frequency_hz: float = CENTER_FREQUENCY_HZ, bandwidth_hz: float = BANDWIDTH_HZ
) -> Pulse:
    """Gaussian-windowed cosine s(t) = exp(-t^2 / (2 tau^2)) cos(2 pi fc t) (paper, eq. 1).

    tau follows from the -10 dB width B of the power spectrum: tau = sqrt(ln 10) / (sqrt(2) pi B)
    (the paper leaves tau open).

    Args:
        center_frequency_hz: fc, Hz.
        bandwidth_hz: B, the -10 dB two-sided bandwidth, Hz.
    """
    tau = np.sqrt(np.log(10)) / (np.sqrt(2) * np.pi * bandwidth_hz)
    step = 1 / (16 * (center_frequency_hz + bandwidth_hz))
    half = int(np.ceil(5 * tau / step))
    t = np.arange(-half, half + 1) * step
    return Pulse(np.exp(-(t**2) / (2 * tau**2)) * np.cos(2 * np.pi * center_frequency_hz * t), step)


def analytic_pulse(pulse: Pulse) -> NDArray[np.complex128]:
    """(n,) analytic signal of the pulse on its own grid (no negative frequencies), by the Fourier transform."""
    n = len(pulse.samples)
    padded = 2 * n
    spectrum = np.fft.fft(pulse.samples, padded)
    spectrum[padded // 2 + 1 :] = 0
    spectrum[1 : padded // 2] *= 2
    return np.asarray(np.fft.ifft(spectrum)[:n], dtype=np.complex128)


def pulse_at(pulse: Pulse, time_s: NDArray[np.floating]) -> NDArray[np.complex128]:
    """Analytic pulse at times of any shape (s, zero is the middle sample), linear interpolation, zero outside.

    Linear interpolation is exact to 0.1 % on the fine grids pulses come in (>= 16 samples a period).
    """
    z = analytic_pulse(pulse)
    position = np.asarray(time_s) / pulse.step + len(z) // 2
    index = np.arange(len(z))
    real = np.interp(position, index, z.real, left=0.0, right=0.0)
    return np.asarray(real + 1j * np.interp(position, index, z.imag, left=0.0, right=0.0))
