"""Coherent backprojection, the image that every other method is compared with.

It needs no operator in memory: the carrier is put back onto upsampled scans, so that one look-up for each
view and pixel gives amplitude and phase together.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from tagid.geometry import ImageGrid
from tagid.imaging.kernel import RangeGeometry, cores
from tagid.imaging.memory import require_memory
from tagid.imaging.operator import interpolation_gain
from tagid.imaging.rangefilter import fast_length
from tagid.imaging.types import BasebandScans, Image

PHASE_STEP = 0.35
"""Phase of the carrier between samples of the upsampled scans, rad: the interpolated carrier is within 0.8 %
of its size, at random over views, which is 0.1 % of the image's peak."""

_VALUES_PER_BLOCK = 1 << 22
"""Upsampled samples held at a time, 32 MB."""


_ROWS_AT_ONCE = 90
"""Scans that a thread upsamples at a time: some 800 kB."""


def backproject(scans: BasebandScans, grid: ImageGrid) -> Image:
    """f(p) = 1/views sum_v z_v(d_vp) exp(2j k d_vp), z_v the baseband scan of view v at range d_vp, of any
    aperture.

    A unit point far from others gives |f| = 1 at its place. With matched-filtered scans this is the matched
    filter in angle and range; it equals the adjoint of `ForwardOperator` up to the range response and scale.
    Raises UsageError if it would not fit into memory.
    """
    views, pixels = scans.aperture.views, grid.pixels**2
    require_memory(
        40 * pixels + 24 * min(views * scans.samples.shape[1] * upsampling(scans), _VALUES_PER_BLOCK),
        f"backprojections of {views} views to {grid.pixels} x {grid.pixels} pixels",
        "Use fewer pixels (`imaging.pixels`).",
    )
    points = grid.points
    total = np.zeros(len(points), dtype=np.complex64)
    block = max(1, _VALUES_PER_BLOCK // (scans.samples.shape[1] * upsampling(scans)))
    for at in range(0, views, block):
        part = slice(at, at + block)
        rows, start, step = upsample_at_carrier(scans, part)
        geometry = RangeGeometry.of(scans.aperture.select(part), points, (start, step), rows.shape[1])
        total += geometry.gather(rows)
    total /= np.float32(views)
    values = total.reshape(grid.pixels, grid.pixels)
    return Image(values, grid, {"method": "bp", "axis_distance_m": scans.aperture.axis_distance})


def upsampling(scans: BasebandScans) -> int:
    """How many times finer than the scans the carrier is sampled."""
    return max(1, int(np.ceil(2 * scans.wavenumber * scans.range_step_m / PHASE_STEP)))


def upsample_at_carrier(
    scans: BasebandScans, views: NDArray[np.intp] | slice
) -> tuple[NDArray[np.complex64], float, float]:
    """Scans z(R) exp(2j k R) on a range grid so fine that linear interpolation will do.

    Returns samples (views, fine bins) complex64, range of the first and step, m. The first and the last
    sample are zero, for all that lies outside the data.
    """
    baseband = scans.samples[views]
    bins = baseband.shape[1]
    factor = upsampling(scans)
    # The pad keeps the periodic interpolation from carrying the last bins over to the first.
    n = fast_length(bins + 16)
    spectrum = np.fft.fft(baseband, n, axis=1)
    half = (n + 1) // 2
    count = (bins - 1) * factor + 1
    step = scans.range_step_m / factor
    ranges = scans.range_start_m + step * np.arange(count)
    gain = factor * interpolation_gain(2 * scans.wavenumber * step)
    carrier = (np.exp(2j * scans.wavenumber * ranges) * gain).astype(np.complex64)
    out = np.zeros((len(baseband), count + 2), dtype=np.complex64)

    def fill(rows: slice) -> None:
        wide = np.zeros((len(spectrum[rows]), n * factor), dtype=np.complex64)
        wide[:, :half] = spectrum[rows, :half]
        wide[:, -(n - half) :] = spectrum[rows, half:]
        np.fft.ifft(wide, axis=1, out=wide)  # type: ignore[arg-type]  # numpy's stubs know complex128 alone
        np.multiply(wide[:, :count], carrier, out=out[rows, 1:-1])

    # Blocks that stay in a core's cache.
    blocks = [slice(at, at + _ROWS_AT_ONCE) for at in range(0, len(baseband), _ROWS_AT_ONCE)]
    if len(blocks) == 1:
        # Starting threads would take as long as the work.
        fill(blocks[0])
        return out, scans.range_start_m - step, step
    with ThreadPoolExecutor(cores()) as threads:
        list(threads.map(fill, blocks))
    return out, scans.range_start_m - step, step
