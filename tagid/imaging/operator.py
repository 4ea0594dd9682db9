"""The linear map from a reflectivity image to baseband scans, with its exact adjoint.

Sparse recovery and analysis through synthesis both rest on it; it depends on the antenna positions only, so
that a turntable and a free path are the same thing to them.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.geometry import Aperture, ImageGrid
from tagid.imaging.kernel import RangeGeometry
from tagid.imaging.memory import require_memory
from tagid.imaging.types import BasebandScans

if TYPE_CHECKING:
    from scipy import sparse

PHASE_STEP = 0.2
"""Phase of the carrier between fine range bins, rad. Between them the interpolated carrier is at most
PHASE_STEP^2 / 8 too small (0.5 %); `interpolation_gain` takes the mean of that off, 0.15 % rms stays."""


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
            8 * (fine_bins * (2 * views + 3 * bins) + 4 * len(points)),
            f"{views} views of points {start:.2f} to {start + step * fine_bins:.2f} m from the antenna",
            "Use fewer views or a smaller extent, and check the antenna positions (m, object's frame).",
        )
        self.geometry = RangeGeometry.of(scans.aperture, points, (start, step), fine_bins)
        self._spread = _spread(scans, start + step * np.arange(fine_bins, dtype=np.float64))
        self._collect = np.ascontiguousarray(self._spread.conj().T)
        self._fine_step, self._phase_step = step, 2 * scans.wavenumber * step
        self.views, self.bins, self.points = views, bins, len(points)
        self._norms: dict[tuple[int, int], float] = {}

    @property
    def shape(self) -> tuple[int, int]:
        """(views * bins, points)."""
        return self.views * self.bins, self.points

    def __call__(self, sigma: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """As `forward`: A(x)."""
        return self.forward(sigma)

    def forward(self, sigma: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """Scans (views, bins) complex64 of reflectivities (points,)."""
        return np.asarray(self.geometry.scatter(sigma) @ self._spread, dtype=np.complex64)

    def forward_by_view(self, sigma: Iterable[NDArray[np.complexfloating]]) -> NDArray[np.complex64]:
        """As `forward`, where every view sees other reflectivities: (points,) of each view in turn."""
        by_view = (self.geometry.select(slice(view, view + 1)) for view in range(self.views))
        rows = [geometry.scatter(values) for geometry, values in zip(by_view, sigma, strict=True)]
        return np.asarray(np.concatenate(rows) @ self._spread, dtype=np.complex64)

    def slope(self, sigma: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """Derivative (views, bins) of `forward` by a distance that all points move away by, per m."""
        step = self._fine_step
        by_range = np.asarray(np.gradient(self._spread, step, axis=0), dtype=np.complex64)
        # Central differences of a carrier that turns by phi a step are sin(phi) / phi too small.
        gain = np.float32(1 / np.sinc(self._phase_step / np.pi))
        return np.asarray(self.geometry.scatter(sigma) @ (by_range * gain), dtype=np.complex64)

    def adjoint(self, scans: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """A^H y (points,) complex64 of scans (views, bins) or (views * bins,)."""
        y = np.asarray(scans, dtype=np.complex64).reshape(self.views, self.bins)
        return self.geometry.gather(y @ self._collect)

    def envelope(self, scans: NDArray[np.complexfloating]) -> NDArray[np.float32]:
        """(points,) what `adjoint` would give at most, whatever the phases of the views: the sum of their
        magnitudes. It changes with the range resolution, not with the wavelength."""
        y = np.asarray(scans, dtype=np.complex64).reshape(self.views, self.bins)
        rows = np.abs(y @ self._collect).astype(np.complex64)
        return np.asarray(self.geometry.gather(rows).real, dtype=np.float32)

    def norm_squared(self, iterations: int = 12, seed: int = 0) -> float:
        """Largest eigenvalue of A^H A by power iteration from a seeded start (a few % from below); kept."""
        if (iterations, seed) not in self._norms:
            self._norms[iterations, seed] = self._power_iteration(iterations, seed)
        return self._norms[iterations, seed]

    def _power_iteration(self, iterations: int, seed: int) -> float:
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
        """The operator of some views only, in the order given."""
        return self._with(self.geometry.select(views))

    def among(self, points: NDArray[np.bool_]) -> ForwardOperator:
        """The operator of some points only, (points,) bool."""
        return self._with(self.geometry.among(points))

    def _with(self, geometry: RangeGeometry) -> ForwardOperator:
        part = object.__new__(ForwardOperator)
        part.geometry = geometry
        part._spread, part._collect = self._spread, self._collect
        part._fine_step, part._phase_step = self._fine_step, self._phase_step
        part.views, part.bins, part.points = part.geometry.views, self.bins, part.geometry.points
        part._norms = {}
        return part

    @property
    def stages(self) -> tuple[sparse.csr_array, NDArray[np.complex64]]:
        """G (views * fine bins, points) and S^T (fine bins, bins): y = (G x).reshape(views, -1) @ S^T."""
        from scipy import sparse

        return sparse.csr_array(self.geometry.matrix()), self._spread

    @cached_property
    def matrix(self) -> sparse.csr_array:
        """A itself, CSR complex64 (views * bins, points); for checks: far larger than the two stages."""
        from scipy import sparse

        gather, _ = self.stages
        spread = sparse.csr_array(self._spread.T)
        fine = self.geometry.bins
        rows = [spread @ gather[at : at + fine] for at in range(0, gather.shape[0], fine)]
        matrix = sparse.csr_array(sparse.vstack(rows, format="csr"))
        matrix.sort_indices()
        return matrix


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


def _spread(scans: BasebandScans, fine_m: NDArray[np.float64]) -> NDArray[np.complex64]:
    """S^T (fine bins, bins): carrier and response of a point at each fine range, in every bin."""
    step = float(fine_m[1] - fine_m[0])
    carrier = np.exp(-2j * scans.wavenumber * fine_m) * interpolation_gain(2 * scans.wavenumber * step)
    response = scans.response(scans.ranges_m[None, :] - fine_m[:, None])
    return np.asarray(response * carrier[:, None], dtype=np.complex64)
