"""The two values that imaging passes on: preprocessed scans, and a complex image.

Every method takes the first and gives the second, so that methods are exchanged and compared on equal data.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.constants import SPEED_OF_LIGHT
from tagid.geometry import Aperture, ImageGrid


@dataclass(frozen=True, eq=False)
class PointResponse:
    """Range response of a unit point at baseband: the g of y(R) = sigma g(R - d) exp(-2jkd).

    Attributes:
        samples: (n,) complex128, peak magnitude 1 at the middle sample n // 2, which is offset zero.
        step_m: one-way range between samples, m (finer than the data's).
    """

    samples: NDArray[np.complex128]
    step_m: float

    @property
    def half_width_m(self) -> float:
        """Largest offset covered on both sides, m."""
        return (len(self.samples) // 2 - 1) * self.step_m

    def __call__(self, offset_m: NDArray[np.floating]) -> NDArray[np.complex128]:
        """Response at range offsets R - d (any shape, m) by linear interpolation; zero outside."""
        position = np.asarray(offset_m) / self.step_m + len(self.samples) // 2
        index = np.arange(len(self.samples))
        real = np.interp(position, index, self.samples.real, left=0.0, right=0.0)
        return real + 1j * np.interp(position, index, self.samples.imag, left=0.0, right=0.0)


@dataclass(frozen=True, eq=False)
class BasebandScans:
    """Scans after preprocessing: analytic, mixed to baseband, matched-filtered, decimated.

    A point of complex reflectivity sigma at distance d from the antenna of view v gives
    samples[v, b] = sigma * response(R_b - d) * exp(-2j k d), k = 2 pi carrier_hz / c, R_b = bin b's range.

    Attributes:
        samples: (views, bins) complex64.
        range_start_m, range_step_m: one-way range of bin 0 and between bins, m.
        carrier_hz: frequency that was mixed to zero, Hz.
        response: range response of a unit point.
        aperture: where the antenna stood, one position a view.
        wave_speed_m_s: speed of the wave in the medium, m/s.
        center_hz: middle of the pulse's band, Hz, which sets the lengths of imaging; the carrier is the
            nearest bin of a Fourier transform. None: the carrier.
        noise_std: estimated standard deviation of the complex noise of one sample, 0 if unknown.
        noise_density: estimated spectral density of that noise, averaged over the pulse's band and in units
            of one sample's variance: sum_b a_b n_b exp(-j theta b) has the variance noise_density
            sum_b |a_b|^2 at the band's frequencies theta. 0 if unknown. It exceeds noise_std^2, because
            the filter's skirts pass less than its band does.
        noise_shape: (P,) density of the noise at P frequencies, equally spaced from the lowest to the
            highest of the pulse's band, over `noise_density`; empty: the same at all.
        background_removed: the mean (or median) over the views was subtracted, and with it the mean echo of
            the scene.
        independent_samples: n of `reading`: views * bins * bandwidth / sampling rate.
        angle_scale_sigma: relative standard deviation of a factor common to all angles, where a device states
            them and the scans do not tell; None: not stated.
    """

    samples: NDArray[np.complex64]
    range_start_m: float
    range_step_m: float
    carrier_hz: float
    response: PointResponse
    aperture: Aperture
    noise_std: float = 0.0
    noise_density: float = 0.0
    independent_samples: float = 0.0
    noise_shape: tuple[float, ...] = ()
    background_removed: bool = False
    wave_speed_m_s: float = SPEED_OF_LIGHT
    center_hz: float | None = None
    angle_scale_sigma: float | None = None

    @property
    def bandwidth_hz(self) -> float:
        """Width of the pulse's band, Hz; the sampling rate where `independent_samples` is unknown."""
        size = self.samples.size
        independent = self.independent_samples if self.independent_samples > 0 else float(size)
        rate = self.wave_speed_m_s / (2 * self.range_step_m)
        return min(independent / size, 1.0) * rate

    @property
    def wavenumber(self) -> float:
        """k of the carrier, rad/m (one way)."""
        return 2 * np.pi * self.carrier_hz / self.wave_speed_m_s

    @property
    def wavelength_m(self) -> float:
        """Wavelength of the middle of the band in the medium, m."""
        return self.wave_speed_m_s / (self.center_hz or self.carrier_hz)

    @property
    def ranges_m(self) -> NDArray[np.float64]:
        """(bins,) one-way range of every bin, m."""
        return self.range_start_m + self.range_step_m * np.arange(self.samples.shape[1], dtype=np.float64)

    def with_aperture(self, aperture: Aperture) -> BasebandScans:
        """The same scans under another assumption of where the antenna stood."""
        return replace(self, aperture=aperture)


@dataclass(frozen=True, eq=False)
class Image:
    """A complex reflectivity image.

    Attributes:
        values: (pixels, pixels) complex64, index (y, x).
        grid: where the pixels lie, about `centre_m`.
        settings: method and parameters as plain JSON values.
        centre_m: (x, y) of the image's middle in the object's frame, m; methods work about the origin.
    """

    values: NDArray[np.complex64]
    grid: ImageGrid
    settings: dict[str, Any] = field(default_factory=dict)
    centre_m: tuple[float, float] = (0.0, 0.0)
