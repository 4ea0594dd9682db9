"""A recording as spectra over the views, whitened under noise, model error and clutter.

Amplitudes are free at every frequency, so that pulse, level and a common range offset need not be known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property
from math import sqrt
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError
from tagid.geometry import SAME_HEIGHT_M, views_of_heights
from tagid.imaging.types import BasebandScans
from tagid.imaging.whitening import whitened
from tagid.reading.views import EVEN_RAD, fold_views
from tagid.tags.bodies.spectra import BAND_SHARE, FREQUENCIES, transformed
from tagid.types import Complex, Floats

AnyComplex = TypeVar("AnyComplex", np.complex64, np.complex128)

MODEL_ERROR = 0.05
"""Amplitude of what no hypothesis models, over the amplitude of the echo that changes over the views."""
RADIUS_M = 0.13
"""Of objects, unless a larger one is enrolled."""
CLUTTER_RADII_M = (0.05, 0.10)
"""Radii of the discs over which the scatterers of the clutter are spread."""
UPRIGHT_SD_M = 0.04
"""Standard deviation of the height of the clutter's scatterers, m: from another height their sum differs."""


@dataclass(frozen=True, eq=False)
class Whitener:
    """The clutter's covariance over the views, diagonal in a basis of all echoes, or of all but the room's.

    Scatterers spread evenly over a disc about the axis have the covariance of J0(2 kappa r sin(dphi / 2))
    averaged over the disc. On a full even turn at one height its eigenvectors are the Fourier vectors.

    Attributes:
        variance: (F, M) of the clutter in the basis, mean 1 over the views for unit power.
        basis: (F, M, V) rows of the basis; None: the last M Fourier vectors.
    """

    variance: Floats
    basis: Floats | None

    def thinned(self, step: int) -> Whitener:
        """The same of every so many-th frequency."""
        basis = None if self.basis is None else self.basis[::step]
        return Whitener(self.variance[::step], basis)

    def apply(self, columns: NDArray[AnyComplex]) -> NDArray[AnyComplex]:
        """(F, n, M) of columns (F, n, V), in their precision."""
        if self.basis is None:
            views = columns.shape[-1]
            kept = slice(views - self.variance.shape[1], None)
            turned = np.fft.fft(columns, axis=-1)[..., kept] / sqrt(views)
            return np.asarray(turned, dtype=columns.dtype)
        real = self.basis if columns.dtype == np.complex128 else self._single
        # Real times real: half of what complex numbers would cost.
        parts = np.concatenate([columns.real, columns.imag], axis=1) @ np.swapaxes(real, 1, 2)
        out = np.empty((*columns.shape[:2], real.shape[1]), dtype=columns.dtype)
        out.real, out.imag = parts[:, : columns.shape[1]], parts[:, columns.shape[1] :]
        return out

    @cached_property
    def _single(self) -> NDArray[np.float32]:
        assert self.basis is not None
        return self.basis.astype(np.float32)

    def adjoint(self, columns: Complex) -> Complex:
        """(F, n, V) of columns (F, n, M): the Hermitian transpose of `apply`."""
        if self.basis is None:
            views = columns.shape[-1] + 1
            full = np.zeros((*columns.shape[:-1], views), dtype=np.complex128)
            full[..., 1:] = columns
            return np.asarray(np.fft.ifft(full, axis=-1) * np.sqrt(views))
        return np.asarray(columns @ self.basis)


@dataclass(frozen=True, eq=False)
class Spectra:
    """Spectra of the moving echo, in units of noise and model error.

    A point of reflectivity sigma(f) at distance R_v from the antenna of view v gives
    data[f, v] = sigma(f) exp(-j kappa_f (R_v - d)), kappa_f = 4 pi f / c; what is constant over the views of
    one antenna height is the room's.

    Attributes:
        data: (F, V), of variance 1 from noise and model error.
        kappa: (F,) rad/m.
        antenna: (V,) x + jy in the object's frame, m.
        height_m: (V,) of the antenna above the object's plane, m.
        distance_m: d, mean distance from the axis to the antenna, m.
        moving: (F,) energy of the moving echo per view, in the same units.
        full_turn: the views are evenly spaced over a turn at one height, and that it is one turn is known.
        scale_sigma: relative standard deviation of a factor common to all angles; None: not stated.
        stated: the recording with its angles as stated, where they were found to be wrong, or about its axis,
            where the object stands elsewhere.
    """

    data: Complex
    kappa: Floats
    antenna: Complex
    height_m: Floats
    distance_m: float
    moving: Floats
    full_turn: bool
    scale_sigma: float | None = None
    stated: Spectra | None = None

    @classmethod
    def of(
        cls,
        scans: BasebandScans,
        radius_m: float = RADIUS_M,
        kappa: Floats | None = None,
    ) -> Spectra:
        """Spectra of scans made without a matched filter.

        Args:
            scans: (views, bins); many views of a turn are folded to what the radius needs.
            radius_m: of the object, m.
            kappa: (F,) to take, equally spaced, rad/m; those of enrolled signatures.

        Raises:
            DataError: fewer than 4 range bins lie in the window about the axis.
        """
        scans = whitened(scans)
        before = scans.noise_std
        scans = fold_views(scans, radius_m)
        gain = (scans.noise_std / before) ** 2 if before > 0 else 1.0
        positions = scans.aperture.positions
        offsets = np.linspace(-0.5, 0.5, FREQUENCIES) * BAND_SHARE * scans.bandwidth_hz
        turn = 4 * np.pi / scans.wave_speed_m_s * offsets if kappa is None else kappa - 2 * scans.wavenumber
        data, distance, noise = transformed(scans, turn, gain)
        height = np.ascontiguousarray(positions[:, 2])
        rooms = _rooms(height)
        data = data - (data @ rooms.T) @ rooms
        moving = np.maximum((np.abs(data) ** 2).mean(axis=1) - noise, 0.02 * noise)
        if noise + moving.sum() <= 0:
            raise DataError("nothing changes over the views", "Check that the object turned.")
        unit = noise + MODEL_ERROR**2 * moving
        antenna = positions[:, 0] + 1j * positions[:, 1]
        return cls(
            data / np.sqrt(unit)[:, None],
            2 * scans.wavenumber + turn,
            antenna,
            height,
            distance,
            moving / unit,
            not scans.angle_scale_sigma and _is_full_turn(antenna, height),
            scans.angle_scale_sigma,
        )

    @property
    def views(self) -> int:
        return int(self.data.shape[1])

    @property
    def levels(self) -> int:
        """Number of heights, two or more where heights of reflectors show."""
        return max(len(self.rooms), 1 + int(np.ptp(self.height_m) > SAME_HEIGHT_M))

    def rises(self, most_m: float) -> Floats:
        """Heights up to so much above and below that change the echo by 1 rad from one to the next, m.

        That is the root mean square over the views, after a common phase.
        """
        slope = float(self.kappa.mean() * np.std(self.height_m) / self.distance_m)
        count = min(round(most_m * slope), 6)
        return np.arange(-count, count + 1) / max(slope, 1e-9)

    @cached_property
    def direction(self) -> Floats:
        """(V,) of the antenna from the axis, rad."""
        return np.asarray(np.angle(self.antenna))

    @cached_property
    def rooms(self) -> Floats:
        """(H, V) what the room may add: one constant per antenna height, orthonormal."""
        return _rooms(self.height_m)

    @cached_property
    def whiteners(self) -> tuple[Whitener, ...]:
        """One for each of `CLUTTER_RADII_M`, free of the room."""
        if self.stated is not None:
            return self.stated.whiteners
        if self.full_turn:
            return tuple(Whitener(whitener.variance[:, 1:], None) for whitener in self.whole)
        free = np.linalg.svd(self.rooms)[2][len(self.rooms) :]
        return tuple(_diagonal(covariance, free) for covariance in self._covariances)

    @cached_property
    def whole(self) -> tuple[Whitener, ...]:
        """The same of all echoes."""
        if self.stated is not None:
            return self.stated.whole
        if not self.full_turn:
            return tuple(_diagonal(covariance, np.eye(self.views)) for covariance in self._covariances)
        apart, whiteners = 2 * np.abs(np.sin((self.direction[0] - self.direction) / 2)), []
        for radius in CLUTTER_RADII_M:
            row = _disc(self.kappa[:, None] * radius * apart)
            whiteners.append(Whitener(np.maximum(np.fft.fft(row, axis=1).real, 0), None))
        return tuple(whiteners)

    @cached_property
    def _covariances(self) -> tuple[Floats, ...]:
        """(F, V, V) of the clutter of every disc, of unit power."""
        apart = 2 * np.abs(np.sin((self.direction[:, None] - self.direction) / 2))
        risen = np.subtract.outer(self.height_m, self.height_m) / self.distance_m
        upright = np.exp(-0.5 * (self.kappa[:, None, None] * UPRIGHT_SD_M * risen) ** 2)
        return tuple(
            _disc(self.kappa[:, None, None] * radius * apart) * upright for radius in CLUTTER_RADII_M
        )

    @cached_property
    def white(self) -> tuple[Complex, ...]:
        """The data (F, M) in the basis of every whitener."""
        return tuple(whitener.apply(self.data[:, None])[:, 0] for whitener in self.whiteners)

    def thinned(self, step: int) -> Spectra:
        """The same of every so many-th frequency."""
        every = slice(None, None, step)
        kappa = np.ascontiguousarray(self.kappa[every])
        stated = None if self.stated is None else self.stated.thinned(step)
        return replace(self, data=self.data[every], kappa=kappa, moving=self.moving[every], stated=stated)

    def turned(self, error: Floats) -> Spectra:
        """The same with the antenna turned by errors (V,) of the angles, rad."""
        return replace(self, antenna=self.antenna * np.exp(1j * error), stated=self)

    def about(self, place: complex) -> Spectra:
        """The same with a place, x + jy, m, as the origin; the clutter's disc stays about the axis."""
        return replace(self, antenna=self.antenna - place, stated=self, full_turn=False)

    def waves(self, positions: Complex, heights: Floats) -> tuple[Complex, Floats]:
        """Echoes (F, S, V) of unit points at places x + jy (S,) and heights (S,), m; their ranges (S, V)."""
        range_m = np.hypot(np.abs(self.antenna - positions[:, None]), self.height_m - heights[:, None])
        path = range_m - self.distance_m
        step = np.exp(-1j * (self.kappa[1] - self.kappa[0]) * path)
        out = np.empty((len(self.kappa), *path.shape), dtype=np.complex128)
        out[0] = np.exp(-1j * self.kappa[0] * path) * (self.distance_m / range_m) ** 2
        for f in range(1, len(out)):
            np.multiply(out[f - 1], step, out=out[f])
        return out, range_m


def _diagonal(covariance: Floats, rows: Floats) -> Whitener:
    """A covariance (F, V, V) in the span of orthonormal rows (M, V), in the basis of its eigenvectors."""
    values, vectors = np.linalg.eigh(rows @ covariance @ rows.T)
    return Whitener(np.maximum(values, 0), np.swapaxes(vectors, 1, 2) @ rows)


def _rooms(height_m: Floats) -> Floats:
    """(H, V) orthonormal: one constant per antenna height."""
    groups = views_of_heights(height_m)
    rooms = np.zeros((len(groups), len(height_m)))
    for row, views in zip(rooms, groups, strict=True):
        row[views] = 1 / sqrt(len(views))
    return rooms


def _is_full_turn(antenna: Complex, height_m: Floats) -> bool:
    if np.ptp(height_m) > SAME_HEIGHT_M or np.ptp(np.abs(antenna)) > 1e-4:
        return False
    steps = np.angle(np.roll(antenna, -1) / antenna)
    return bool(np.ptp(steps) < EVEN_RAD and abs(abs(steps.sum()) - 2 * np.pi) < 1e-6)


def _disc(x: Floats) -> Floats:
    """J0 averaged over a disc (24 rings of equal area) at whose rim its argument is x >= 0, from a table."""
    return np.interp(x, *_disc_table())


@cache
def _disc_table() -> tuple[Floats, Floats]:
    grid = np.linspace(0, 100, 10_001)
    angle = (np.arange(128) + 0.5) * np.pi / 128
    j0 = np.cos(np.outer(grid, np.sin(angle))).mean(axis=1)
    rings = np.sqrt((np.arange(24) + 0.5) / 24)
    return grid, np.interp(np.outer(rings, grid), grid, j0).mean(axis=0)
