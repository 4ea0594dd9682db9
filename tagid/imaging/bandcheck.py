"""Whether the scans' energy lies in the band that imaging assumes.

A wrong centre frequency or wave speed gives an image of the right size with everything in it out of focus,
and no error anywhere; the spectrum of the scans tells.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.imaging.preprocess import assumed_pulse
from tagid.imaging.rangefilter import band_of, hertz, normalised

LEAST_INSIDE = 0.5
"""Share of the energy over the noise that must lie in the assumed band, widened by a fifth on both sides."""
SHARE = 0.9
"""Share of the energy that the band named in a warning holds."""

_WIDER = 0.2
_BASEBAND = (
    "it is about zero, as of baseband scans: multiply the samples at range R by "
    "exp(4j pi center_frequency_hz R / wave_speed_m_s)"
)
_CONJUGATE = "it is at negative frequencies: store the complex conjugate of the samples"
_MOST_VIEWS = 64


def band_warning(capture: Capture) -> str | None:
    """A warning that names the band of 90 % of the energy, where it is not the assumed one; else None.

    The power spectrum is the mean over the views after their mean is subtracted, less its noise floor (the
    lower quartile over frequency, since a pulse of a P440 takes a fifth of the recorded band).
    """
    frequency, power = _spectrum(capture)
    total = float(power.sum())
    if total <= 0:
        return None
    low, high = band_of(normalised(assumed_pulse(capture)))
    edge = _WIDER * (high - low)
    advice = "check center_frequency_hz, bandwidth_hz and wave_speed_m_s"
    if np.iscomplexobj(capture.samples):
        # An analytic signal sampled below its carrier is known up to multiples of the sampling rate.
        rate = capture.wave_speed_m_s / (2 * capture.range_step_m)
        middle, reach = (low + high) / 2, (high - low) / 2 + edge
        for centre, words in ((0.0, _BASEBAND), (-middle, _CONJUGATE)):
            away = np.abs((frequency - centre + rate / 2) % rate - rate / 2)
            if power[away <= reach].sum() >= SHARE * total:
                advice = words
        frequency = middle + (frequency - middle + rate / 2) % rate - rate / 2
        order = np.argsort(frequency)
        frequency, power = frequency[order], power[order]
    inside = (frequency >= low - edge) & (frequency <= high + edge)
    if power[inside].sum() >= LEAST_INSIDE * total:
        return None
    first, last = _holding(power)
    return (
        f"the scans' energy lies outside the assumed band of {hertz(low)} to {hertz(high)}: "
        f"90 % of it is between {hertz(frequency[first])} and {hertz(frequency[last])}; "
        f"{advice}"
    )


def _spectrum(capture: Capture) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Frequencies (n,) Hz and mean power over the noise floor (n,)."""
    rows = capture.samples[:: max(1, capture.views // _MOST_VIEWS)].astype(np.complex128)
    if len(rows) > 1:
        rows = rows - rows.mean(axis=0)
    rows = rows * np.hanning(rows.shape[1] + 2)[1:-1]
    n = rows.shape[1]
    rate = capture.wave_speed_m_s / (2 * capture.range_step_m)
    power = (np.abs(np.fft.fft(rows, axis=1)) ** 2).mean(axis=0)
    if np.iscomplexobj(capture.samples):
        frequency = np.arange(n) * rate / n
    else:
        frequency, power = np.arange(n // 2) * rate / n, power[: n // 2]
    # The least that counts is a tenth of the strongest, so that a floor of coloured noise names no band.
    power = np.maximum(power - np.quantile(power, 0.25), 0)
    return frequency, np.where(power >= 0.03 * power.max(initial=0.0), power, 0.0)


def _holding(power: NDArray[np.float64]) -> tuple[int, int]:
    """First and last index of the shortest run that holds `SHARE` of the power."""
    total = np.concatenate([[0.0], np.cumsum(power)])
    best = (0, len(power) - 1)
    last = 0
    for first in range(len(power)):
        while last < len(power) and total[last] - total[first] < SHARE * total[-1]:
            last += 1
        if total[last] - total[first] < SHARE * total[-1]:
            break
        if last - 1 - first < best[1] - best[0]:
            best = (first, last - 1)
    return best
