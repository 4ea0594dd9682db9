"""The matched field: correlation of the scans with a point anywhere in the object's plane, and of points with
each other. No image grid limits its accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError
from tagid.imaging.types import BasebandScans, PointResponse
from tagid.signal import median

FINE_STEP_M = 5e-4
"""Range step of the tables, read at the nearest entry: baseband varies over c / B = 176 mm, so half a step is
an error of 1 % at most and 0.5 % in the mean."""
RANK_FLOOR = 1e-3
"""Range profiles of all points of an object span few dimensions (2 B L / c is 4 for 0.35 m at 1.7 GHz);
singular values under this part of the largest are left out."""


@dataclass(frozen=True, eq=False)
class RangeProfiles:
    """Range profiles of all points within a radius, in an orthonormal basis; the same for every view.

    Attributes:
        keep: (bins,) which bins of a scan the radius can reach.
        start_m: distance of the first profile, m; the next ones are FINE_STEP_M apart.
        basis: (kept bins, rank) orthonormal.
        profiles: (n, rank) complex64 coordinates of the profiles.
        wavenumber: k of the carrier, rad/m.
    """

    keep: NDArray[np.bool_]
    start_m: float
    basis: NDArray[np.complex128]
    profiles: NDArray[np.complex64]
    wavenumber: float

    @classmethod
    def of(cls, scans: BasebandScans, radius_m: float) -> RangeProfiles:
        """The profiles of points in the object's plane within a radius, m.

        Raises DataError if the scans do not cover the object's range.
        """
        least, greatest = scans.aperture.span(radius_m)
        near, far = float(least.min()), float(greatest.max())
        width = _effective_half_width(scans)
        ranges = scans.ranges_m
        keep = (ranges >= near - width) & (ranges <= far + width)
        if np.count_nonzero(keep) < 4:
            raise DataError(
                f"the scans cover {ranges[0]:.2f} to {ranges[-1]:.2f} m, "
                f"the object is at {near:.2f} to {far:.2f} m",
                "Check the axis distance, or record a range window that holds the object.",
            )
        start = near - 0.05
        fine = np.arange(start, far + 0.05, FINE_STEP_M)
        response, bins = scans.response.samples.tobytes(), ranges[keep].tobytes()
        basis, profiles = _range_basis(response, scans.response.step_m, bins, fine.tobytes())
        return cls(keep, start, basis, profiles, scans.wavenumber)

    def coordinates(self, samples: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """(views, rank) coordinates of scans (views, kept bins)."""
        return np.asarray(samples @ self.basis.conj(), dtype=np.complex64)

    def index(self, distances: NDArray[np.float64]) -> NDArray[np.int32]:
        """Which profile belongs to each distance (...), m."""
        position = distances - (self.start_m - FINE_STEP_M / 2)
        position *= 1 / FINE_STEP_M
        index = position.astype(np.int32)
        np.maximum(index, 0, out=index)
        return np.minimum(index, len(self.profiles) - 1, out=index)

    def phase(self, distances: NDArray[np.float64]) -> NDArray[np.complex64]:
        """exp(-2jk d) in single precision; the angle, hundreds of radians, in double."""
        cycles = distances * (-self.wavenumber / np.pi)
        cycles -= np.floor(cycles)
        cycles *= 2 * np.pi
        angle = cycles.astype(np.float32)
        out = np.empty(angle.shape, dtype=np.complex64)
        np.cos(angle, out=out.real)
        np.sin(angle, out=out.imag)
        return out


class MatchedField:
    """b(p) = <s_p, z> and G(p, q) = <s_p, s_q> for templates s_p[v, b] = g(R_b - d_v(p)) exp(-2jk d_v(p)).

    Given scans without a matched filter the noise is white and b is the maximum-likelihood statistic.
    What is constant over the views is subtracted from the data and from the templates alike: static clutter
    is a free unknown of the fit, which a reflector near the axis loses most of its energy to. Views of
    several antenna heights have one unknown for each height, because the room's echo depends on it.

    Templates are kept in an orthonormal basis of the range profiles that the object can give, found once by a
    singular value decomposition; some eight numbers a view stand for all range bins.

    Args:
        scans: baseband scans (views, bins).
        radius_m: largest distance from the axis that will be asked for, m.

    Attributes:
        antenna: (views, 3) positions, m.
        ranges: the range profiles.
        data: (views * rank,) complex64, the scans in the basis, without what is constant over the views.
        energy: sum |z|^2 of the bins that the radius can reach.
        template_energy: ||s_p||^2 of a point inside, before its constant part is taken out.
        independent_samples: number of independent samples in those bins.
        noise_variance: variance of b(p) / ||s_p|| from noise alone, 0 where unknown.
    """

    def __init__(self, scans: BasebandScans, radius_m: float) -> None:
        self.antenna = scans.aperture.positions
        self._antennas = scans.aperture.antennas
        self._groups = scans.aperture.height_groups()
        self.ranges = RangeProfiles.of(scans, radius_m)
        keep = self.ranges.keep
        z = scans.samples[:, keep]
        z = self.without_static(z) if len(self._groups) > 1 else z - z.mean(axis=0)
        self.energy = float(np.sum(np.abs(z.astype(np.complex128)) ** 2))
        if not self.energy > 0:
            raise DataError("the scans are zero over the whole object", "Check the radar's antenna cables.")
        share = np.count_nonzero(keep) / scans.samples.shape[1]
        self.independent_samples = max(scans.independent_samples * share, 1.0)
        if scans.independent_samples <= 0:
            self.independent_samples = float(z.size)
        self.noise_variance = scans.noise_std**2 * z.size / self.independent_samples
        self.data = self.ranges.coordinates(z).ravel()
        self.template_energy = float(self.views * median(np.sum(np.abs(self.ranges.profiles) ** 2, axis=1)))

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.antenna)

    def distances(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """(..., views) one-way range of points (..., 2) in every view, m."""
        p = np.asarray(points, dtype=np.float64)
        ways = []
        for antenna in self._antennas:
            x, y, z = p[..., 0, None] - antenna[:, 0], p[..., 1, None] - antenna[:, 1], antenna[:, 2]
            ways.append(np.sqrt(x * x + y * y + z * z))
        return np.asarray(ways[0] if len(ways) == 1 else (ways[0] + ways[1]) / 2)

    def templates(self, points: NDArray[np.float64]) -> NDArray[np.complex64]:
        """(..., views * rank) templates of points (..., 2), m."""
        return self.without_static(self._whole(points)).reshape(*points.shape[:-1], self.data.size)

    def without_static(self, rows: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Rows (..., views, n) minus their mean over the views of each antenna height, in place."""
        if len(self._groups) == 1:
            rows -= _mean_over_views(rows)
            return rows
        for views in self._groups:
            some = rows[..., views, :]
            rows[..., views, :] = some - some.mean(axis=-2, keepdims=True)
        return rows

    def _whole(self, points: NDArray[np.float64]) -> NDArray[np.complex64]:
        """(..., views, rank) templates with their constant parts."""
        distances = self.distances(points)
        # The index is within bounds already; "clip" reads without a check and without a buffer.
        whole = self.ranges.profiles.take(self.ranges.index(distances), axis=0, mode="clip")
        whole *= self.ranges.phase(distances)[..., None]
        return whole

    def correlate(self, templates: NDArray[np.complex64]) -> NDArray[np.complex128]:
        """(...) b of templates (..., views * rank): the data against each."""
        # <s, z> = conj(<z, s>): the data is conjugated instead of the far larger templates.
        return np.asarray((templates @ self.data.conj()).conj(), dtype=np.complex128)

    def gram(self, templates: NDArray[np.complex64]) -> NDArray[np.complex128]:
        """(..., K, K) G[k, l] = <s_k, s_l> of groups of K templates (..., K, views * rank)."""
        return np.asarray(np.matmul(templates.conj(), np.swapaxes(templates, -1, -2)), dtype=np.complex128)

    def table(self, data: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """(views, n) inner products of the profiles with data (views * rank,)."""
        return np.ascontiguousarray(data.reshape(self.views, -1) @ self.ranges.profiles.conj().T)


def read(table: NDArray[np.complex64], index: NDArray[np.int32]) -> NDArray[np.complex64]:
    """(N, views) values of a `MatchedField.table` at the profile of every point and view."""
    views, width = table.shape
    return np.asarray(table.ravel().take(index + np.arange(views, dtype=np.intp) * width, mode="clip"))


def _mean_over_views(templates: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """(..., 1, rank) mean of templates (..., views, rank), summed as real numbers, which is faster."""
    total = np.add.reduce(templates.view(np.float32), axis=-2, keepdims=True)
    return (total / np.float32(templates.shape[-2])).view(np.complex64)


@lru_cache(maxsize=2)
def _range_basis(
    response: bytes, step_m: float, ranges: bytes, fine: bytes
) -> tuple[NDArray[np.complex128], NDArray[np.complex64]]:
    """Orthonormal basis (bins, rank) of range profiles, and their coordinates (n, rank).

    From the complex128 samples of a `PointResponse`, step_m apart, the ranges (bins,) of a scan and the
    distances (n,) of the profiles, float64, m. The last ones are kept: captures of one radar at one distance
    have the same.
    """
    given = PointResponse(np.frombuffer(response, dtype=np.complex128), step_m)
    profiles = given(np.frombuffer(ranges)[:, None] - np.frombuffer(fine)[None])
    range_vectors, size, right = np.linalg.svd(profiles, full_matrices=False)
    rank = int(np.count_nonzero(size > RANK_FLOOR * size[0]))
    basis = range_vectors[:, :rank]
    coordinates = np.ascontiguousarray((size[:rank, None] * right[:rank]).T.astype(np.complex64))
    basis.flags.writeable = coordinates.flags.writeable = False
    return basis, coordinates


def _effective_half_width(scans: BasebandScans) -> float:
    """Range offset beyond which the response is under 1 % of its peak, m."""
    samples = scans.response.samples
    large = np.flatnonzero(np.abs(samples) > 0.01 * np.abs(samples).max())
    middle = len(samples) // 2
    return float(max(middle - large[0], large[-1] - middle) * scans.response.step_m)
