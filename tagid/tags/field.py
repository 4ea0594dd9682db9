"""The matched field: correlation of the scans with a point anywhere in the object's plane, and of points with
each other. Every statement about reflectors is made from these two, so no image grid limits its accuracy.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError
from tagid.imaging.types import BasebandScans

FINE_STEP_M = 4e-3
"""Range step of the tables; baseband varies over c / B = 176 mm, so linear interpolation errs by < 0.5 %."""
_BLOCK = 1 << 18


def _interpolate(table: NDArray[np.complex64], position: NDArray[np.float32]) -> NDArray[np.complex64]:
    """Linear interpolation of table (views, n) at fractional indexes (views, m), held beyond the ends."""
    n = table.shape[1]
    position = np.clip(position, 0, n - 1)
    index = np.minimum(position.astype(np.int32), n - 2)
    position -= index
    index += np.arange(len(table), dtype=np.int32)[:, None] * n
    flat = table.ravel()
    value = flat[index]
    index += 1
    above = flat[index]
    above -= value
    above *= position
    value += above
    return np.asarray(value, dtype=np.complex64)


class MatchedField:
    """b(p) = <s_p, z> and G(p, q) = <s_p, s_q> for templates s_p[v, b] = g(R_b - d_v(p)) exp(-2jk d_v(p)).

    Given scans without a matched filter the noise is white and b is the maximum-likelihood statistic.
    What is constant over the views is taken from the data and from the templates alike: static clutter is a
    free unknown of the fit: a reflector near the axis loses most of its energy to it, and the fit knows.

    Args:
        scans: baseband scans (views, bins).
        radius_m: largest distance from the axis that will be asked for, m.

    Attributes:
        energy: sum |z|^2 of the bins that the radius can reach.
        template_energy: ||s_p||^2 of a point inside.
        independent_samples: n of the criterion, of those bins.
        noise_variance: variance of b(p) / ||s_p|| from noise alone, 0 where unknown.
    """

    def __init__(self, scans: BasebandScans, radius_m: float) -> None:
        self.antenna = scans.aperture.positions
        self.wavenumber = scans.wavenumber
        self.radius_m = radius_m
        reach = np.linalg.norm(self.antenna[:, :2], axis=1)
        height = self.antenna[:, 2]
        near = float(np.hypot(np.maximum(reach - radius_m, 0), height).min())
        far = float(np.hypot(reach + radius_m, height).max())
        width = _effective_half_width(scans)
        ranges = scans.ranges_m
        keep = (ranges >= near - width) & (ranges <= far + width)
        if np.count_nonzero(keep) < 4:
            raise DataError(
                f"the scans cover {ranges[0]:.2f} to {ranges[-1]:.2f} m, "
                f"the object is at {near:.2f} to {far:.2f} m",
                "Check the axis distance, or record a range window that holds the object.",
            )
        z = scans.samples[:, keep]
        z = z - z.mean(axis=0)
        self.energy = float(np.sum(np.abs(z.astype(np.complex128)) ** 2))
        if not self.energy > 0:
            raise DataError("the scans are zero over the whole object", "Check the radar's antenna cables.")
        share = np.count_nonzero(keep) / scans.samples.shape[1]
        self.independent_samples = max(scans.independent_samples * share, 1.0)
        if scans.independent_samples <= 0:
            self.independent_samples = float(z.size)
        self.noise_variance = scans.noise_std**2 * z.size / self.independent_samples
        self._start = near - 0.05
        fine = np.arange(self._start, far + 0.05, FINE_STEP_M)
        self._ranges = ranges[keep]
        self._response = scans.response(np.arange(-_half(width), _half(width) + 1) * FINE_STEP_M).astype(
            np.complex64
        )
        self._response[[0, -1]] = 0
        self._table = (z @ scans.response(ranges[keep][:, None] - fine[None]).conj()).astype(np.complex64)
        self._overlap = _overlap(scans, 2 * radius_m + 0.1)
        self.template_energy = float(self.views * self._overlap[len(self._overlap) // 2].real)

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.antenna)

    def distances(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """(views, ...) distance of points (..., 2) in the plane z = 0 from every antenna position, m."""
        flat = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        x = flat[:, 0] - self.antenna[:, :1]
        y = flat[:, 1] - self.antenna[:, 1:2]
        d = np.sqrt(x * x + y * y + self.antenna[:, 2:] ** 2)
        return np.asarray(d.reshape(self.views, *np.shape(points)[:-1]))

    def correlate(self, distances: NDArray[np.float64]) -> NDArray[np.complex128]:
        """(...) b for points given by their distances (views, ...), m: the data against each template."""
        return np.asarray(self.correlate_offsets(distances, (0.0,))[0])

    def correlate_offsets(
        self, distances: NDArray[np.float64], offsets_m: Sequence[float]
    ) -> NDArray[np.complex128]:
        """(offsets, ...) b for points whose distances (views, ...) are all longer by each offset, m.

        The phase of an offset is common to all views, so the costly exponential is formed once.
        """
        shape = distances.shape[1:]
        flat = distances.reshape(self.views, -1)
        out = np.empty((len(offsets_m), flat.shape[1]), dtype=np.complex128)
        size = max(1, _BLOCK // self.views)
        for start in range(0, flat.shape[1], size):
            d = flat[:, start : start + size]
            turn = self._turn(d)
            position = ((d - self._start) / FINE_STEP_M).astype(np.float32)
            for i, offset in enumerate(offsets_m):
                value = _interpolate(self._table, position + np.float32(offset / FINE_STEP_M))
                out[i, start : start + size] = np.einsum("vp,vp->p", value, turn)
        out *= np.exp(2j * self.wavenumber * np.asarray(offsets_m))[:, None]
        return out.reshape(len(offsets_m), *shape)

    def at(self, points: NDArray[np.floating]) -> NDArray[np.complex128]:
        """(...) b at points (..., 2), m."""
        return self.correlate(self.distances(points))

    def gram(self, distances: NDArray[np.float64]) -> NDArray[np.complex128]:
        """(..., K, K) G[k, l] = <s_k, s_l> for groups of K points given by distances (views, ..., K), m."""
        static = self.static_part(distances)
        lost = np.matmul(static.conj(), np.swapaxes(static, -1, -2)) * self.views
        return np.asarray(self.full_gram(distances) - lost)

    def cross(self, d_p: NDArray[np.float64], d_q: NDArray[np.float64]) -> NDArray[np.complex128]:
        """(P,) <s_p, s_q> of points p given by distances (views, P) with one point q (views, 1), m."""
        lost = self.static_part(d_p).conj() @ self.static_part(d_q)[0] * self.views
        return np.asarray(self._overlap_sum(d_p - d_q) - lost)

    def full_gram(self, distances: NDArray[np.float64]) -> NDArray[np.complex128]:
        """`gram` before the part that is constant over the views is taken out."""
        return self._overlap_sum(distances[..., :, None] - distances[..., None, :])

    def static_part(self, distances: NDArray[np.float64]) -> NDArray[np.complex64]:
        """(..., bins) mean template over the views, for points given by distances (views, ...), m."""
        shape = distances.shape[1:]
        flat = distances.reshape(self.views, -1)
        out = np.empty((flat.shape[1], len(self._ranges)), dtype=np.complex64)
        size = max(1, _BLOCK // (self.views * len(self._ranges)))
        middle = len(self._response) // 2
        for start in range(0, flat.shape[1], size):
            d = flat[:, start : start + size]
            position = ((self._ranges - d[..., None]) / FINE_STEP_M + middle).astype(np.float32)
            value = _interpolate(self._response[None], position.reshape(1, -1)).reshape(position.shape)
            out[start : start + size] = np.einsum("vpb,vp->pb", value, self._turn(d).conj()) / self.views
        return out.reshape(*shape, len(self._ranges))

    def _overlap_sum(self, gap: NDArray[np.float64]) -> NDArray[np.complex128]:
        """(...) overlap of two points whose distances differ by gap (views, ...), summed over views."""
        shape = gap.shape[1:]
        flat = gap.reshape(self.views, -1)
        out = np.empty(flat.shape[1], dtype=np.complex128)
        size = max(1, _BLOCK // self.views)
        table = self._overlap[None, :]
        for start in range(0, flat.shape[1], size):
            part = flat[:, start : start + size]
            position = (part / FINE_STEP_M + len(self._overlap) // 2).astype(np.float32)
            value = _interpolate(table, position.reshape(1, -1)).reshape(part.shape) * self._turn(part)
            out[start : start + size] = value.sum(axis=0)
        return out.reshape(shape)

    def _turn(self, distances: NDArray[np.float64]) -> NDArray[np.complex64]:
        """exp(2jk d) in single precision; the angle is formed in double, it counts hundreds of radians."""
        angle = np.remainder(2 * self.wavenumber * distances, 2 * np.pi).astype(np.float32)
        out = np.empty(angle.shape, dtype=np.complex64)
        np.cos(angle, out=out.real)
        np.sin(angle, out=out.imag)
        return out


def _half(width_m: float) -> int:
    return int(np.ceil(width_m / FINE_STEP_M)) + 1


def _effective_half_width(scans: BasebandScans) -> float:
    """Range offset beyond which the response is under 1 % of its peak, m."""
    samples = scans.response.samples
    large = np.flatnonzero(np.abs(samples) > 0.01 * np.abs(samples).max())
    middle = len(samples) // 2
    return float(max(middle - large[0], large[-1] - middle) * scans.response.step_m)


def _overlap(scans: BasebandScans, reach_m: float) -> NDArray[np.complex64]:
    """Range overlap of two unit points as a function of d_p - d_q, steps of FINE_STEP_M, middle is zero.

    <g(R - d_p), g(R - d_q)> = sum_R conj(g(R)) g(R + d_p - d_q) over range bins R.
    """
    half = int(np.ceil(reach_m / FINE_STEP_M))
    gap = np.arange(-half, half + 1) * FINE_STEP_M
    bins = int(np.ceil(scans.response.half_width_m / scans.range_step_m)) + 1
    grid = np.arange(-bins, bins + 1) * scans.range_step_m
    own: NDArray[np.complex128] = scans.response(grid).conj()
    shifted = scans.response(grid[:, None] + gap[None])
    overlap = np.asarray(own @ shifted, dtype=np.complex64)
    overlap[[0, -1]] = 0
    return overlap
