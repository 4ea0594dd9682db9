"""The linear map from a reflectivity image to baseband scans, with its exact adjoint.

Sparse recovery and analysis through synthesis both rest on it; it depends on the antenna positions only, so
that a turntable and a free path are the same thing to them.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from tagid.errors import UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.types import BasebandScans

MAX_ENTRIES = 80_000_000
"""Largest number of (view, point) pairs: 24 bytes each, 1.9 GB."""

_FINE_ERROR = 1.5e-3
"""Largest error of the linear interpolation onto the fine range grid, relative to the response's peak."""

_CHUNK = 1 << 21


class ForwardOperator:
    """y[v, b] = sum_p sigma_p response(R_b - d_vp) exp(-2j k d_vp), d_vp = |antenna_v - point_p|.

    It is applied in two stages, y = S G sigma: the sparse G puts every point on a fine range grid by linear
    interpolation (two entries for each view and point), the small dense S convolves with the response and
    samples the bins. Both adjoints are exact: <A x, y> = <x, A^H y> to rounding.

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
                f"{views} views of {len(points)} points need {views * len(points) * 24 / 1e9:.1f} GB",
                "Use fewer pixels or fewer views.",
            )
        self.views, self.bins, self.points = views, bins, len(points)
        near, far, step = _fine_range(scans, points)
        self._fine_bins = int(np.ceil((far - near) / step)) + 2
        index, weight = _interpolation(scans, points, near, step)
        fine = near + step * np.arange(self._fine_bins)
        self._response = scans.response(scans.ranges_m[None, :] - fine[:, None]).astype(np.complex64)
        self._set(index, weight)

    def _set(self, index: NDArray[np.int32], weight: NDArray[np.complex64]) -> None:
        # Stored by points, index and weight (points, views, 2): no sorting to build, cheap choice of views.
        self._index, self._weight = index, weight
        rows = index + (np.arange(self.views, dtype=np.int32) * self._fine_bins)[None, :, None]
        starts = np.arange(0, rows.size + 1, 2 * self.views, dtype=np.int32)
        shape = (self.views * self._fine_bins, self.points)
        parts: Any = (weight.ravel(), rows.ravel(), starts)
        self._gather: sparse.csc_array = sparse.csc_array(parts, shape=shape)
        self._gather_t: sparse.csr_array = self._gather.T

    @property
    def shape(self) -> tuple[int, int]:
        """(views * bins, points)."""
        return self.views * self.bins, self.points

    def forward(self, sigma: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """Scans (views, bins) complex64 of reflectivities (points,)."""
        x = np.asarray(sigma, dtype=np.complex64).reshape(self.points)
        fine = (self._gather @ x).reshape(self.views, self._fine_bins)
        return np.asarray(fine @ self._response, dtype=np.complex64)

    def adjoint(self, scans: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """A^H y (points,) complex64 of scans (views, bins) or (views * bins,)."""
        y = np.asarray(scans, dtype=np.complex64).reshape(self.views, self.bins)
        fine = y.conj() @ self._response.T
        return np.asarray((self._gather_t @ fine.ravel()).conj(), dtype=np.complex64)

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
        """The operator of some views only; no geometry is computed again."""
        part = object.__new__(ForwardOperator)
        index, weight = self._index[:, views], self._weight[:, views]
        part.views, part.bins, part.points = index.shape[1], self.bins, self.points
        part._fine_bins, part._response = self._fine_bins, self._response
        part._set(index, weight)
        return part

    @property
    def stages(self) -> tuple[sparse.csc_array, NDArray[np.complex64]]:
        """G (views * fine bins, points) and S^T (fine bins, bins): y = (G x).reshape(views, -1) @ S^T."""
        return self._gather, self._response

    @cached_property
    def matrix(self) -> sparse.csr_array:
        """A itself, CSR complex64 (views * bins, points); larger and slower than the two stages."""
        spread = sparse.csr_array(self._response.T)
        blocks = [
            spread @ self._gather_t[:, v * self._fine_bins : (v + 1) * self._fine_bins].T.tocsr()
            for v in range(self.views)
        ]
        matrix = sparse.csr_array(sparse.vstack(blocks, format="csr"))
        matrix.sort_indices()
        return matrix


def _fine_range(scans: BasebandScans, points: NDArray[np.float64]) -> tuple[float, float, float]:
    """First and last fine range and step, m: all points lie inside, the interpolation error is small."""
    antenna = scans.aperture.positions
    radius = float(np.hypot(points[:, 0], points[:, 1]).max())
    across = np.hypot(antenna[:, 0], antenna[:, 1])
    near = float(np.hypot(np.maximum(across - radius, 0), antenna[:, 2]).min())
    far = float(np.hypot(across + radius, antenna[:, 2]).max())
    response = scans.response
    bend = float(np.abs(np.diff(response.samples, 2)).max()) / response.step_m**2
    step = min(float(np.sqrt(8 * _FINE_ERROR / bend)), scans.range_step_m)
    return near - step, far + step, step


def _interpolation(
    scans: BasebandScans, points: NDArray[np.float64], near: float, step: float
) -> tuple[NDArray[np.int32], NDArray[np.complex64]]:
    """Fine bins and weights (points, views, 2) of every point in every view."""
    antenna = scans.aperture.positions
    shape = (len(points), len(antenna), 2)
    index = np.empty(shape, dtype=np.int32)
    weight = np.empty(shape, dtype=np.complex64)
    block = max(1, _CHUNK // len(antenna))
    for at in range(0, len(points), block):
        part = slice(at, at + block)
        x, y = points[part, 0, None], points[part, 1, None]
        distance = np.sqrt((x - antenna[:, 0]) ** 2 + (y - antenna[:, 1]) ** 2 + antenna[:, 2] ** 2)
        position = (distance - near) / step
        lower = position.astype(np.int32)
        fraction = (position - lower).astype(np.float32)
        # The phase is reduced to one turn in double precision before single precision takes over.
        turns = distance * (scans.wavenumber / np.pi)
        angle = ((turns - np.rint(turns)) * (-2 * np.pi)).astype(np.float32)
        phase = np.empty(angle.shape, dtype=np.complex64)
        phase.real, phase.imag = np.cos(angle), np.sin(angle)
        index[part, :, 0], index[part, :, 1] = lower, lower + 1
        weight[part, :, 0], weight[part, :, 1] = phase * (1 - fraction), phase * fraction
    return index, weight
