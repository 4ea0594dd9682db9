"""Coherent backprojection, the image that every other method is compared with.

It needs no operator in memory: the carrier is put back onto finely upsampled scans, so that one look-up for
each view and pixel gives amplitude and phase together.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
from scipy import fft as sfft

from tagid.geometry import ImageGrid
from tagid.imaging.types import BasebandScans, Image

PHASE_STEP = 0.05
"""Largest phase of the carrier between samples of the upsampled scans, rad: the nearest sample is then off by
at most 0.025 rad, at random over views (rms 0.015), which costs a coherent peak 0.01 %."""

_VIEWS_PER_BLOCK = 16


def backproject(scans: BasebandScans, grid: ImageGrid, threads: int | None = None) -> Image:
    """f(p) = 1/views sum_v z_v(d_vp) exp(2j k d_vp), z_v the baseband scan of view v at range d_vp.

    A unit point far from others gives |f| = 1 at its place. With matched-filtered scans this is the matched
    filter in angle and range; it equals the adjoint of `ForwardOperator` up to the range response and scale.

    Args:
        scans: baseband scans, any aperture.
        grid: pixels, in the plane z = 0.
        threads: worker threads; None takes one per core, at most 8.
    """
    workers = max(1, min(threads or min(os.cpu_count() or 1, 8), scans.aperture.views))
    views = np.array_split(np.arange(scans.aperture.views), workers)
    if workers == 1:
        total = _accumulate(scans, grid.axis, views[0])
    else:
        with ThreadPoolExecutor(workers) as pool:
            total = np.sum(list(pool.map(lambda part: _accumulate(scans, grid.axis, part), views)), axis=0)
    values = np.asarray(total / np.float32(scans.aperture.views), dtype=np.complex64)
    return Image(values, grid, {"method": "bp", "axis_distance_m": scans.aperture.axis_distance})


def _accumulate(
    scans: BasebandScans, axis: NDArray[np.float64], views: NDArray[np.intp]
) -> NDArray[np.complex64]:
    """Sum over some views on the grid axis x axis, (pixels, pixels), index (y, x)."""
    size = len(axis)
    total = np.zeros((size, size), dtype=np.complex64)
    distance = np.empty((size, size), dtype=np.float32)
    index = np.empty((size, size), dtype=np.intp)
    echo = np.empty((size, size), dtype=np.complex64)
    for at in range(0, len(views), _VIEWS_PER_BLOCK):
        part = views[at : at + _VIEWS_PER_BLOCK]
        fine, start, step = upsample_at_carrier(scans, part)
        last = np.float32(fine.shape[1] - 1)
        for row, (x, y, z) in zip(fine, scans.aperture.positions[part], strict=True):
            # In units of fine samples, so that the root is the index; +0.5 - start rounds to the nearest.
            dx2 = ((axis - x) / step) ** 2
            dy2 = ((axis - y) ** 2 + z**2) / step**2
            np.add(dy2.astype(np.float32)[:, None], dx2.astype(np.float32), out=distance)
            np.sqrt(distance, out=distance)
            np.subtract(distance, np.float32(start / step - 0.5), out=distance)
            np.clip(distance, np.float32(0), last, out=distance)
            np.copyto(index, distance, casting="unsafe")
            np.take(row, index, out=echo, mode="clip")
            total += echo
    return total


def upsample_at_carrier(
    scans: BasebandScans, views: NDArray[np.intp] | slice
) -> tuple[NDArray[np.complex64], float, float]:
    """Scans z(R) exp(2j k R) on a range grid so fine that the nearest sample will do.

    Returns:
        samples (views, fine bins) complex64, range of the first (m), range step (m). The first and the last
        sample are zero, for all that lies outside the data.
    """
    baseband = scans.samples[views]
    bins = baseband.shape[1]
    factor = max(1, int(np.ceil(2 * scans.wavenumber * scans.range_step_m / PHASE_STEP)))
    # The pad keeps the periodic interpolation from carrying the last bins over to the first.
    n = int(sfft.next_fast_len(bins + 16))
    spectrum = sfft.fft(baseband, n, axis=1)
    half = (n + 1) // 2
    wide = np.zeros((len(baseband), n * factor), dtype=np.complex64)
    wide[:, :half] = spectrum[:, :half]
    wide[:, -(n - half) :] = spectrum[:, half:]
    count = (bins - 1) * factor + 1
    step = scans.range_step_m / factor
    ranges = scans.range_start_m + step * np.arange(count)
    carrier = np.exp(2j * scans.wavenumber * ranges) * factor
    fine = sfft.ifft(wide, axis=1, overwrite_x=True)
    out = np.zeros((len(baseband), count + 2), dtype=np.complex64)
    np.multiply(fine[:, :count], carrier.astype(np.complex64), out=out[:, 1:-1])
    return out, scans.range_start_m - step, step
