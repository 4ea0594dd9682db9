"""The linear map from a reflectivity image to baseband scans, with its exact adjoint.

Sparse recovery and analysis through synthesis both rest on it; it depends on the antenna positions only, so
that a turntable and a free path are the same thing to them.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from tagid.errors import UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.types import BasebandScans

MAX_ENTRIES = 80_000_000
"""Largest number of (view, point) pairs: 12 bytes each, 1 GB."""

_FINE_ERROR = 4e-3
"""Largest error of the response on the fine range grid, relative to its peak; the phase stays exact."""

_CHUNK = 1 << 18

VIEWS_PER_BLOCK = 16
"""Views in one sparse block: their fine scans (some 1000 bins each) stay in a core's cache."""

MAX_THREADS = 8

_T = TypeVar("_T")


class ForwardOperator:
    """y[v, b] = sum_p sigma_p response(R_b - d_vp) exp(-2j k d_vp), d_vp = |antenna_v - point_p|.

    It is applied in two stages, y = S G sigma: the sparse G puts every point with its phase into the nearest
    bin of a fine range grid (one entry for each view and point), the small dense S convolves with the
    response and samples the bins. Both adjoints are exact: <A x, y> = <x, A^H y> to rounding.

    Args:
        scans: where the bins, the response, the wavenumber and the antenna positions come from; the samples
            are not used.
        target: image grid, or (points, 2) positions x, y in m in the plane z = 0.

    Raises:
        UsageError: so many views and points that the operator would not fit in memory.
    """

    def __init__(self, scans: BasebandScans, target: ImageGrid | NDArray[np.floating]) -> None:
        points = target.points if isinstance(target, ImageGrid) else np.asarray(target, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) == 0:
            raise UsageError(f"points have shape {points.shape}, expected (points, 2)")
        views, bins = scans.aperture.views, scans.samples.shape[1]
        if views * len(points) > MAX_ENTRIES:
            raise UsageError(
                f"{views} views of {len(points)} points need {views * len(points) * 12 / 1e9:.1f} GB",
                "Use fewer pixels or fewer views.",
            )
        near, far, step = _fine_range(scans, points)
        self.views, self.bins, self.points = views, bins, len(points)
        self._fine_bins = int(np.ceil((far - near) / step)) + 2
        if self._fine_bins * bins > MAX_ENTRIES:
            raise UsageError(
                f"the points lie {near:.2f} to {far:.2f} m from the antenna: too far apart for one operator",
                "Check the antenna positions (metres, in the object's frame) and the extent of the image.",
            )
        fine = near + step * np.arange(self._fine_bins)
        self._response = scans.response(scans.ranges_m[None, :] - fine[:, None]).astype(np.complex64)
        self._blocks = [
            self._block(*_interpolation(scans, points, views_of_block, (near, step)))
            for views_of_block in _split(views)
        ]

    def _block(self, index: NDArray[np.int32], weight: NDArray[np.complex64]) -> sparse.csc_array:
        """G of some views, CSC (k * fine bins, points), from fine bins and phases (points, k).

        By columns it needs no sorting to build; few views a block keep the fine scans in the cache.
        """
        k = index.shape[1]
        index += (np.arange(k, dtype=np.int32) * self._fine_bins)[None, :]
        starts = np.arange(0, index.size + 1, k, dtype=np.int32)
        parts: Any = (weight.ravel(), index.ravel(), starts)
        return sparse.csc_array(parts, shape=(k * self._fine_bins, self.points))

    @property
    def shape(self) -> tuple[int, int]:
        """(views * bins, points)."""
        return self.views * self.bins, self.points

    def forward(self, sigma: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """Scans (views, bins) complex64 of reflectivities (points,)."""
        x = np.asarray(sigma, dtype=np.complex64).reshape(self.points)
        fine = np.concatenate(_each(lambda block: block @ x, self._blocks))
        return np.asarray(fine.reshape(self.views, self._fine_bins) @ self._response, dtype=np.complex64)

    def adjoint(self, scans: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """A^H y (points,) complex64 of scans (views, bins) or (views * bins,)."""
        y = np.asarray(scans, dtype=np.complex64).reshape(self.views, self.bins)
        fine = (y.conj() @ self._response.T).ravel()
        starts = np.cumsum([0, *(block.shape[0] for block in self._blocks)])
        pairs = [
            (block.T, fine[at : at + block.shape[0]]) for block, at in zip(self._blocks, starts, strict=False)
        ]
        return np.asarray(
            np.sum(_each(lambda pair: pair[0] @ pair[1], pairs), axis=0).conj(), dtype=np.complex64
        )

    def norm_squared(self, iterations: int = 12, seed: int = 0) -> float:
        """Largest eigenvalue of A^H A by power iteration from a seeded start (a few % from below)."""
        rng = np.random.default_rng(seed)
        x = (rng.standard_normal(self.points) + 1j * rng.standard_normal(self.points)).astype(np.complex64)
        x /= np.float32(np.linalg.norm(x))
        norm = 0.0
        for _ in range(iterations):
            x = self.adjoint(self.forward(x))
            norm = float(np.linalg.norm(x))
            if norm == 0:
                return 0.0
            x /= np.float32(norm)
        return norm

    def select(self, views: NDArray[np.integer] | slice) -> ForwardOperator:
        """The operator of some views only, in the order given; no geometry is computed again."""
        chosen = np.arange(self.views)[views]
        part = object.__new__(ForwardOperator)
        part.views, part.bins, part.points = len(chosen), self.bins, self.points
        part._fine_bins, part._response = self._fine_bins, self._response
        part._blocks = []
        for group in _split(len(chosen)):
            index = np.empty((self.points, len(chosen[group])), dtype=np.int32)
            weight = np.empty(index.shape, dtype=np.complex64)
            for i, view in enumerate(chosen[group]):
                block, at = self._blocks[view // VIEWS_PER_BLOCK], view % VIEWS_PER_BLOCK
                index[:, i] = block.indices.reshape(self.points, -1)[:, at] - at * self._fine_bins
                weight[:, i] = block.data.reshape(self.points, -1)[:, at]
            part._blocks.append(part._block(index, weight))
        return part

    @property
    def stages(self) -> tuple[sparse.csr_array, NDArray[np.complex64]]:
        """G (views * fine bins, points) and S^T (fine bins, bins): y = (G x).reshape(views, -1) @ S^T."""
        return sparse.csr_array(sparse.vstack(self._blocks, format="csr")), self._response

    @cached_property
    def matrix(self) -> sparse.csr_array:
        """A itself, CSR complex64 (views * bins, points); some ten times larger than the two stages."""
        spread = sparse.csr_array(self._response.T)
        rows = [
            spread @ block[at : at + self._fine_bins]
            for block in (sparse.csr_array(b) for b in self._blocks)
            for at in range(0, block.shape[0], self._fine_bins)
        ]
        matrix = sparse.csr_array(sparse.vstack(rows, format="csr"))
        matrix.sort_indices()
        return matrix


def _split(views: int) -> list[slice]:
    return [slice(at, min(at + VIEWS_PER_BLOCK, views)) for at in range(0, views, VIEWS_PER_BLOCK)]


def _each(work: Callable[[_T], NDArray[np.complex64]], parts: list[_T]) -> list[NDArray[np.complex64]]:
    """work(part) of every part, in order, on as many threads as pay (scipy's products let go of the GIL)."""
    threads = min(len(parts), os.cpu_count() or 1, MAX_THREADS)
    if threads < 2:
        return [work(part) for part in parts]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, parts))


def _fine_range(scans: BasebandScans, points: NDArray[np.float64]) -> tuple[float, float, float]:
    """First and last fine range and step, m: all points lie inside, rounding to it costs little."""
    antenna = scans.aperture.positions
    radius = float(np.hypot(points[:, 0], points[:, 1]).max())
    across = np.hypot(antenna[:, 0], antenna[:, 1])
    near = float(np.hypot(np.maximum(across - radius, 0), antenna[:, 2]).min())
    far = float(np.hypot(across + radius, antenna[:, 2]).max())
    response = scans.response
    slope = float(np.abs(np.diff(response.samples)).max()) / response.step_m
    step = min(2 * _FINE_ERROR / slope, scans.range_step_m)
    return near - step, far + step, step


def _interpolation(
    scans: BasebandScans, points: NDArray[np.float64], views: slice, fine: tuple[float, float]
) -> tuple[NDArray[np.int32], NDArray[np.complex64]]:
    """Fine bins and phases (points, k) of every point in some views; `fine` is (first range, step), m."""
    antenna = scans.aperture.positions[views]
    near, step = fine
    shape = (len(points), len(antenna))
    index = np.empty(shape, dtype=np.int32)
    weight = np.empty(shape, dtype=np.complex64)
    rows = max(1, _CHUNK // len(antenna))
    for at in range(0, len(points), rows):
        part = slice(at, at + rows)
        x, y = points[part, 0, None], points[part, 1, None]
        distance = np.sqrt((x - antenna[:, 0]) ** 2 + (y - antenna[:, 1]) ** 2 + antenna[:, 2] ** 2)
        index[part] = ((distance - near) / step + 0.5).astype(np.int32)
        # The phase is reduced to one turn in double precision before single precision takes over.
        turns = distance * (scans.wavenumber / np.pi)
        angle = ((turns - np.rint(turns)) * (-2 * np.pi)).astype(np.float32)
        weight[part].real, weight[part].imag = np.cos(angle), np.sin(angle)
    return index, weight
