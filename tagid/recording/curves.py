"""Curves of a recording over range, slow time and frequency, as plain arrays.

Plots and summary of a recording use the same numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.signal import analytic

# Views transformed at once; limits the memory for a long recording.
_CHUNK = 256

TIME_LABEL = "time (s)"


def slow_time(capture: Capture) -> tuple[NDArray[np.float64], str]:
    """(views,) slow time of every view and its meaning: seconds since the first, or the view's number.

    Seconds come from the radar's clock, else from the host's; a clock that runs backwards is not used.
    """
    for clock, scale in ((capture.radar_time_ms, 1e-3), (capture.host_time_ns, 1e-9)):
        if clock is None or len(clock) < 2:
            continue
        seconds = (clock - clock[0]).astype(np.float64) * scale
        if np.all(np.diff(seconds) >= 0) and seconds[-1] > 0:
            return seconds, TIME_LABEL
    return np.arange(capture.views, dtype=np.float64), "view"


@dataclass(frozen=True, eq=False)
class RecordingCurves:
    """The curves of a recording.

    Attributes:
        range_m: (bins,) one-way range, m.
        mean_envelope: (bins,) mean over the views of the envelope, counts.
        max_envelope: (bins,) largest envelope of any view, counts.
        changing_envelope: (bins,) mean envelope of the scans less the mean scan, counts.
        envelope: (views, bins) float32, counts; less the mean scan if requested.
        frequency_hz: (n,) frequencies from 0 to half the sampling rate (the full rate for complex samples).
        spectrum: (n,) root mean square over the views of the spectrum's magnitude, arbitrary unit.
    """

    range_m: NDArray[np.float64]
    mean_envelope: NDArray[np.float64]
    max_envelope: NDArray[np.float64]
    changing_envelope: NDArray[np.float64]
    envelope: NDArray[np.float32]
    frequency_hz: NDArray[np.float64]
    spectrum: NDArray[np.float64]

    @classmethod
    def of(cls, capture: Capture, *, changing_only: bool = False) -> RecordingCurves:
        """The curves of a capture; sampling rate c / (2 range_step), c in its medium, as range is one way.

        `changing_only` subtracts the mean scan (leakage, room) from `envelope`; only moving echoes remain.
        """
        signal = analytic(capture.samples)
        envelope = np.abs(signal)
        changing = _changing(signal)
        sampling_hz = capture.wave_speed_m_s / (2 * capture.range_step_m)
        frequency, spectrum = _spectrum(capture.samples, sampling_hz)
        return cls(
            range_m=capture.ranges_m,
            mean_envelope=envelope.mean(axis=0, dtype=np.float64),
            max_envelope=envelope.max(axis=0).astype(np.float64),
            changing_envelope=changing.mean(axis=0, dtype=np.float64),
            envelope=changing if changing_only else envelope,
            frequency_hz=frequency,
            spectrum=spectrum,
        )


def changing_envelope(capture: Capture) -> NDArray[np.float32]:
    """(views, bins) envelope of the scans less the mean scan, counts."""
    return _changing(analytic(capture.samples))


def _changing(signal: NDArray[np.complex64]) -> NDArray[np.float32]:
    return np.asarray(np.abs(signal - signal.mean(axis=0)), dtype=np.float32)


def _spectrum(
    samples: NDArray[np.generic], sampling_hz: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    bins = samples.shape[1]
    # A Hann window keeps a strong return at the window's edge from leaking over the whole band.
    window = np.hanning(bins + 2)[1:-1]
    transform = np.fft.fft if np.iscomplexobj(samples) else np.fft.rfft
    power: NDArray[np.float64] = np.zeros(bins if np.iscomplexobj(samples) else bins // 2 + 1)
    for first in range(0, len(samples), _CHUNK):
        part = transform(np.asarray(samples[first : first + _CHUNK]) * window, axis=1)
        power += (np.abs(part) ** 2).sum(axis=0)
    return np.arange(len(power)) * sampling_hz / bins, np.sqrt(power / len(samples))
