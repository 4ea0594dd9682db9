"""The matched field: correlation of the scans with a point anywhere in the object's plane, and of points with
each other. Every statement about reflectors is made from these two, so no image grid limits its accuracy.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError
from tagid.imaging.types import BasebandScans, PointResponse
from tagid.signal import median
from tagid.tags.reading.compiled import FieldTables, Looked

FINE_STEP_M = 5e-4
"""Range step of the tables, read at the nearest entry: baseband varies over c / B = 176 mm, so half a step is
an error of 1 % at most and 0.5 % in the mean."""
RANK_FLOOR = 1e-3
"""Range profiles of all points of an object span few dimensions (2 B L / c is 4 for 0.35 m at 1.7 GHz);
singular values under this part of the largest are left out."""
MAX_HEIGHT_SCALE = 10.0
_BLOCK = 1 << 18


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
    def of(
        cls, scans: BasebandScans, radius_m: float, heights_m: tuple[float, float] = (0.0, 0.0)
    ) -> RangeProfiles:
        """The profiles of points within a radius and between two heights, m.

        Raises DataError if the scans do not cover the object's range.
        """
        least, greatest = scans.aperture.span(radius_m, heights_m)
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

    def phase(
        self, distances: NDArray[np.float64], weight: NDArray[np.float32] | None = None
    ) -> NDArray[np.complex64]:
        """Weight times exp(-2jk d) in single precision; the angle, hundreds of radians, in double."""
        cycles = distances * (-self.wavenumber / np.pi)
        cycles -= np.floor(cycles)
        cycles *= 2 * np.pi
        angle = cycles.astype(np.float32)
        out = np.empty(angle.shape, dtype=np.complex64)
        np.cos(angle, out=out.real)
        np.sin(angle, out=out.imag)
        if weight is not None:
            out *= weight
        return out


@dataclass(frozen=True, eq=False)
class CoarseParts:
    """Many points, for a coarse image.

    Attributes:
        static: (points, rank) mean over the views of the whole template, which `templates` subtracts. With
            several antenna heights (points, heights * rank): the mean over the views of each height times the
            square root of its share of the views, so that the inner product of two rows times the number of
            views is what `templates` subtracts from their Gram matrix.
        images: (offsets, points) b.
    """

    static: NDArray[np.complex64]
    images: NDArray[np.complex128]


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
        heights_m: lowest and highest point that will be asked for, m.

    Attributes:
        several_heights: whether the antenna stood at several heights, so that heights of points show.
        height_scale: height difference that changes the echoes as much as 1 m in the plane, 1 to
            MAX_HEIGHT_SCALE. A displacement s in the plane changes the range by s / sqrt(2) in the mean over
            a turn (RMS), a height difference s by s std(h) / D over antenna heights h at the distance D; what
            is constant over all views is lost in the phase of the echo.
        data: (views * rank,) complex64, the scans in the basis, without what is constant over the views.
        energy: sum |z|^2 of the bins that the radius can reach.
        template_energy: ||s_p||^2 of a point inside, before its constant part is taken out.
        independent_samples: n of the criterion, of those bins.
        noise_variance: variance of b(p) / ||s_p|| from noise alone, 0 where unknown.
        tables: the same for the compiled loops; None where they were not compiled.
    """

    def __init__(
        self, scans: BasebandScans, radius_m: float, heights_m: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        self.antenna = scans.aperture.positions
        self._antennas = scans.aperture.antennas
        self.wavenumber = scans.wavenumber
        self.radius_m = radius_m
        range_profiles = RangeProfiles.of(scans, radius_m, heights_m)
        self._groups = scans.aperture.height_groups()
        self.several_heights = len(self._groups) > 1
        heights, away = self.antenna[:, 2], np.hypot(self.antenna[:, 0], self.antenna[:, 1])
        lever = float(np.sqrt(2) * heights.std() / max(away.mean(), 1e-9))
        self.height_scale = float(np.clip(1 / max(lever, 1e-9), 1.0, MAX_HEIGHT_SCALE))
        keep = range_profiles.keep
        z = scans.samples[:, keep]
        z = self.without_static(z) if self.several_heights else z - z.mean(axis=0)
        self.energy = float(np.sum(np.abs(z.astype(np.complex128)) ** 2))
        if not self.energy > 0:
            raise DataError("the scans are zero over the whole object", "Check the radar's antenna cables.")
        share = np.count_nonzero(keep) / scans.samples.shape[1]
        self.independent_samples = max(scans.independent_samples * share, 1.0)
        if scans.independent_samples <= 0:
            self.independent_samples = float(z.size)
        self.noise_variance = scans.noise_std**2 * z.size / self.independent_samples
        self._range = range_profiles
        coordinates = range_profiles.coordinates(z)
        self.data = coordinates.ravel()
        self._profiles = range_profiles.profiles
        self._table = np.ascontiguousarray(coordinates @ self._profiles.conj().T)
        self.template_energy = float(self.views * median(np.sum(np.abs(self._profiles) ** 2, axis=1)))
        axis = range_profiles.start_m, FINE_STEP_M, self.wavenumber
        self.tables = FieldTables.of(
            self._antennas, self._groups, self._profiles, axis, coordinates, self._table
        )

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.antenna)

    def distances(
        self, points: NDArray[np.floating], heights: NDArray[np.floating] | float = 0.0
    ) -> NDArray[np.float64]:
        """(..., views) one-way range of points (..., 2) at heights (...) in every view, m."""
        p = np.asarray(points, dtype=np.float64)
        up = np.asarray(heights, dtype=np.float64)[..., None]
        ways = []
        for antenna in self._antennas:
            x, y, z = p[..., 0, None] - antenna[:, 0], p[..., 1, None] - antenna[:, 1], up - antenna[:, 2]
            ways.append(np.sqrt(x * x + y * y + z * z))
        return np.asarray(ways[0] if len(ways) == 1 else (ways[0] + ways[1]) / 2)

    def templates(
        self, distances: NDArray[np.float64], weight: NDArray[np.float32] | None = None
    ) -> NDArray[np.complex64]:
        """(..., views * rank) templates of points given by their distances (..., views), m.

        The weight (..., views) is their amplitude in each view, 1 unless given.
        """
        whole = self._whole(distances, weight)
        whole = self.without_static(whole)
        return whole.reshape(*distances.shape[:-1], self.data.size)

    def without_static(self, rows: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Rows (..., views, n) minus their mean over the views of each antenna height, in place."""
        if not self.several_heights:
            rows -= _mean_over_views(rows)
            return rows
        for views in self._groups:
            some = rows[..., views, :]
            rows[..., views, :] = some - some.mean(axis=-2, keepdims=True)
        return rows

    def _whole(
        self, distances: NDArray[np.float64], weight: NDArray[np.float32] | None
    ) -> NDArray[np.complex64]:
        """(..., views, rank) templates with their constant parts."""
        # The index is within bounds already; "clip" reads without a check and without a buffer.
        whole = self._profiles.take(self._range.index(distances), axis=0, mode="clip")
        whole *= self._range.phase(distances, weight)[..., None]
        return whole

    def correlate(self, templates: NDArray[np.complex64]) -> NDArray[np.complex128]:
        """(...) b of templates (..., views * rank): the data against each."""
        # <s, z> = conj(<z, s>): the data is conjugated instead of the far larger templates.
        return np.asarray((templates @ self.data.conj()).conj(), dtype=np.complex128)

    def gram(self, templates: NDArray[np.complex64]) -> NDArray[np.complex128]:
        """(..., K, K) G[k, l] = <s_k, s_l> of groups of K templates (..., K, views * rank)."""
        return np.asarray(np.matmul(templates.conj(), np.swapaxes(templates, -1, -2)), dtype=np.complex128)

    def samples_without(
        self, samples: NDArray[np.complex64], template: NDArray[np.complex64]
    ) -> NDArray[np.complex64]:
        """Scans (views, bins) minus a template (views * rank,), which is subtracted where it reaches."""
        left = samples.copy()
        rows = template.reshape(self.views, -1) @ self._range.basis.T
        left[:, self._range.keep] -= rows.astype(np.complex64)
        return left

    def full_gram(
        self, distances: NDArray[np.float64], weight: NDArray[np.float32] | None = None
    ) -> NDArray[np.complex128]:
        """(..., K, K) `gram` of points (..., K, views) before their constant parts are taken out."""
        whole = self._whole(distances, weight)
        return self.gram(whole.reshape(*distances.shape[:-1], self.data.size))

    def coarse_parts(
        self,
        distances: NDArray[np.float64],
        weights: Sequence[NDArray[np.float32] | None],
        offsets_m: Sequence[float],
    ) -> list[CoarseParts]:
        """What a coarse image is made of, for the same points with each of several weights.

        For many points: no template is formed, and the phase of an offset is common to all views.

        Args:
            distances: (N, views) of the points, m.
            weights: (N, views) amplitudes in each view, or None for 1.
            offsets_m: the distances are longer by each of them.
        """
        rank, count = self._profiles.shape[1] * len(self._groups), len(distances)
        found = [
            CoarseParts(
                np.empty((count, rank), dtype=np.complex64),
                np.empty((len(offsets_m), count), dtype=np.complex128),
            )
            for _ in weights
        ]
        size = max(1, _BLOCK // (4 * self.views))
        for at in range(0, count, size):
            here = slice(at, at + size)
            d = distances[here]
            turn = self._range.phase(d)
            turns = [turn if weight is None else turn * weight[here] for weight in weights]
            profiles = self._profiles.take(self._range.index(d), axis=0, mode="clip")
            for parts, each in zip(found, turns, strict=True):
                parts.static[here] = self._static(each, profiles)
            for i, offset in enumerate(offsets_m):
                seen = _read(self._table, self._range.index(d + offset))
                for parts, each in zip(found, turns, strict=True):
                    parts.images[i, here] = np.vecdot(each, seen)
        turned = np.exp(2j * self.wavenumber * np.asarray(offsets_m))[:, None]
        for parts in found:
            parts.static[:] /= self.views
            parts.images[:] *= turned
        return found

    def _static(self, turns: NDArray[np.complex64], profiles: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """`CoarseParts.static` times the number of views, of turns (n, views), profiles (n, views, rank)."""
        if not self.several_heights:
            return np.asarray(np.matmul(turns[:, None], profiles)[:, 0])
        parts = [
            np.matmul(turns[:, None, views], profiles[:, views])[:, 0] * np.sqrt(self.views / len(views))
            for views in self._groups
        ]
        return np.concatenate(parts, axis=1).astype(np.complex64)

    def fixed(self, distances: NDArray[np.float64], weight: NDArray[np.float32] | None = None) -> FixedPoints:
        """Points (N, views) whose templates are needed again and again, without the memory of all of them."""
        return FixedPoints.of(self, self._range.index(distances), self._range.phase(distances, weight))

    def at(self, points: NDArray[np.floating]) -> NDArray[np.complex128]:
        """(...) b at points (..., 2) in the plane, m."""
        distances = self.distances(points)
        fixed = self.fixed(distances.reshape(-1, self.views))
        return fixed.correlate(self.data).reshape(distances.shape[:-1])


class FixedPoints:
    """Templates of many points (see `MatchedField`), kept as the range profile and the phase in every view.

    That is an eighth of the templates' memory, and a correlation reads a table instead of all of them.

    Args:
        field: the matched field.
        looked: the points in every view.

    Attributes:
        looked: see above.
    """

    def __init__(self, field: MatchedField, looked: Looked) -> None:
        self.looked = looked
        self._field = field

    @classmethod
    def of(cls, field: MatchedField, index: NDArray[np.int32], turn: NDArray[np.complex64]) -> FixedPoints:
        """Points with the range profile, and phase times amplitude, of every point and view (N, views)."""
        return cls(
            field,
            Looked(
                np.ascontiguousarray(index.T),
                np.ascontiguousarray(np.stack([turn.T.real, turn.T.imag], axis=1)),
            ),
        )

    @cached_property
    def _index(self) -> NDArray[np.int32]:
        return np.ascontiguousarray(self.looked.index.T)

    @cached_property
    def _turn(self) -> NDArray[np.complex64]:
        turn = self.looked.turn
        return np.ascontiguousarray((turn[:, 0] + 1j * turn[:, 1]).T)

    def correlate(self, data: NDArray[np.complex64]) -> NDArray[np.complex128]:
        """(N,) <s_p, data> of data (views * rank,)."""
        if self._field.tables is not None:
            return self._field.tables.correlated(data, self.looked)
        # Without what is constant over the views: then the templates' constant parts need not be formed.
        rows = data.reshape(self._field.views, -1)
        if self._field.several_heights:
            rows = self._field.without_static(rows.copy())
        else:
            rows = rows - rows.mean(axis=0)
        table = np.ascontiguousarray(rows @ self._field._profiles.conj().T)
        out = np.empty(len(self._index), dtype=np.complex128)
        size = max(1, _BLOCK // self._field.views)
        for at in range(0, len(out), size):
            here = slice(at, at + size)
            out[here] = np.vecdot(self._turn[here], _read(table, self._index[here]))
        return out

    def beyond(self, others: NDArray[np.complex64], inverse: NDArray[np.complex128]) -> NDArray[np.float64]:
        """(N,) energy of each template that others (P, views * rank) do not explain.

        That is ||s_p||^2 - s^T inverse s*, with s (P,) = <s_p, other> and the inverse (P, P) of the others'
        Gram matrix.
        """
        if self._field.tables is not None:
            return self._field.tables.beyond(self.looked, others, inverse)
        left = []
        for part in self.templates():
            shared = (part @ others.conj().T).conj().astype(np.complex128)
            plain = part.view(np.float32)
            own = np.einsum("np,np->n", plain, plain).astype(np.float64)
            left.append(own - np.real(np.sum((shared @ inverse) * shared.conj(), axis=1)))
        return np.concatenate(left)

    def templates(self) -> Iterator[NDArray[np.complex64]]:
        """(n, views * rank) templates of a part of the points after another."""
        profiles = self._field._profiles
        size = max(1, _BLOCK // self._field.data.size)
        for at in range(0, len(self._index), size):
            whole = profiles.take(self._index[at : at + size], axis=0, mode="clip")
            whole *= self._turn[at : at + size, :, None]
            yield self._field.without_static(whole).reshape(len(whole), -1)


def _read(table: NDArray[np.complex64], index: NDArray[np.int32]) -> NDArray[np.complex64]:
    """(N, views) values of a table (views, profiles) at the profile of every point and view."""
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

    The last ones are kept: captures of one radar at one distance have the same.

    Args:
        response: samples of a `PointResponse`, complex128.
        step_m: between them, m.
        ranges: (bins,) of a scan, float64, m.
        fine: (n,) distances of the profiles, float64, m.
    """
    given = PointResponse(np.frombuffer(response, dtype=np.complex128), step_m)
    profiles = given(np.frombuffer(ranges)[:, None] - np.frombuffer(fine)[None])
    left, size, right = np.linalg.svd(profiles, full_matrices=False)
    rank = int(np.count_nonzero(size > RANK_FLOOR * size[0]))
    basis = left[:, :rank]
    coordinates = np.ascontiguousarray((size[:rank, None] * right[:rank]).T.astype(np.complex64))
    basis.flags.writeable = coordinates.flags.writeable = False
    return basis, coordinates


def _effective_half_width(scans: BasebandScans) -> float:
    """Range offset beyond which the response is under 1 % of its peak, m."""
    samples = scans.response.samples
    large = np.flatnonzero(np.abs(samples) > 0.01 * np.abs(samples).max())
    middle = len(samples) // 2
    return float(max(middle - large[0], large[-1] - middle) * scans.response.step_m)
