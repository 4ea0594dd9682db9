"""The linear map from a reflectivity image to baseband scans, with its exact adjoint.

Sparse recovery and analysis through synthesis both rest on it; it depends on the antenna positions only, so
that a turntable and a free path are the same thing to them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.geometry import Aperture, ImageGrid
from tagid.imaging.kernel import RangeGeometry
from tagid.imaging.memory import require_memory
from tagid.imaging.types import BasebandScans

PHASE_STEP = 0.2
"""Phase of the carrier between fine range bins, rad. Between them the interpolated carrier is at most
PHASE_STEP^2 / 8 too small (0.5 %); `interpolation_gain` takes the mean of that off, 0.15 % rms stays."""

_ENVELOPE_STEPS = 4
"""Steps of an envelope within a range bin."""

_BLOCK_BINS = 32
"""Bins between the fine bins of one block of the spread, where it is kept in blocks,"""
_BANDED_FROM = 2
"""which it is from so many times the bins of a block on."""


class ForwardOperator:
    """y[v, b] = sum_p sigma_p response(R_b - d_vp) exp(-2j k d_vp), d_vp = |antenna_v - point_p|, or with two
    antennas half the way from the transmitter over the point to the receiver.

    It is applied in two stages, y = S G sigma: the sparse real G writes every point into two neighbours of
    a fine range grid (geometry only, computed as it goes), the small dense S puts the carrier on, convolves
    with the response and samples the bins. Both adjoints are exact: <A x, y> = <x, A^H y> to rounding.

    Args:
        scans: where the bins, the response, the wavenumber and the antenna positions come from; the samples
            are not used.
        target: image grid, or positions in m, (points, 2) in the plane z = 0 or (points, 3).

    Raises:
        UsageError: so many views and points that the operator would not fit in memory.
    """

    def __init__(self, scans: BasebandScans, target: ImageGrid | NDArray[np.floating]) -> None:
        points = target.points if isinstance(target, ImageGrid) else np.asarray(target, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] not in (2, 3) or len(points) == 0:
            raise UsageError(f"points have shape {points.shape}, expected (points, 2) or (points, 3)")
        if not np.isfinite(points).all():
            raise UsageError("points are not finite")
        views, bins = scans.aperture.views, scans.samples.shape[1]
        start, step, fine_bins = fine_range(scans, points)
        require_memory(
            8 * (fine_bins * (2 * views + 3 * _width(scans)) + 4 * len(points)),
            f"{views} views of points {start:.2f} to {start + step * fine_bins:.2f} m from the antenna",
            "Use fewer views or a smaller extent, and check the antenna positions (m, object's frame).",
        )
        self.geometry = RangeGeometry.of(scans.aperture, points, (start, step), fine_bins)
        self._spread = _Spread.of(scans, start + step * np.arange(fine_bins, dtype=np.float64))
        self._fine_step, self._phase_step = step, 2 * scans.wavenumber * step
        self.views, self.bins, self.points = views, bins, len(points)

    @property
    def shape(self) -> tuple[int, int]:
        """(views * bins, points)."""
        return self.views * self.bins, self.points

    def __call__(self, sigma: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """As `forward`: A(x)."""
        return self.forward(sigma)

    def forward(self, sigma: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """Scans (views, bins) complex64 of reflectivities (points,)."""
        return self._spread.forward(self.geometry.scatter(sigma))

    def forward_by_view(self, sigma: Iterable[NDArray[np.complexfloating]]) -> NDArray[np.complex64]:
        """As `forward`, where every view sees other reflectivities: (points,) of each view in turn."""
        by_view = (self.geometry.select(slice(view, view + 1)) for view in range(self.views))
        rows = [geometry.scatter(values) for geometry, values in zip(by_view, sigma, strict=True)]
        return self._spread.forward(np.concatenate(rows))

    def slope(self, sigma: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """Derivative (views, bins) of `forward` by a distance that all points move away by, per m."""
        # Central differences of a carrier that turns by phi a step are sin(phi) / phi too small.
        gain = 1 / np.sinc(self._phase_step / np.pi)
        return self._spread.slope(gain / self._fine_step).forward(self.geometry.scatter(sigma))

    def adjoint(self, scans: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """A^H y (points,) complex64 of scans (views, bins) or (views * bins,)."""
        y = np.asarray(scans, dtype=np.complex64).reshape(self.views, self.bins)
        return self.geometry.gather(self._spread.adjoint(y))

    @cached_property
    def norm_squared(self) -> float:
        """Largest eigenvalue of A^H A by twelve power iterations from a seeded start, a few % from below."""
        rng = np.random.default_rng(0)
        x = (rng.standard_normal(self.points) + 1j * rng.standard_normal(self.points)).astype(np.complex64)
        x /= np.float32(np.linalg.norm(x))
        norm = 0.0
        for _ in range(12):
            x = self.adjoint(self.forward(x))
            norm = float(np.linalg.norm(x))
            if norm == 0:
                return 0.0
            x /= np.float32(norm)
        return norm

    def select(self, views: NDArray[np.integer] | slice) -> ForwardOperator:
        """The operator of some views only, in the order given."""
        return self._with(self.geometry.select(views))

    def among(self, points: NDArray[np.bool_]) -> ForwardOperator:
        """The operator of some points only, (points,) bool."""
        return self._with(self.geometry.among(points))

    def _with(self, geometry: RangeGeometry) -> ForwardOperator:
        part = object.__new__(ForwardOperator)
        part.geometry = geometry
        part._spread = self._spread
        part._fine_step, part._phase_step = self._fine_step, self._phase_step
        part.views, part.bins, part.points = part.geometry.views, self.bins, part.geometry.points
        return part


def envelope(scans: BasebandScans, points: NDArray[np.float64]) -> NDArray[np.float32]:
    """(points,) what `ForwardOperator.adjoint` of the scans gives at most at points (points, 2) or (points,
    3), m, whatever the phases of the views: the sum of their magnitudes. It changes with the range
    resolution, not with the wavelength.
    """
    near, far = reach_of(scans.aperture, points)
    step = scans.range_step_m / _ENVELOPE_STEPS
    fine_m = near - step + step * np.arange(int(np.ceil((far - near) / step)) + 3, dtype=np.float64)
    rows = np.abs(_Spread.of(scans, fine_m, carrier=False).adjoint(scans.samples))
    geometry = RangeGeometry.of(scans.aperture, points, (near - step, step), len(fine_m))
    return np.asarray(geometry.gather(rows.astype(np.complex64)).real, dtype=np.float32)


def interpolation_gain(phase_step: float) -> float:
    """What makes up for linear interpolation of exp(j phi), on average over the place between two samples.

    1 / mean((1 - f) + f exp(j phi)) exp(-j f phi) = 1 / sinc^2(phi / 2).
    """
    return float(1 / np.sinc(phase_step / (2 * np.pi)) ** 2)


def fine_range(scans: BasebandScans, points: NDArray[np.float64]) -> tuple[float, float, int]:
    """First fine range (m), step (m) and number of fine bins, such that all points lie inside."""
    near, far = reach_of(scans.aperture, points)
    step = min(PHASE_STEP / (2 * scans.wavenumber), scans.range_step_m)
    return near - step, step, int(np.ceil((far - near) / step)) + 3


def reach_of(aperture: Aperture, points: NDArray[np.float64]) -> tuple[float, float]:
    """Bounds of the one-way ranges of points (n, 2) or (n, 3) over all views, m."""
    radius = float(np.hypot(points[:, 0], points[:, 1]).max())
    heights = (0.0, 0.0)
    if points.shape[1] == 3:
        heights = float(points[:, 2].min()), float(points[:, 2].max())
    near, far = aperture.span(radius, heights)
    return float(near.min()), float(far.max())


def products(scans: BasebandScans, points: NDArray[np.floating]) -> float:
    """Multiplications of one view by `ForwardOperator` besides those for its points: fine bins times the bins
    that a response reaches."""
    return float(fine_range(scans, np.asarray(points, dtype=np.float64))[2] * _width(scans))


def _width(scans: BasebandScans) -> int:
    """Bins that a block of the spread holds: all, unless they are many times the response's."""
    bins = scans.samples.shape[1]
    banded = _BLOCK_BINS + 2 * int(np.ceil(scans.response.half_width_m / scans.range_step_m)) + 2
    return banded if bins > _BANDED_FROM * banded else bins


@dataclass(frozen=True, eq=False)
class _Spread:
    """S^T (fine bins, bins): carrier and response of a point at each fine range, in every bin.

    A response reaches a few bins, so that of long scans (a flight over 100 m) only blocks along the diagonal
    are kept: each a slice of fine bins, a slice of bins, and the values between them.
    """

    blocks: tuple[tuple[slice, slice, NDArray[np.complex64]], ...]
    fine: int
    bins: int

    @classmethod
    def of(cls, scans: BasebandScans, fine_m: NDArray[np.float64], carrier: bool = True) -> _Spread:
        ranges, width = scans.ranges_m, _width(scans)
        step = float(fine_m[1] - fine_m[0])
        phase = 2 * scans.wavenumber if carrier else 0.0
        gain = interpolation_gain(phase * step)
        size, blocks = len(fine_m), []
        if width < len(ranges):
            size = max(1, int(_BLOCK_BINS * scans.range_step_m / step))
        for first in range(0, len(fine_m), size):
            part = slice(first, min(first + size, len(fine_m)))
            some, reach = slice(0, len(ranges)), scans.response.half_width_m
            if size < len(fine_m):
                ends = (fine_m[part.start] - reach, fine_m[part.stop - 1] + reach)
                some = slice(*(int(at) for at in np.searchsorted(ranges, ends)))
            turned = np.exp(-1j * phase * fine_m[part]) * gain
            response = scans.response(ranges[None, some] - fine_m[part, None])
            blocks.append((part, some, np.asarray(response * turned[:, None], dtype=np.complex64)))
        return cls(tuple(blocks), len(fine_m), len(ranges))

    @cached_property
    def _adjoints(self) -> list[NDArray[np.complex64]]:
        return [np.ascontiguousarray(values.conj().T) for *_, values in self.blocks]

    @cached_property
    def matrix(self) -> NDArray[np.complex64]:
        """(fine bins, bins)."""
        whole = np.zeros((self.fine, self.bins), dtype=np.complex64)
        for part, some, values in self.blocks:
            whole[part, some] = values
        return whole

    def forward(self, rows: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """(views, bins) of what is written on the fine bins, (views, fine bins)."""
        if len(self.blocks) == 1:
            return np.asarray(rows @ self.blocks[0][2], dtype=np.complex64)
        out = np.zeros((len(rows), self.bins), dtype=np.complex64)
        for part, some, values in self.blocks:
            out[:, some] += rows[:, part] @ values
        return out

    def adjoint(self, scans: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """(views, fine bins) of scans (views, bins)."""
        if len(self.blocks) == 1:
            return np.asarray(scans @ self._adjoints[0], dtype=np.complex64)
        out = np.empty((len(scans), self.fine), dtype=np.complex64)
        for (part, some, _), values in zip(self.blocks, self._adjoints, strict=True):
            out[:, part] = scans[:, some] @ values
        return out

    def slope(self, gain: float) -> _Spread:
        """Central differences along the fine bins, times a gain."""
        if len(self.blocks) == 1:
            ((part, some, values),) = self.blocks
            slope = np.asarray(np.gradient(values, axis=0), dtype=np.complex64)
            return _Spread(((part, some, slope * np.float32(gain)),), self.fine, self.bins)
        slopes = np.asarray(np.gradient(self.matrix, axis=0), dtype=np.complex64) * np.float32(gain)
        whole = (slice(0, self.fine), slice(0, self.bins), slopes)
        return _Spread((whole,), self.fine, self.bins)
