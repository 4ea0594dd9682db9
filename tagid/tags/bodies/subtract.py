"""Scans without the body: what is left when the echo of the fitted body is subtracted.

A can returns 20 dB more than a tag's reflector, and standing off the axis it moves, so that an image shows
its wall and the sidelobes of that. Its echo is known once its centre is: one amplitude per frequency.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.constants import SPEED_OF_LIGHT
from tagid.imaging.types import BasebandScans
from tagid.tags.bodies.body_reading import BodyReading
from tagid.tags.bodies.hypothesis import BodyModel
from tagid.tags.bodies.reflectors_fit import Batch, Columns, solve
from tagid.tags.bodies.spectra import Spectra

PADDING = 1.5
"""Range bins of the transform over those recorded: the echo must not wrap around."""
BAND = 0.75
"""Half-width of the frequencies at which the echo is subtracted, over the bandwidth."""


def without_body(capture: Capture, reading: BodyReading) -> Capture:
    """The capture with the body's echo subtracted; the room and the reflectors stay.

    Frequency by frequency, the amplitude of the body is fitted together with those of the reflectors of the
    arrangement that explains the scans best, so that they do not leak into each other.

    Args:
        capture: prepared, on a turntable or at free positions: the one that was read.
        reading: the body that was found in it.
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
    band = _Band.of(spectrum, frequency, max(low, 0.0), high, positions, capture.range_start_m, 0.0)
    placed = min((*reading.layouts, *reading.others), key=lambda one: one.charged)
    taken = band.echo(reading.body, placed.batch)
    inverse = np.fft.irfft(taken, n, axis=1) if is_real else np.fft.ifft(taken, axis=1)
    samples = capture.samples - inverse[:, : capture.bins]
    return replace(capture, samples=samples.astype(np.float32 if is_real else np.complex64))


def scans_without(scans: BasebandScans, body: BodyModel, arrangement: Batch) -> BasebandScans:
    """Baseband scans with the echo of a body subtracted, as `without_body` does it.

    Args:
        scans: made without the matched filter.
        body: its model.
        arrangement: one row: where the body stands, and the reflectors whose echoes stay.
    """
    bins = scans.samples.shape[1]
    n = int(np.ceil(PADDING * bins))
    rate = scans.wave_speed_m_s / (2 * scans.range_step_m)
    spectrum = np.fft.fft(scans.samples, n, axis=1)
    carrier = 2 * scans.wavenumber
    frequency = carrier * scans.wave_speed_m_s / (4 * np.pi) + np.fft.fftfreq(n, 1 / rate)
    middle = scans.center_hz or scans.carrier_hz
    low, high = (middle + side * BAND * scans.bandwidth_hz for side in (-1, 1))
    band = _Band.of(spectrum, frequency, low, high, scans.aperture.positions, scans.range_start_m, carrier)
    inverse = np.fft.ifft(band.echo(body, arrangement), axis=1)[:, :bins]
    return replace(scans, samples=(scans.samples - inverse).astype(np.complex64))


@dataclass(frozen=True, eq=False)
class _Band:
    """The frequencies of a transform over range at which a body's echo is subtracted.

    Attributes:
        spectra: of the moving echo at these frequencies.
        reference: (F,) what turns a value of the transform into one of `spectra`.
        used: (F,) their indices in the transform.
        shape: (views, bins) of the transform.
    """

    spectra: Spectra
    reference: NDArray[np.complex128]
    used: NDArray[np.intp]
    shape: tuple[int, ...]

    @classmethod
    def of(
        cls,
        spectrum: NDArray[Any],
        frequency_hz: NDArray[np.floating],
        low_hz: float,
        high_hz: float,
        positions: NDArray[np.float64],
        range_start_m: float,
        carrier: float,
    ) -> _Band:
        """Of a transform (views, n) from the first range bin on; `carrier`: its kappa, rad/m, 0 for none."""
        distance = float(np.linalg.norm(positions, axis=1).mean())
        used = np.flatnonzero((frequency_hz >= low_hz) & (frequency_hz <= high_hz))
        used = used[np.argsort(frequency_hz[used])]
        kappa = np.asarray(4 * np.pi * frequency_hz[used] / SPEED_OF_LIGHT, dtype=np.float64)
        # The carrier's phase is that of the whole distance, not of the distance from the first bin.
        reference = np.exp(-1j * ((kappa - carrier) * (range_start_m - distance) - carrier * distance))
        data = (spectrum[:, used] * reference).T
        spectra = Spectra(
            np.asarray(data - data.mean(axis=1, keepdims=True), dtype=np.complex128),
            kappa,
            positions[:, 0] + 1j * positions[:, 1],
            np.ascontiguousarray(positions[:, 2]),
            distance,
            0.0,
        )
        return cls(spectra, reference, used, spectrum.shape)

    def echo(self, body: BodyModel, arrangement: Batch) -> NDArray[np.complex128]:
        """(views, n) transform of the body's echo beside the reflectors of an arrangement."""
        cols = Columns.of(self.spectra, body, arrangement)
        taken = np.zeros(self.shape, dtype=np.complex128)
        if cols.body is not None:
            amplitude = solve(self.spectra.data, cols.values).amplitudes[0, :, 0]
            taken[:, self.used] = (amplitude[:, None] * cols.body[0]).T / self.reference
        return taken
