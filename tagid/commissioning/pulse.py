"""The pulse of a rig, from the echo of a target whose own response is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from tagid.capture import Pulse
from tagid.commissioning.targets import Target
from tagid.constants import CENTER_FREQUENCY_HZ, SAMPLE_STEP_S
from tagid.signal import from_positive, peak_place, positive_spectrum
from tagid.types import Complex, Floats
from tagid.waveform import nominal_pulse, pulse_at

_BEFORE_S: Final = 1.5e-9
_AFTER_S: Final = 4.0e-9
"""Part of the echo that is kept; recorded pulses ring for 3 ns (measured)."""
_TAPER_S: Final = 0.4e-9
_FINER: Final = 16
_LATE_S: Final = 1.2e-9
"""From here on an echo of the pulse rings."""
_BAND_DB: Final = 10.0
_FAINT: Final = 0.05
"""The target's response is divided out where it exceeds this share of that at the centre."""


@dataclass(frozen=True, eq=False)
class EchoPulse:
    """The pulse as a point would return it, without the target's own response.

    Attributes:
        pulse: peak envelope 1; its middle sample is where the envelope behind the matched filter peaks.
        delay_ps: how much later the target's echo peaks than that of a point at its place, two-way, ps.
        centre_hz: centre of its power spectrum, Hz.
        low_hz, high_hz: ends of its band at -10 dB, Hz.
        width_s: of its envelope at half of the peak, s.
        ringing_db: strongest part later than 1.2 ns after the peak, dB.
        group_delay_s: standard deviation of the group delay over the band, weighted by power, s.
    """

    pulse: Pulse
    delay_ps: float
    centre_hz: float
    low_hz: float
    high_hz: float
    width_s: float
    ringing_db: float
    group_delay_s: float


def echo_pulse(scan: Floats, at: float, target: Target) -> EchoPulse:
    """The pulse in a mean scan (bins,) less the empty room, counts, in which the echo of a target peaks
    behind the matched filter at a range bin, between samples.
    """
    t = (np.arange(len(scan)) - at) * SAMPLE_STEP_S
    edge = np.clip(np.minimum(t + _BEFORE_S, _AFTER_S - t) / _TAPER_S, 0, 1)
    echo = (scan - scan.mean()) * np.sin(edge * np.pi / 2) ** 2
    length = 1 << (4 * len(scan) - 1).bit_length()
    frequency = np.arange(length // 2 + 1) / (length * SAMPLE_STEP_S)
    spectrum = positive_spectrum(echo, length)
    spectrum *= np.exp(2j * np.pi * frequency * at * SAMPLE_STEP_S)  # the echo's peak at time zero
    point = spectrum / _response(target, frequency)
    matched = _matched(length)
    peaks = [_peak(half * matched, length) for half in (spectrum, point)]
    point = point * np.exp(2j * np.pi * frequency * peaks[1] * SAMPLE_STEP_S)
    half = round((_AFTER_S + _TAPER_S) / SAMPLE_STEP_S)
    wave = np.roll(from_positive(point, length, length).real, half)[: 2 * half + 1]
    envelope = np.roll(np.abs(from_positive(point, length, length, _FINER)), half * _FINER)
    envelope = envelope[: 2 * half * _FINER + 1]
    power = np.abs(point) ** 2
    inside = np.flatnonzero(power > power.max() / 10 ** (_BAND_DB / 10))
    top = int(envelope.argmax())
    wide = np.flatnonzero(envelope > envelope[top] / 2)
    late = envelope[top + round(_LATE_S / SAMPLE_STEP_S * _FINER) :]
    return EchoPulse(
        Pulse(wave / envelope[top], SAMPLE_STEP_S),
        (peaks[0] - peaks[1]) * SAMPLE_STEP_S * 1e12,
        float((frequency * power).sum() / power.sum()),
        float(frequency[inside[0]]),
        float(frequency[inside[-1]]),
        float(wide[-1] - wide[0]) * SAMPLE_STEP_S / _FINER,
        float(20 * np.log10(max(float(late.max(initial=0.0)), 1e-9) / envelope[top])),
        _group_delay_spread(point[inside[0] : inside[-1] + 1], frequency[1]),
    )


def received_from(pulse: Pulse, target: Target) -> tuple[Pulse, float]:
    """A pulse as a target returns it, from that of a point, and by how much later it peaks, two-way, ps.

    Time zero is where its envelope behind the matched filter peaks, which is where images are brightest.
    """
    count = len(pulse.samples)
    length = 1 << (4 * count - 1).bit_length()
    frequency = np.arange(length // 2 + 1) / (length * pulse.step)
    # From the middle sample, which is time zero, to the first sample and back.
    middle = np.exp(2j * np.pi * frequency * (count // 2) * pulse.step)
    spectrum = positive_spectrum(pulse.samples, length) * _response(target, frequency)
    late = _peak(spectrum * middle * _matched(length), length)
    spectrum = spectrum * np.exp(2j * np.pi * frequency * late * SAMPLE_STEP_S)
    return Pulse(from_positive(spectrum, length, count).real, pulse.step), late * SAMPLE_STEP_S * 1e12


def _matched(length: int) -> Complex:
    """Filter matched to the nominal pulse, at the positive frequencies of a transform of some length."""
    offset = ((np.arange(length) + length // 2) % length - length // 2) * SAMPLE_STEP_S
    return np.asarray(np.conj(np.fft.fft(pulse_at(nominal_pulse(), offset))[: length // 2 + 1]))


def _response(target: Target, frequency: Floats) -> Complex:
    """The target's response over that at the centre of the band; 1 far outside."""
    given = target.scattering_length(np.maximum(frequency, 1e8))
    centre = target.scattering_length(np.array([CENTER_FREQUENCY_HZ]))[0]
    response = given / abs(centre)
    # exp(+j omega t) here; scattering lengths are of exp(-j omega t).
    response = np.where(np.abs(response) > _FAINT, response, np.exp(1j * np.angle(response)))
    outside = np.abs(frequency - CENTER_FREQUENCY_HZ) > 0.5 * CENTER_FREQUENCY_HZ
    response[outside] = response[np.flatnonzero(~outside)[0]]
    return np.asarray(response)


def _peak(spectrum: Complex, length: int) -> float:
    """Place of the largest envelope around time zero, samples."""
    envelope = np.fft.fftshift(np.abs(from_positive(spectrum, length, length, _FINER)))
    middle = len(envelope) // 2
    reach = round(_BEFORE_S / SAMPLE_STEP_S * _FINER)
    return (peak_place(envelope, middle - reach, middle + reach) - middle) / _FINER


def _group_delay_spread(spectrum: Complex, step_hz: float) -> float:
    delay = -np.diff(np.unwrap(np.angle(spectrum))) / (2 * np.pi * step_hz)
    power = np.abs(spectrum[1:] * spectrum[:-1])
    mean = float((delay * power).sum() / power.sum())
    return float(np.sqrt((power * (delay - mean) ** 2).sum() / power.sum()))
