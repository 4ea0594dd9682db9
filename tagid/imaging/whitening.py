"""Scans whose noise has the same density at all frequencies of the pulse's band.

A receiver's filter colours its noise, and a transmitter in the band adds to it at one frequency. Only behind
a filter that makes the noise white are least squares the maximum-likelihood estimate (H. L. Van Trees,
*Detection, Estimation, and Modulation Theory*, part I, section 4.3).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tagid.imaging.types import BasebandScans, PointResponse


def whitened(scans: BasebandScans) -> BasebandScans:
    """The scans and their point response behind the filter 1 / sqrt(noise_shape).

    Reflectivities keep their values. Outside the pulse's band the filter keeps the gain of the band's edge.
    Scans of unknown noise are returned unchanged.
    """
    if len(scans.noise_shape) < 2:
        return scans
    shape = np.array(scans.noise_shape)
    at = np.linspace(-0.5, 0.5, len(shape)) * scans.bandwidth_hz

    def filtered(rows: NDArray[np.complexfloating], spacing_m: float) -> NDArray[np.complex128]:
        """Rows (..., n) of equal spacing in one-way range, behind the filter."""
        n = rows.shape[-1]
        frequency = np.fft.fftfreq(2 * n, 2 * spacing_m / scans.wave_speed_m_s)
        gain = 1 / np.sqrt(np.interp(frequency, at, shape))
        return np.asarray(np.fft.ifft(np.fft.fft(rows, 2 * n, axis=-1) * gain, axis=-1)[..., :n])

    response = filtered(scans.response.samples, scans.response.step_m)
    peak = abs(response[len(response) // 2])
    return replace(
        scans,
        samples=(filtered(scans.samples, scans.range_step_m) / peak).astype(np.complex64),
        response=PointResponse(response / peak, scans.response.step_m),
        noise_std=scans.noise_std / float(np.sqrt(shape.mean())) / peak,
        noise_density=scans.noise_density / peak**2,
        noise_shape=(),
    )
