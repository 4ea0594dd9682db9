"""A radar of a few lines for the imaging tests; its pulse is written down, not taken from the package.

y[v, b] = sum_p A_p Re p(2 (R_b - d_vp) / c), p a Gaussian-windowed carrier.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.geometry import Aperture
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans

C = 299_792_458.0
FC, BANDWIDTH = 3.95e9, 1.7e9
TAU = np.sqrt(np.log(10)) / (np.pi * BANDWIDTH)
STEP_M = 0.0091488


def analytic_echo(offset_m: NDArray[np.floating]) -> NDArray[np.complex128]:
    """Analytic echo at range offsets R - d from its centre, envelope peak 1."""
    t = 2 * np.asarray(offset_m) / C
    return np.exp(-(t**2) / (2 * TAU**2) + 2j * np.pi * FC * t)


def turn(views: int, axis_distance: float = 1.0, height: float = 0.0, apart: float = 0.0) -> Aperture:
    return Aperture.turntable(np.arange(views) * 2 * np.pi / views, axis_distance, height, apart)


def helix(views: int) -> Aperture:
    """Free positions in three dimensions, every one at another distance and height."""
    a = np.arange(views) * 2 * np.pi / views
    radius = 1.0 + 0.1 * np.sin(3 * a)
    positions = np.stack([radius * np.cos(a), radius * np.sin(a), 0.2 + 0.1 * np.cos(2 * a)], axis=1)
    return Aperture(positions)


def antennas_of(aperture: Aperture) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Transmitter and receiver, (views, 3) each."""
    half = np.zeros(3) if aperture.half_baseline is None else aperture.half_baseline
    return aperture.positions + half, aperture.positions - half


def record(
    points: object,
    amplitudes: object,
    aperture: Aperture,
    *,
    bins: int = 130,
    start_m: float | None = None,
    step_m: float = STEP_M,
    noise: float = 0.0,
    seed: int = 0,
    analytic: bool = False,
) -> Capture:
    """Capture of points (n, 2) in the object's plane, or (n, 3), m."""
    xyz = np.asarray(points, dtype=float)
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        xy = xyz.reshape(-1, 2)
        xyz = np.column_stack([xy, np.zeros(len(xy))])
    ways = [np.linalg.norm(antenna[:, None] - xyz, axis=2) for antenna in antennas_of(aperture)]
    distance = (ways[0] + ways[1]) / 2
    centre = float(np.linalg.norm(aperture.positions, axis=1).mean())
    start = centre - bins // 2 * step_m if start_m is None else start_m
    ranges = start + step_m * np.arange(bins)
    echoes = analytic_echo(ranges[None, :, None] - distance[:, None, :])
    z = (echoes * np.asarray(amplitudes)).sum(axis=-1)
    rng = np.random.default_rng(seed)
    if analytic:
        samples = z + noise * (rng.standard_normal(z.shape) + 1j * rng.standard_normal(z.shape)) / np.sqrt(2)
        data = samples.astype(np.complex64)
    else:
        data = (z.real + noise * rng.standard_normal(z.shape)).astype(np.float32)
    free = aperture.angles is None
    transmit, receive = antennas_of(aperture)
    apart = 2 * np.linalg.norm(aperture.half_baseline[0]) if aperture.half_baseline is not None else 0.0
    return Capture(
        data,
        start,
        step_m,
        angles_rad=aperture.angles,
        axis_distance_m=aperture.axis_distance,
        antenna_height_m=aperture.height,
        antenna_separation_m=0.0 if free else apart,
        antenna_positions_m=transmit if free else None,
        receive_positions_m=receive if free and apart else None,
    )


def scans_from(capture: Capture, extent_m: float, *, matched: bool = False) -> BasebandScans:
    """Its scans for an image of `extent_m`, m, nothing of the room taken off."""
    return preprocess(capture, settings=PreprocessSettings("none", matched, extent_m=extent_m))
