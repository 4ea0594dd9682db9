"""Scans as spectra over the views: what the signatures of bodies and objects are fitted to.

With free complex amplitudes at every frequency, the pulse, the level and a common range offset need not be
known, and everything that is linear in the amplitudes is solved frequency by frequency.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError
from tagid.imaging.types import BasebandScans

FREQUENCIES = 9
"""One frequency per c / (2 * 0.65 m) = 0.23 GHz of the range window would be independent of its neighbours;
9 over the 1.6 GHz used of a P440's band are 0.2 GHz apart."""
BAND_SHARE = 0.94
"""Share of the pulse's -10 dB band that is used: its outermost edges hold little signal."""
FLAT_M, EDGE_M = 0.24, 0.42
"""The range window about the axis is flat to the first and ends at the second distance: an object of 0.13 m
radius, its creeping waves and double bounces, and a range offset of 0.05 m lie in the flat part."""


@dataclass(frozen=True, eq=False)
class Spectra:
    """Spectra of the moving echo; what is constant over the views (the room) is subtracted.

    A point of reflectivity sigma(f) at distance R_v from the antenna of view v gives
    data[f, v] = sigma(f) (exp(-j kappa_f (R_v - d)) - its mean over v), kappa_f = 4 pi f / c.

    Attributes:
        data: (F, V) complex128.
        wavenumbers: (F,) kappa, rad/m, equally spaced and rising.
        antenna: (V,) complex128 antenna positions x + jy in the object's frame, m.
        height_m: (V,) antenna height above the object's plane, m.
        distance_m: d, to which phases are referred: mean distance from axis to antenna, m.
        noise: variance of one value of `data` from noise alone; 0 where unknown.
    """

    data: NDArray[np.complex128]
    wavenumbers: NDArray[np.float64]
    antenna: NDArray[np.complex128]
    height_m: NDArray[np.float64]
    distance_m: float
    noise: float

    @classmethod
    def of(cls, scans: BasebandScans, wavenumbers: NDArray[np.float64]) -> Spectra:
        """Spectra, at equally spaced kappa (F,), rad/m, of scans made without a matched filter, in a window
        of 0.42 m about the axis. Raises DataError where fewer than 4 range bins lie in it.
        """
        positions, turn = scans.aperture.positions, wavenumbers - 2 * scans.wavenumber
        data, distance, noise = transformed(scans, turn)
        return cls(
            data - data.mean(axis=1, keepdims=True),
            2 * scans.wavenumber + turn,
            positions[:, 0] + 1j * positions[:, 1],
            np.ascontiguousarray(positions[:, 2]),
            distance,
            noise,
        )

    @property
    def energy(self) -> float:
        """Sum of |data|^2."""
        return float((np.abs(self.data) ** 2).sum())

    @property
    def noise_energy(self) -> float:
        """Expected energy of the noise in `data`; one value per frequency is lost with the room."""
        return float(self.noise * len(self.data) * (self.data.shape[1] - 1))

    @property
    def views(self) -> int:
        return int(self.data.shape[1])

    def thinned(self, step: int) -> Spectra:
        """Every `step`-th frequency only, for coarse searches."""
        return replace(self, data=self.data[::step], wavenumbers=self.wavenumbers[::step])

    def waves(self, distance_m: NDArray[np.float64]) -> NDArray[np.complex128]:
        """(F, ...) exp(-j kappa (R - d)) at distances R (...), m, by recurrence over equal steps of kappa."""
        path = distance_m - self.distance_m
        out = np.empty((len(self.wavenumbers), *path.shape), dtype=np.complex128)
        out[0] = np.exp(-1j * self.wavenumbers[0] * path)
        if len(out) > 1:
            step = np.exp(-1j * (self.wavenumbers[1] - self.wavenumbers[0]) * path)
            for f in range(1, len(out)):
                np.multiply(out[f - 1], step, out=out[f])
        return out


def transformed(
    scans: BasebandScans, turn: NDArray[np.float64], gain: float = 1.0
) -> tuple[NDArray[np.complex128], float, float]:
    """Spectra (F, V) in a window about the axis, mean distance from axis to antenna, m, and noise variance.

    The scans are made without a matched filter; `turn` (F,) is kappa over that of the carrier, rad/m, and
    `gain` that by which the density of the noise has changed. Raises DataError where fewer than 4 range bins
    lie in the window.
    """
    reach = np.linalg.norm(scans.aperture.positions, axis=1)
    distance = float(reach.mean())
    ranges = scans.ranges_m[None] - (reach - distance)[:, None]
    taper = np.clip((EDGE_M - np.abs(ranges - distance)) / (EDGE_M - FLAT_M), 0, 1)
    taper = 0.5 - 0.5 * np.cos(np.pi * taper)
    if np.count_nonzero(taper.mean(axis=0)) < 4:
        raise DataError(
            f"the scans cover {scans.ranges_m[0]:.2f} to {scans.ranges_m[-1]:.2f} m, the object is at "
            f"{distance:.2f} m",
            "Check the axis distance, or record a range window that holds the object.",
        )
    data = np.exp(-1j * turn[:, None] * (scans.ranges_m - distance)[None]) @ (scans.samples * taper).T
    density = scans.noise_density * gain
    if not density:
        size = scans.samples.size
        density = scans.noise_std**2 * size / (scans.independent_samples or size)
    noise = density * float((taper**2).sum(axis=1).mean())
    return data * np.exp(2j * scans.wavenumber * distance), distance, noise


def centred(columns: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Columns (..., V) without what is constant over the views, as the data are."""
    # `mean` gives the same sums at several times their cost where the columns are few.
    return np.asarray(columns - np.add.reduce(columns, axis=-1, keepdims=True) / columns.shape[-1])
