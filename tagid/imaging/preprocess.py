"""From raw range profiles to the baseband scans that every imaging method takes.

One linear filter does all of it (analytic signal, mixing, matched filter, band limit, decimation), so that
the response of a point is known exactly: it is the same filter applied to the pulse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture, Pulse
from tagid.errors import DataError, UsageError
from tagid.geometry import Aperture
from tagid.imaging.lengths import SEARCH_WAVELENGTHS
from tagid.imaging.rangefilter import BandFilter, design_filter
from tagid.imaging.types import BasebandScans
from tagid.signal import median
from tagid.waveform import nominal_pulse

MIN_BINS = 8
"""Fewer range bins cannot hold one echo of the pulse (a P440 pulse spans about 10)."""

MARGIN_WAVELENGTHS = 0.75 * SEARCH_WAVELENGTHS
"""Range kept beyond the image on both sides: three quarters of the search for the axis distance, since the
pulse's own width is kept, too. 30 mm for a P440."""

MIN_NOISE_VALUES = 64
"""Values needed for a noise estimate good to about 10 %."""

MIN_NOISE_BINS = 6
"""Range bins beside the target from which the noise's spectrum over the band is estimated."""

SHAPE_FREQUENCIES = 17
"""Frequencies at which the noise's density is estimated, 0.1 GHz apart for a P440."""
SHAPE_PRIOR = 5.0
"""Values of the mean density that are added to those measured at each of them."""

MIN_EARLY_VALUES = 16
"""Values before the object from which the noise is known to 36 %, enough to notice that it is coloured,"""
EARLY_SIGMAS = 3.0
"""by so many standard deviations of their power, over all frequencies or over the pulse's band."""

MAX_SAMPLE = 1e15
"""Largest magnitude of a sample: sums of squares over a capture stay finite in single precision."""

_CHUNK_SAMPLES = 1 << 22
_LN2 = float(np.log(2))

Background = Literal["mean", "median", "none"]


@dataclass(frozen=True)
class PreprocessSettings:
    """What is done to the scans before imaging.

    Attributes:
        background: static background over angle that is subtracted. "mean" is the least-squares estimate;
            "median" resists single bright passes and lost scans. Both also take from the target what is
            constant over angle: about 1/views of an echo (8 % at 12 views), more near the axis.
        matched_filter: correlate with the pulse (maximum SNR), or only limit to its band.
        pulse: the pulse; None takes the capture's, or the nominal one of the capture's band.
        extent_m: side of the square that will be imaged, m; ranges that it cannot reach are gated away.
        margin_m: range kept beyond that on both sides, m, which leaves room for the search of the axis
            distance; None: `MARGIN_WAVELENGTHS` of the carrier's.
        oversampling: sampling rate after decimation / bandwidth of the pulse, at least 1.3.
        heights_m: lowest and highest point that will be imaged, m.
    """

    background: Background = "mean"
    matched_filter: bool = True
    pulse: Pulse | None = None
    extent_m: float = 0.5
    margin_m: float | None = None
    oversampling: float = 1.5
    heights_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if self.background not in ("mean", "median", "none"):
            raise UsageError(f"background is {self.background!r}", "Choose mean, median or none.")
        if not (np.isfinite(self.extent_m) and self.extent_m > 0):
            raise UsageError(f"extent is {self.extent_m} m", "Give a positive side in metres.")
        if self.margin_m is not None and not (np.isfinite(self.margin_m) and self.margin_m >= 0):
            raise UsageError(f"gate margin is {self.margin_m} m", "Give zero or more metres.")
        if not 1.3 <= self.oversampling <= 16:
            raise UsageError(f"oversampling is {self.oversampling}", "Give 1.3 to 16.")


def preprocess(capture: Capture, settings: PreprocessSettings | None = None) -> BasebandScans:
    """Baseband scans of a capture, scaled so that an echo of amplitude A has reflectivity sigma = A.

    With p the analytic pulse of envelope peak 1, a point at distance d gives the RF samples
    A Re p(2 (R - d) / c) and the result A response(R - d) exp(-2j k d).

    Args:
        capture: (views, bins) real RF or complex analytic samples. Complex samples may be sampled below the
            carrier as long as the rate exceeds the pulse's band.
        settings: see `PreprocessSettings`.

    Raises:
        DataError: too few views or bins, all zero or one beyond `MAX_SAMPLE`, nothing changes over angle,
            sampled too coarsely for the pulse's band, or the object's ranges lie outside the recorded ones.
    """
    settings = settings or PreprocessSettings()
    aperture = capture.aperture()
    _check(capture, settings)
    pulse = settings.pulse or assumed_pulse(capture)
    band = design_filter(pulse, capture, matched=settings.matched_filter, oversampling=settings.oversampling)
    samples = remove_background(capture.samples, settings.background)
    if not np.any(samples):
        raise DataError(
            f"nothing changes over the {capture.views} views: the background removal leaves zero",
            "Check that the object turned, or image without background removal.",
        )
    baseband = _filter(samples, band, capture.range_start_m)
    start_m, step_m = capture.range_start_m, band.step_m
    low, high = _gate(capture, aperture, settings, band)
    first = max(0, int(np.ceil((low - start_m) / step_m)))
    last = min(baseband.shape[1], int(np.floor((high - start_m) / step_m)) + 1)
    gated = np.ascontiguousarray(baseband[:, first:last])
    if gated.shape[1] < 3:
        raise DataError(
            f"only {gated.shape[1]} independent range bins remain of the object's {low:.2f} to {high:.2f} m",
            "Record a longer range window, or image a larger extent.",
        )
    if not np.any(gated):
        raise DataError(f"all samples between {low:.2f} and {high:.2f} m are zero")
    lost = 1.0 if settings.background == "none" else np.sqrt(capture.views / (capture.views - 1))
    guard = int(np.ceil(band.response.half_width_m / step_m))
    # Nothing of the object arrives before its nearest point.
    before = float(np.linalg.norm(aperture.positions, axis=1).min()) - settings.extent_m / 2 - band.width_m
    early = baseband[:, 1 : max(1, int((before - start_m) / step_m) + 1)]
    noise = _noise(samples, baseband, (first - guard, last + guard), band)
    noise = _raised(noise, early, band)
    # A period in the scans tells the scale of the angles better than any device.
    known = capture.motion.resolved
    return BasebandScans(
        samples=gated,
        range_start_m=start_m + first * step_m,
        range_step_m=step_m,
        carrier_hz=band.carrier_hz,
        response=band.response,
        aperture=aperture,
        noise_std=float(np.sqrt(noise.variance) * lost),
        noise_density=noise.density * lost**2,
        noise_shape=noise.shape,
        independent_samples=gated.size * min(1.0, band.bandwidth_hz / band.rate_hz),
        background_removed=settings.background != "none",
        wave_speed_m_s=capture.wave_speed_m_s,
        center_hz=band.center_hz,
        angle_scale_sigma=None if known is None or known.checked_by_radar else known.scale_sigma,
    )


def remove_background(samples: NDArray[Any], background: Background) -> NDArray[Any]:
    """Samples (views, bins) without what is constant over the views, as float32 or complex64."""
    dtype = np.complex64 if np.iscomplexobj(samples) else np.float32
    if background == "none":
        return np.asarray(samples, dtype=dtype)
    static: NDArray[Any]
    if background == "mean":
        static = samples.mean(axis=0, dtype=np.complex128 if dtype is np.complex64 else np.float64)
    elif np.iscomplexobj(samples):
        static = median(samples.real, axis=0) + 1j * median(samples.imag, axis=0)
    else:
        static = median(samples, axis=0)
    return np.asarray(samples - static, dtype=dtype)


def assumed_pulse(capture: Capture) -> Pulse:
    """The capture's own pulse, or the nominal one of its band. Raises DataError if the band is none."""
    return capture.pulse or nominal(capture)


def nominal(capture: Capture) -> Pulse:
    """The nominal pulse of the capture's band. Raises DataError if that is none of a pulse."""
    ratio = capture.bandwidth_hz / capture.center_frequency_hz
    if not 0.01 <= ratio <= 1.8:
        raise DataError(
            f"a bandwidth of {capture.bandwidth_hz:.3g} Hz at {capture.center_frequency_hz:.3g} Hz "
            "is not that of an ultra-wideband pulse",
            "Correct center_frequency_hz and bandwidth_hz (Hz), or give the pulse.",
        )
    return nominal_pulse(capture.center_frequency_hz, capture.bandwidth_hz)


def _check(capture: Capture, settings: PreprocessSettings) -> None:
    if capture.bins < MIN_BINS:
        raise DataError(
            f"the scans have {capture.bins} range bins, at least {MIN_BINS} are needed",
            "Record a longer range window.",
        )
    if not np.any(capture.samples):
        raise DataError("all samples are zero", "Check the radar's antenna and its transmit gain.")
    with np.errstate(over="ignore"):
        largest = float(np.abs(capture.samples).max())
    if largest > MAX_SAMPLE:
        raise DataError(
            f"samples exceed {MAX_SAMPLE:g}: their energy would overflow in single precision",
            "Scale all samples by one factor.",
        )
    if capture.views < 2 and settings.background != "none":
        raise DataError(
            f"the capture has {capture.views} view: removing the background over angle leaves nothing",
            "Record the object turning, with at least 2 and better 18 or more views.",
        )


def _filter(samples: NDArray[Any], band: BandFilter, range_start_m: float) -> NDArray[np.complex64]:
    """(views, M) baseband scans over the whole window: FFT, band filter, shorter inverse FFT."""
    is_real = not np.iscomplexobj(samples)
    n, m = band.fft_bins, band.decimated_bins
    kept = int(np.floor((samples.shape[1] - 1) * m / n)) + 1
    phase = np.exp(-2j * band.wavenumber * range_start_m)
    transfer = (band.transfer * phase * (m / n)).astype(np.complex64)
    out = np.empty((len(samples), kept), dtype=np.complex64)
    block = max(1, _CHUNK_SAMPLES // n)
    for at in range(0, len(samples), block):
        part = samples[at : at + block]
        spectrum = np.fft.rfft(part, n, axis=1) if is_real else np.fft.fft(part, n, axis=1)
        narrow = np.zeros((len(part), m), dtype=np.complex64)
        narrow[:, band.offsets % m] = spectrum[:, band.indices] * transfer
        out[at : at + block] = np.fft.ifft(narrow, axis=1)[:, :kept]
    return out


def outside_error(capture: Capture, what: str, at_m: float) -> DataError:
    """That the object, of which `what` is at a range of `at_m`, lies outside the recorded ranges."""
    first, last = capture.range_start_m, float(capture.ranges_m[-1])
    remedy = "Correct the axis distance (`motion.axis_distance_m=METRES`) or the radar's range window."
    if capture.antenna_positions_m is not None:
        remedy = "Check that antenna_positions_m is in metres, and where the image is (`centre_m=X,Y`)."
    return DataError(
        f"the recorded range is {first:.3f} to {last:.3f} m, the {what} is at {at_m:.3f} m: "
        "the object lies outside the data",
        remedy,
    )


def _gate(
    capture: Capture, aperture: Aperture, settings: PreprocessSettings, band: BandFilter
) -> tuple[float, float]:
    """Ranges (m) from the nearest to the farthest that the imaged square can reach, and the pulse's width."""
    radius = settings.extent_m / np.sqrt(2)
    least, greatest = aperture.span(radius, settings.heights_m)
    near, far = float(least.min()), float(greatest.max())
    axis = aperture.distances(np.zeros((1, 3)))[:, 0]
    first, last = capture.range_start_m, float(capture.ranges_m[-1])
    wavelength = band.wave_speed_m_s / band.center_hz
    kept = MARGIN_WAVELENGTHS * wavelength if settings.margin_m is None else settings.margin_m
    # Free positions may be imaged anywhere, and the margin says how far the ranges may be off.
    slack = kept + settings.extent_m / 2 if aperture.axis_distance is None else 0.0
    if median(axis) < first - slack or median(axis) > last + slack:
        what = "antenna to the origin" if aperture.axis_distance is None else "rotation axis"
        raise outside_error(capture, what, float(median(axis)))
    margin = kept + band.width_m
    return near - margin, far + margin


@dataclass(frozen=True)
class _Noise:
    """Noise of the baseband samples, both 0 where it cannot be told.

    Attributes:
        variance: of one complex sample.
        density, shape: see `BasebandScans.noise_density` and `noise_shape`.
    """

    variance: float = 0.0
    density: float = 0.0
    shape: tuple[float, ...] = ()


def _raised(noise: _Noise, early: NDArray[np.complex64], band: BandFilter) -> _Noise:
    """The noise, or that of the range bins before the object where it is clearly stronger.

    A receiver's filter, or a transmitter in the band, makes noise that the spectrum outside the band does
    not show. Stronger over the pulse's band is enough: a filter's noise is weaker outside it than white
    noise is.
    """
    values = early.size * band.bandwidth_hz / band.rate_hz
    if noise.variance <= 0 or values < MIN_EARLY_VALUES:
        return noise
    seen = float(median(early.real**2 + early.imag**2)) / _LN2
    inside = _band_density([early], band)
    # The median of n exponential variables has the relative standard deviation 1 / (ln 2 sqrt n).
    most = 1 + EARLY_SIGMAS / (_LN2 * np.sqrt(values))
    if seen < most * noise.variance and inside < most * noise.density:
        return noise
    seen = max(seen, noise.variance)
    density = inside or noise.density * seen / noise.variance
    return _Noise(seen, density, _band_shape([early], band, density))


def _noise(
    samples: NDArray[Any], baseband: NDArray[np.complex64], target: tuple[int, int], band: BandFilter
) -> _Noise:
    """Noise of the baseband samples, the background's share of it not yet restored.

    Bins off the target are taken where there are enough; else the input's spectrum outside the pulse's band,
    taken as white. Both use the median of |z|^2, which is ln 2 times its mean for complex Gaussian noise.
    """
    sides = [baseband[:, : max(0, target[0])], baseband[:, max(0, target[1]) :]]
    off = np.concatenate(sides, axis=1)
    power = np.abs(band.transfer) ** 2
    # A filter that is flat over the band passes noise in its skirts, too.
    inside = np.abs(band.offsets) * band.rate_hz / band.decimated_bins <= band.bandwidth_hz / 2
    flat = float(power[inside].mean())
    white = flat * band.decimated_bins / float(power.sum())
    if off.size * band.bandwidth_hz / band.rate_hz >= MIN_NOISE_VALUES:
        variance = float(median(off.real**2 + off.imag**2)) / _LN2
        density = _band_density(sides, band) or variance * white
        return _Noise(variance, density, _band_shape(sides, band, density))
    window = np.hanning(samples.shape[1] + 2)[1:-1].astype(np.float32)
    n = samples.shape[1]
    rows = samples[:: max(1, len(samples) * n // _CHUNK_SAMPLES)] * window
    is_real = not np.iscomplexobj(samples)
    spectrum = np.fft.rfft(rows, axis=1) if is_real else np.fft.fft(rows, axis=1)
    frequency = np.arange(spectrum.shape[1]) / n * band.input_rate_hz
    away = np.abs(frequency - band.carrier_hz)
    if not is_real:
        away = np.abs((away + band.input_rate_hz / 2) % band.input_rate_hz - band.input_rate_hz / 2)
    outside = away > 1.5 * band.bandwidth_hz
    if is_real:
        outside &= (frequency > 2 * band.input_rate_hz / n) & (frequency < 0.49 * band.input_rate_hz)
    values = spectrum[:, outside]
    if values.size < MIN_NOISE_VALUES:
        return _Noise()
    density = float(median(values.real**2 + values.imag**2)) / _LN2 / float((window**2).sum())
    variance = density * float(power.sum()) / band.fft_bins
    return _Noise(variance, variance * white)


def _band_density(sides: Sequence[NDArray[np.complex64]], band: BandFilter) -> float:
    """Mean density of the noise over the pulse's band from range bins off the target; 0 from too few bins.

    Coloured noise is stronger in one part of the band than in the skirts that a sample's variance includes.
    """
    total = weight = 0.0
    for side in sides:
        if side.shape[1] >= MIN_NOISE_BINS:
            # One frequency per bin. Over the views alone: of coloured noise every frequency has its own mean.
            power = median(_periodogram(side, band, side.shape[1]), axis=0) / _median_of(len(side))
            total += side.shape[1] * float(power.mean())
            weight += side.shape[1]
    return total / weight if weight else 0.0


def _band_shape(
    sides: Sequence[NDArray[np.complex64]], band: BandFilter, density: float
) -> tuple[float, ...]:
    """`BasebandScans.noise_shape` from range bins off the target; empty from too few bins.

    The mean over the views, so that a transmitter that is on in some of them counts; SHAPE_PRIOR values of
    the mean density keep few bins from shaping white noise.
    """
    total, weight = np.zeros(SHAPE_FREQUENCIES), 0.0
    for side in sides:
        views, bins = side.shape
        if bins < MIN_NOISE_BINS:
            continue
        values = views * max(1.0, bins * band.bandwidth_hz / band.rate_hz / SHAPE_FREQUENCIES)
        total += values * _periodogram(side, band, SHAPE_FREQUENCIES).mean(axis=0)
        weight += values
    if not weight or density <= 0:
        return ()
    shape = (total / density + SHAPE_PRIOR) / (weight + SHAPE_PRIOR)
    return tuple(float(value) for value in shape)


def _periodogram(side: NDArray[np.complex64], band: BandFilter, frequencies: int) -> NDArray[np.float64]:
    """(views, frequencies) density at frequencies from the lowest to the highest of the pulse's band.

    A tapered Fourier transform: half of the band's width over the window's resolution.
    """
    bins = side.shape[1]
    window = np.hanning(bins + 2)[1:-1]
    reach = 0.5 * band.bandwidth_hz / band.rate_hz
    offsets = np.linspace(-reach, reach, frequencies)
    values = side @ (np.exp(-2j * np.pi * np.arange(bins)[:, None] * offsets) * window[:, None])
    return np.asarray((values.real**2 + values.imag**2) / float((window**2).sum()))


def _median_of(n: int) -> float:
    """Expected median of n exponential variables of mean 1: ln 2 + 1 / (2 n) to first order."""
    return _LN2 + 1 / (2 * n)


def select_views(scans: BasebandScans, views: NDArray[np.integer] | slice) -> BasebandScans:
    """The scans of some views only; the count of independent samples goes down with them."""
    samples = scans.samples[views]
    share = len(samples) / len(scans.samples)
    return replace(
        scans,
        samples=samples,
        aperture=scans.aperture.select(views),
        independent_samples=scans.independent_samples * share,
    )


def thinned(scans: BasebandScans, views: int) -> BasebandScans:
    """Every so many-th view: at least as many as asked for, where there are, and fewer than twice as many."""
    return select_views(scans, slice(None, None, max(1, scans.aperture.views // views)))
