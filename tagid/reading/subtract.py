"""Scans without the body: what is left when the echo of the fitted body is subtracted.

A can returns 20 dB more than a tag's reflector, and standing off the axis it moves, so that an image shows
its wall and the sidelobes of that. Its echo is known once its centre is: one amplitude per frequency.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tagid.capture import Capture
from tagid.constants import SPEED_OF_LIGHT
from tagid.reading.hypothesis import Hypothesis
from tagid.reading.sheet import SheetModel
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.plain import POINTS
from tagid.types import Complex

PADDING = 1.5
"""Range bins of the transform over those recorded: the echo must not wrap around."""
BAND = 0.75
"""Half-width of the frequencies at which the echo is subtracted, over the bandwidth."""
NOISE = 0.01
"""Variance of noise and model error that the amplitudes' priors are weighed against, over the moving echo."""


def without_body(capture: Capture, hypothesis: Hypothesis) -> Capture:
    """The capture with the body's echo subtracted; the room and the reflectors stay.

    Frequency by frequency, the amplitudes of the body are fitted together with those of the reflectors and
    odd scatterers of the hypothesis, so that they do not leak into each other.

    Args:
        capture: prepared, on a turntable or at free positions: the one that was read.
        hypothesis: with a body, of that reading.
    """
    positions = capture.aperture().positions
    n = int(np.ceil(PADDING * capture.bins))
    rate = SPEED_OF_LIGHT / (2 * capture.range_step_m)
    is_real = capture.samples.dtype.kind != "c"
    if is_real:
        spectrum = np.fft.rfft(capture.samples, n, axis=1)
        frequency = np.fft.rfftfreq(n, 1 / rate)
    else:
        spectrum = np.fft.fft(capture.samples, n, axis=1)
        around = np.fft.fftfreq(n, 1 / rate)
        frequency = around + np.round((capture.center_frequency_hz - around) / rate) * rate
    low, high = (capture.center_frequency_hz + side * BAND * capture.bandwidth_hz for side in (-1, 1))
    used = np.flatnonzero((frequency >= max(low, 0.0)) & (frequency <= high))
    used = used[np.argsort(frequency[used])]
    distance = float(np.linalg.norm(positions, axis=1).mean())
    kappa = np.asarray(4 * np.pi * frequency[used] / SPEED_OF_LIGHT, dtype=np.float64)
    reference = np.exp(-1j * kappa * (capture.range_start_m - distance))
    data = np.asarray((spectrum[:, used] * reference).T, dtype=np.complex128)
    moving = np.maximum((np.abs(data - data.mean(axis=1, keepdims=True)) ** 2).mean(axis=1), 1e-30)
    antenna, height = positions[:, 0] + 1j * positions[:, 1], np.ascontiguousarray(positions[:, 2])
    spectra = Spectra(data, kappa, antenna, height, distance, moving, full_turn=False)
    taken = np.zeros(spectrum.shape, dtype=np.complex128)
    taken[:, used] = _echo(spectra, hypothesis).T / reference
    inverse = np.fft.irfft(taken, n, axis=1) if is_real else np.fft.ifft(taken, axis=1)
    samples = capture.samples - inverse[:, : capture.bins]
    return replace(capture, samples=samples.astype(np.float32 if is_real else np.complex64))


def _echo(spectra: Spectra, hypothesis: Hypothesis) -> Complex:
    """(F, V) echo of the body."""
    estimate = hypothesis.estimate
    # As points, reflectors have amplitudes of their own at every frequency, whatever a wall does to them.
    as_they_are = isinstance(estimate.model, SheetModel) or not estimate.model.transfer.body
    model = estimate.model if as_they_are else replace(estimate.model, transfer=POINTS)
    values = model.at(spectra, estimate.x, slopes=False).values
    power = model.power(spectra.moving, *estimate.powers.amplitudes)
    rooms = spectra.rooms
    columns = values - (values @ rooms.T) @ rooms
    data = spectra.data - (spectra.data @ rooms.T) @ rooms
    matrix = columns.conj() @ np.swapaxes(columns, 1, 2)
    matrix = matrix + np.eye(columns.shape[1]) * (NOISE * spectra.moving[:, None] / power)[:, None]
    amplitudes = np.linalg.solve(matrix, columns.conj() @ data[..., None])
    body = slice(0, model.body_columns)
    return np.asarray((amplitudes[:, body] * values[:, body]).sum(axis=1))
