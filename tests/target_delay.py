"""What a reference target does to the delay that is measured with it."""

from __future__ import annotations

import numpy as np

from tagid.commissioning.targets import Target
from tagid.constants import CENTER_FREQUENCY_HZ
from tagid.signal import peak_place
from tagid.waveform import analytic_pulse, nominal_pulse


def delay_ps(target: Target) -> float:
    """How much later a target's echo peaks than that of a point where the tape ends, two-way, ps.

    Behind the filter matched to the nominal pulse, as `tagid.recording.calibration.estimate_delay`.
    """
    pulse = nominal_pulse()
    fine = 4 * len(pulse.samples)
    spectrum = np.fft.fft(analytic_pulse(pulse), fine)
    frequency = np.fft.fftfreq(fine, pulse.step)
    length = np.zeros(fine, dtype=np.complex128)
    band = np.abs(frequency - CENTER_FREQUENCY_HZ) < CENTER_FREQUENCY_HZ / 2
    # The scattering length turns the phase of exp(-j 2 pi f t) backwards.
    length[band] = target.scattering_length(frequency[band])
    echo = np.fft.fftshift(np.abs(np.fft.ifft(np.abs(spectrum) ** 2 * length)))
    return float((peak_place(echo) - fine // 2) * pulse.step * 1e12)
