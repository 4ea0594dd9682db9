"""The range filter of preprocessing and the exact point response that it leaves.

Filter and response come from one place because the forward operator is only as good as their agreement.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture, Pulse
from tagid.errors import DataError
from tagid.imaging.types import PointResponse
from tagid.waveform import analytic_pulse

MAX_PULSE_SAMPLES = 1 << 17
MAX_PAD = 1 << 17
"""Range bins that the pulse may take at most (a P440 pulse takes some 200 with its filter's ringing)."""

RESPONSE_FLOOR = 1e-3
"""The response is cut where it stays under this part of its peak (-60 dB)."""

_SAME_CENTER = 0.1
"""Centre frequencies this near, relative, are of one band: measured pulses of a P440 lie within 5 %."""

_RESPONSE_OVERSAMPLING = 32
_SPECTRUM_CHUNK = 1 << 20


@dataclass(frozen=True, eq=False)
class BandFilter:
    """A band-pass to baseband, on the DFT grid of one padded scan.

    Attributes:
        fft_bins: length n of the padded DFT of the input.
        decimated_bins: length M of the inverse DFT; the range step grows by n / M.
        indices: (K,) DFT bins of the input that are kept.
        offsets: (K,) their distance from the carrier's bin, -M/2 < offset < M/2.
        transfer: (K,) complex128 transfer function, with the factor 2 of the analytic signal for real input.
        carrier_hz: frequency that comes to zero, a DFT bin of the input.
        center_hz: middle of the band; the capture's where the pulse's agrees with it.
        bandwidth_hz: -10 dB width of the pulse.
        input_rate_hz, rate_hz: fast-time sampling rate before and after.
        step_m: one-way range step after decimation, m.
        response: response of a unit point after the filter.
        width_m: offset beyond which the response stays under 5 % of its peak, m.
        wave_speed_m_s: speed of the wave in the medium, m/s.
    """

    fft_bins: int
    decimated_bins: int
    indices: NDArray[np.intp]
    offsets: NDArray[np.intp]
    transfer: NDArray[np.complex128]
    carrier_hz: float
    center_hz: float
    bandwidth_hz: float
    input_rate_hz: float
    rate_hz: float
    step_m: float
    response: PointResponse
    width_m: float
    wave_speed_m_s: float

    @property
    def wavenumber(self) -> float:
        """k of the carrier, rad/m (one way)."""
        return 2 * np.pi * self.carrier_hz / self.wave_speed_m_s


def design_filter(pulse: Pulse, capture: Capture, *, matched: bool, oversampling: float) -> BandFilter:
    """Filter H(f) = conj(P(f)) W(f) (matched) or W(f), scaled for a response of peak 1.

    P is the spectrum of the pulse, W a raised cosine that is flat over the pulse's -10 dB band and ends at
    half the decimated rate, so that the decimation folds nothing back. The last few filters are kept: the
    captures of a batch mostly have one pulse and one range window.

    Raises DataError: the capture's range step is too coarse for the band, or the pulse is absurdly long.
    """
    samples = np.ascontiguousarray(pulse.samples)
    axis = _Axis(
        capture.bins,
        capture.range_step_m,
        capture.wave_speed_m_s,
        capture.center_frequency_hz,
        capture.samples.dtype.kind != "c",
    )
    return _designed(samples.tobytes(), samples.dtype.str, pulse.step, axis, matched, oversampling)


@dataclass(frozen=True)
class _Axis:
    """What a filter takes of a capture; the names are those of `Capture`."""

    bins: int
    range_step_m: float
    wave_speed_m_s: float
    center_frequency_hz: float
    is_real: bool


@lru_cache(maxsize=8)
def _designed(
    samples: bytes, kind: str, step: float, capture: _Axis, matched: bool, oversampling: float
) -> BandFilter:
    pulse = normalised(Pulse(np.frombuffer(samples, dtype=kind), step))
    low, high = band_of(pulse)
    bandwidth = high - low
    input_rate = capture.wave_speed_m_s / (2 * capture.range_step_m)
    is_real = capture.is_real
    _check_rate(is_real, input_rate, low, high)
    # No wrap-around: the pulse, its reflection (the matched filter) and the ringing of W must fit in the pad.
    duration = (1 + matched) * len(pulse.samples) * pulse.step + 24 / bandwidth
    if duration * input_rate > MAX_PAD:
        raise DataError(
            f"a range step of {capture.range_step_m:.3g} m is far too fine for a pulse of {bandwidth:.3g} Hz",
            "Check range_step_m (one way, in metres), the bandwidth and the pulse.",
        )
    n = fast_length(capture.bins + int(np.ceil(duration * input_rate)))
    df = input_rate / n
    middle, said = (low + high) / 2, capture.center_frequency_hz
    centre = round(middle / df)
    m = min(fast_length(int(np.ceil(oversampling * bandwidth / df)) + 1), n)
    offsets = np.arange(-((m - 1) // 2), (m - 1) // 2 + 1)
    if is_real:
        offsets = offsets[(centre + offsets > 0) & (centre + offsets < n / 2)]
    window = _raised_cosine(np.abs(offsets) * df, bandwidth / 2, m * df / 2)
    frequency = np.asarray((centre + offsets) * df, dtype=np.float64)
    spectrum = pulse_spectrum(pulse, frequency) * input_rate
    transfer = (spectrum.conj() * window if matched else window + 0j) * (2.0 if is_real else 1.0)
    # The analytic pulse has twice the spectrum of the real one; real input carries half of that.
    point = spectrum * transfer * (1.0 if is_real else 2.0)
    scale, response, width = _response(point, offsets, (n, m), capture.range_step_m)
    return BandFilter(
        fft_bins=n,
        decimated_bins=m,
        indices=np.asarray((centre + offsets) % n, dtype=np.intp),
        offsets=np.asarray(offsets, dtype=np.intp),
        transfer=np.asarray(transfer * scale, dtype=np.complex128),
        carrier_hz=centre * df,
        center_hz=said if abs(said / middle - 1) < _SAME_CENTER else middle,
        bandwidth_hz=bandwidth,
        input_rate_hz=input_rate,
        rate_hz=m * df,
        step_m=capture.range_step_m * n / m,
        response=response,
        width_m=width,
        wave_speed_m_s=capture.wave_speed_m_s,
    )


def normalised(pulse: Pulse) -> Pulse:
    """The pulse with an envelope peak of 1. Raises DataError if it is too long to be one."""
    if len(pulse.samples) > MAX_PULSE_SAMPLES:
        raise DataError(
            f"the pulse has {len(pulse.samples)} samples, at most {MAX_PULSE_SAMPLES} are allowed"
        )
    return Pulse(pulse.samples / np.abs(analytic_pulse(pulse, 4)).max(), pulse.step)


def fast_length(least: int) -> int:
    """The smallest 2^a 3^b 5^c that is not less: a length whose Fourier transform is fast.

    numpy has transforms in single precision since 2.0, but no such function; scipy has one, behind an import
    that costs 27 MB and half the start of a command.
    """
    best = 1 << max(least - 1, 0).bit_length()
    five = 1
    while five < best:
        three = five
        while three < best:
            power_of_two = -(-least // three)
            best = min(best, three * (1 << max(power_of_two - 1, 0).bit_length()))
            three *= 3
        five *= 5
    return best


def band_of(pulse: Pulse) -> tuple[float, float]:
    """Lowest and highest frequency at -10 dB of the power spectrum's peak, Hz."""
    n = fast_length(max(8192, 8 * len(pulse.samples)))
    power = np.abs(np.fft.rfft(pulse.samples, n)) ** 2
    above = np.flatnonzero(power >= power.max() / 10)
    df = 1 / (n * pulse.step)
    low, high = float(above[0] * df), float((above[-1] + 1) * df)
    if low <= 0 or above[-1] >= len(power) - 2:
        raise DataError(
            "the pulse's band reaches zero or half its sampling rate",
            "Give a real RF pulse with its carrier, sampled at more than twice its highest frequency.",
        )
    return low, high


def pulse_spectrum(pulse: Pulse, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Fourier transform of the real pulse at any frequencies (K,), with time zero at its middle sample."""
    time = (np.arange(len(pulse.samples)) - len(pulse.samples) // 2) * pulse.step
    out = np.empty(len(frequency_hz), dtype=np.complex128)
    block = max(1, _SPECTRUM_CHUNK // len(time))
    for at in range(0, len(out), block):
        f = frequency_hz[at : at + block]
        out[at : at + block] = np.exp(-2j * np.pi * np.outer(f, time)) @ pulse.samples
    return out * pulse.step


def _check_rate(is_real: bool, input_rate: float, low: float, high: float) -> None:
    needed = 2 * high if is_real else high - low
    if input_rate < needed:
        raise DataError(
            f"the range step means sampling at {hertz(input_rate)}, "
            f"the pulse's band of {hertz(low)} to {hertz(high)} needs {hertz(needed)}",
            "Check range_step_m (one way, in metres), wave_speed_m_s, the band and the pulse.",
        )


def hertz(frequency: float) -> str:
    """A frequency with the unit that suits its size."""
    for unit, scale in (("GHz", 1e9), ("MHz", 1e6), ("kHz", 1e3)):
        if abs(frequency) >= scale:
            return f"{frequency / scale:.2f} {unit}"
    return f"{frequency:.3g} Hz"


def _raised_cosine(distance: NDArray[np.float64], flat: float, end: float) -> NDArray[np.float64]:
    if end <= flat:
        return np.ones_like(distance)
    x = np.clip((distance - flat) / (end - flat), 0, 1)
    return 0.5 * (1 + np.cos(np.pi * x))


def _response(
    point: NDArray[np.complex128], offsets: NDArray[np.intp], bins: tuple[int, int], range_step_m: float
) -> tuple[float, PointResponse, float]:
    """Scale for a peak of 1, the response on a fine grid cut at its floor, and its width at 5 %, m."""
    n, m = bins
    fine = m * _RESPONSE_OVERSAMPLING
    narrow = np.zeros(fine, dtype=np.complex128)
    narrow[offsets % fine] = point
    g = np.fft.fftshift(np.fft.ifft(narrow)) * (fine / n)
    peak = float(np.abs(g).max())
    g = g / peak
    step = range_step_m * n / fine
    distance = np.abs(np.arange(fine) - fine // 2)
    magnitude = np.abs(g)
    half = int(distance[magnitude > RESPONSE_FLOOR].max()) + 2
    half = min(half, fine // 2 - 1)
    width = float(distance[magnitude > 0.05].max()) * step
    cut = g[fine // 2 - half : fine // 2 + half + 1]
    return 1 / peak, PointResponse(cut, step), width
