"""Baseband scans straight from their definition, so that the reader is tested without the code before it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.constants import CENTER_FREQUENCY_HZ, SPEED_OF_LIGHT
from tagid.geometry import Aperture
from tagid.imaging.types import BasebandScans, PointResponse

STEP_M = 0.05
"""Range step: 3 GHz complex rate, 1.76 times the band of 1.7 GHz."""


def response() -> PointResponse:
    """Baseband envelope of the nominal pulse over one-way range, exp(-(2r/c)^2 / (2 tau^2))."""
    tau = np.sqrt(np.log(10)) / (np.pi * 1.7e9)
    r = np.arange(-200, 201) * 1e-3
    return PointResponse(np.exp(-((2 * r / SPEED_OF_LIGHT) ** 2) / (2 * tau**2)).astype(complex), 1e-3)


def synthetic_scans(
    points: NDArray[np.floating],
    *,
    amplitudes: NDArray[np.complexfloating] | None = None,
    views: int = 36,
    axis_distance: float = 0.5,
    noise: float = 0.0,
    distance_error: float = 0.0,
    seed: int = 0,
) -> BasebandScans:
    """samples[v, b] = sum_p sigma_p g(R_b - d_vp) exp(-2jk d_vp) + complex noise of std a sample."""
    rng = np.random.default_rng(seed)
    angles = np.arange(views) * 2 * np.pi / views
    aperture = Aperture.turntable(angles, axis_distance)
    ranges = np.arange(axis_distance - 0.4, axis_distance + 0.4, STEP_M)
    k = 2 * np.pi * CENTER_FREQUENCY_HZ / SPEED_OF_LIGHT
    g = response()
    points = np.asarray(points, dtype=float).reshape(-1, 2)
    sigma = np.ones(len(points)) if amplitudes is None else np.asarray(amplitudes)
    samples = np.zeros((views, len(ranges)), dtype=complex)
    for (x, y), a in zip(points, sigma, strict=True):
        d = np.hypot(x - aperture.positions[:, 0], y - aperture.positions[:, 1])
        samples += a * g(ranges[None] - d[:, None]) * np.exp(-2j * k * d[:, None])
    white = rng.standard_normal((2, *samples.shape))
    samples += noise * (white[0] + 1j * white[1]) / np.sqrt(2)
    stated = aperture.with_axis_distance(axis_distance + distance_error)
    return BasebandScans(
        samples.astype(np.complex64),
        float(ranges[0]),
        STEP_M,
        CENTER_FREQUENCY_HZ,
        g,
        stated,
        noise_std=noise,
        independent_samples=float(samples.size),
    )
