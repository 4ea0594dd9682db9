"""Scans without the body: what is left of a capture when the echo of the fitted body is subtracted.

A can returns 20 dB more than a tag's reflector, and standing off the axis it moves, so that an image shows
its wall and the sidelobes of that. Its echo is known once its centre is: one amplitude per frequency.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tagid.capture import Capture
from tagid.constants import SPEED_OF_LIGHT
from tagid.tags.bodies.body_reading import BodyReading
from tagid.tags.bodies.reflectors_fit import Columns, solve
from tagid.tags.bodies.spectra import Spectra

PADDING = 1.5
"""Range bins of the transform over those recorded: the echo must not wrap around."""


def without_body(capture: Capture, reading: BodyReading) -> Capture:
    """The capture with the body's echo subtracted; the room and the reflectors stay.

    Frequency by frequency, the amplitude of the body is fitted together with those of the reflectors of the
    arrangement that explains the scans best, so that they do not leak into each other.

    Args:
        capture: prepared, on a turntable or at free positions: the one that was read.
        reading: the body that was found in it.
    """
    aperture = capture.aperture()
    positions = aperture.positions
    distance = float(np.linalg.norm(positions, axis=1).mean())
    is_real = capture.samples.dtype.kind != "c"
    n = int(np.ceil(PADDING * capture.bins))
    rate = SPEED_OF_LIGHT / (2 * capture.range_step_m)
    if is_real:
        spectrum = np.fft.rfft(capture.samples, n, axis=1)
        frequency = np.fft.rfftfreq(n, 1 / rate)
    else:
        spectrum = np.fft.fft(capture.samples, n, axis=1)
        around = np.fft.fftfreq(n, 1 / rate)
        frequency = around + np.round((capture.center_frequency_hz - around) / rate) * rate
    low, high = (capture.center_frequency_hz + side * 0.75 * capture.bandwidth_hz for side in (-1, 1))
    used = np.flatnonzero((frequency >= max(low, 0.0)) & (frequency <= high))
    used = used[np.argsort(frequency[used])]
    kappa = np.asarray(4 * np.pi * frequency[used] / SPEED_OF_LIGHT, dtype=np.float64)
    reference = np.exp(-1j * kappa * (capture.range_start_m - distance))
    data = (spectrum[:, used] * reference).T
    spectra = Spectra(
        np.asarray(data - data.mean(axis=1, keepdims=True), dtype=np.complex128),
        kappa,
        positions[:, 0] + 1j * positions[:, 1],
        np.ascontiguousarray(positions[:, 2]),
        distance,
        0.0,
    )
    placed = min((*reading.layouts, *reading.others), key=lambda one: one.charged)
    cols = Columns.of(spectra, reading.body, placed.batch)
    amplitude = solve(spectra.data, cols.values).amplitudes[0, :, 0]
    if cols.body is None:
        return capture
    echo = (amplitude[:, None] * cols.body[0]).T / reference
    taken = np.zeros_like(spectrum)
    taken[:, used] = echo
    inverse = np.fft.irfft(taken, n, axis=1) if is_real else np.fft.ifft(taken, axis=1)
    samples = capture.samples - inverse[:, : capture.bins]
    dtype = np.float32 if is_real else np.complex64
    return replace(capture, samples=samples.astype(dtype))
