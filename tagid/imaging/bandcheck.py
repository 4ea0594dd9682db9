"""Whether the scans are what imaging assumes: a waveform with its energy in the assumed band.

A wrong centre frequency or wave speed gives an image of the right size with everything in it out of focus,
and no error anywhere; magnitudes, and samples in baseband or with the opposite sign of phase, show no echo at
all. The spectrum of the scans tells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.geometry import Aperture
from tagid.imaging.preprocess import MIN_BINS, assumed_pulse
from tagid.imaging.rangefilter import band_of, hertz, normalised

LEAST_INSIDE = 0.5
"""Share of the energy over the noise that must lie in the assumed band, widened by a fifth on both sides."""
SHARE = 0.9
"""Share of the energy that the band named in a warning holds."""

_WIDER = 0.2
_BASEBAND = (
    "it is about zero, as of baseband scans",
    "multiply the samples at range R by exp(4j pi center_frequency_hz R / wave_speed_m_s); where their phase "
    "grows with an echo's range, take the complex conjugate first",
)
_PART = (
    "it is at low frequencies, as of the real or imaginary part of baseband scans, or of decibels",
    "store the waveform itself, or complex scans with both parts",
)
_CONJUGATE = ("it is at negative frequencies", "store the complex conjugate of the samples")
_MAGNITUDE = (
    "it is about zero and no sample {}, as of magnitudes, envelopes, power or decibels",
    "store the waveform itself, real or complex",
)
_LEAST_IN_BAND = 0.05
"""Share of the energy in the assumed band, widened, below which no echo can be read in it."""
_BAND = ("", "check center_frequency_hz, bandwidth_hz and wave_speed_m_s")
_MOST_VIEWS = 64
_CLEAR, _CLEAR_ONE = 0.25, 5.0
"""Energy over the noise floor, in units of the floor's, from which on the spectrum is that of echoes: of many
views, and times the views less one. White noise of 1, 2, 4, 8, 36 views has up to 2.9, 1.8, 0.5, 0.3, 0.1."""


@dataclass(frozen=True)
class SampleFault:
    """What is wrong with the samples of a capture.

    Attributes:
        text: what the scans show.
        remedy: what to do.
        certain: whether no band explains it, so that nothing can be read in them.
    """

    text: str
    remedy: str
    certain: bool


def sample_fault(capture: Capture) -> SampleFault | None:
    """The fault of the samples whose energy is outside the assumed band; None where there is none.

    The power spectrum is the mean over the views, from which the mean of their antenna height is subtracted,
    less its noise floor (the lower quartile: a P440's pulse takes a fifth of the recorded band).
    """
    if capture.bins < MIN_BINS:
        return None
    frequency, power, clear = _spectrum(capture)
    total = float(power.sum())
    if not clear or total <= 0:
        return None
    low, high = band_of(normalised(assumed_pulse(capture)))
    edge = _WIDER * (high - low)
    cause = _BAND
    if np.iscomplexobj(capture.samples):
        # An analytic signal sampled below its carrier is known up to multiples of the sampling rate.
        rate = capture.wave_speed_m_s / (2 * capture.range_step_m)
        middle, reach = (low + high) / 2, (high - low) / 2 + edge
        around = middle
        inside = power[np.abs((frequency - middle + rate / 2) % rate - rate / 2) <= reach].sum() / total
        for centre, words in ((0.0, _BASEBAND), (-middle, _CONJUGATE)):
            away = np.abs((frequency - centre + rate / 2) % rate - rate / 2)
            if power[away <= reach].sum() >= SHARE * total:
                cause, around = words, centre
        frequency = around + (frequency - around + rate / 2) % rate - rate / 2
        order = np.argsort(frequency)
        frequency, power = frequency[order], power[order]
    else:
        inside = power[(frequency >= low - edge) & (frequency <= high + edge)].sum() / total
        if power[frequency <= high - low].sum() >= LEAST_INSIDE * total:
            sign = _one_sign(capture)
            cause = (_MAGNITUDE[0].format(sign), _MAGNITUDE[1]) if sign else _PART
    if inside >= LEAST_INSIDE:
        return None
    first, last = _holding(power)
    text = (
        f"the scans' energy lies outside the assumed band of {hertz(low)} to {hertz(high)}: "
        f"90 % of it is between {hertz(frequency[first])} and {hertz(frequency[last])}"
    )
    certain = cause is not _BAND or inside < _LEAST_IN_BAND
    return SampleFault(f"{text}; {cause[0]}" if cause[0] else text, cause[1], bool(certain))


def band_warning(capture: Capture) -> str | None:
    """The fault of `sample_fault` and its remedy as one sentence; None where there is none."""
    fault = sample_fault(capture)
    return None if fault is None else f"{fault.text}; {fault.remedy}"


def _one_sign(capture: Capture) -> str:
    """The sign that no sample has, "" if both occur."""
    if not np.any(capture.samples < 0):
        return "is negative"
    return "" if np.any(capture.samples > 0) else "is positive"


def _spectrum(capture: Capture) -> tuple[NDArray[np.float64], NDArray[np.float64], bool]:
    """Frequencies (n,) Hz, mean power over the noise floor (n,), and whether that is more than noise has."""
    chosen = slice(None, None, max(1, capture.views // _MOST_VIEWS))
    rows = capture.samples[chosen].astype(np.complex128)
    if len(rows) > 1:
        # The room differs between antenna heights.
        positions = capture.antenna_positions_m
        groups = [np.arange(len(rows))] if positions is None else Aperture(positions[chosen]).height_groups()
        for group in groups:
            rows[group] -= rows[group].mean(axis=0)
    rows = rows * np.hanning(rows.shape[1] + 2)[1:-1]
    n = rows.shape[1]
    rate = capture.wave_speed_m_s / (2 * capture.range_step_m)
    power = (np.abs(np.fft.fft(rows, axis=1)) ** 2).mean(axis=0)
    if np.iscomplexobj(capture.samples):
        frequency = np.arange(n) * rate / n
    else:
        frequency, power = np.arange(n // 2) * rate / n, power[: n // 2]
    # The least that counts is a tenth of the strongest, so that a floor of coloured noise names no band.
    floor = float(np.sort(power)[len(power) // 4])
    power = np.maximum(power - floor, 0)
    clear = float(power.sum()) > max(_CLEAR, _CLEAR_ONE / max(1, len(rows) - 1)) * floor * n
    return frequency, np.where(power >= 0.03 * power.max(initial=0.0), power, 0.0), clear


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
