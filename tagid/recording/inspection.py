"""Statistics of a recording: SNR, clipping, completeness, and rotation of the object.

`tagid show` prints them and bug reports quote them, so each figure's definition is documented here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.angles.clock import fit_clock
from tagid.angles.period import find_period
from tagid.capture import Capture
from tagid.errors import DataError
from tagid.metadata import ResolvedMotion
from tagid.recording.curves import TIME_LABEL, slow_time
from tagid.signal import analytic, noise_power_of, over_noise_db, peak_place, snr_db

MOST_BYTES = 64 << 20
"""Samples inspected or plotted at a time, bytes; of longer recordings every n-th view is used."""
_GATE_BINS = 64


@dataclass(frozen=True, eq=False)
class StrongReturn:
    """The strongest return and its stability.

    Attributes:
        bin: range bin of its peak in the mean envelope.
        range_m: one-way range of that bin, m.
        bins: (views,) float64 fractional bin of its peak in each view.
        coherence: 0..1, power of the mean scan over the scans' mean power around the return; 1 is static.
    """

    bin: int
    range_m: float
    bins: NDArray[np.float64]
    coherence: float

    @property
    def spread_bins(self) -> float:
        """Largest minus smallest bin of any view."""
        return float(np.ptp(self.bins))


@dataclass(frozen=True, eq=False)
class RecordingSummary:
    """Summary of a recording.

    Attributes:
        views, bins: size of the recording.
        range_from_m, range_to_m: one-way range of the first and last bin, m.
        noise: standard deviation of the noise of one sample, counts; None for a single view.
        strongest_over_noise_db: strongest return, static or not, see `tagid.signal.over_noise_db`, dB.
        snr_db: SNR, see `tagid.signal.snr_db`, dB; None if nothing changes beyond the noise.
        changing_range_m: one-way range with the largest change, m; None with `snr_db`.
        clipped_fraction: saturated samples over all samples; None if the limit is not known.
        lost_scans: scans missing between the first and the last; None if scans are not numbered.
        scan_rate_hz: scans per second; None if there is no clock.
        duration_s: from the first view to the last, s; None if there is no clock.
        period_s, period_sigma_s: seconds per turn and their standard deviation; None if none was found.
        period_note: why there is no period, or why it is uncertain; empty otherwise.
        strongest: the strongest return; None if all samples are zero.
        every: noise, SNR, period and strongest return use every n-th view; 1 is all of them.
    """

    views: int
    bins: int
    range_from_m: float
    range_to_m: float
    noise: float | None
    strongest_over_noise_db: float | None
    snr_db: float | None
    changing_range_m: float | None
    clipped_fraction: float | None
    lost_scans: int | None
    scan_rate_hz: float | None
    duration_s: float | None
    period_s: float | None
    period_sigma_s: float | None
    period_note: str
    strongest: StrongReturn | None
    every: int = 1

    @property
    def changes(self) -> bool:
        """Whether an echo moves or rotates, as far as the noise permits detection."""
        return self.snr_db is not None


@dataclass(frozen=True)
class Turning:
    """A period of rotation, or why there is none.

    Attributes:
        period_s, sigma_s: seconds per turn and their standard deviation; None if none was found.
        note: why there is none, or why it is uncertain; empty otherwise.
    """

    period_s: float | None = None
    sigma_s: float | None = None
    note: str = ""


NO_CHANGE = Turning(note="nothing changes from scan to scan beyond the noise")


def inspect(capture: Capture) -> RecordingSummary:
    """The summary of a capture; a figure that cannot be computed from its data is None."""
    some, every = thinned(capture)
    signal = analytic(some.samples)
    noise_power = noise_power_of(signal)
    strongest = strongest_return(signal, some)
    changing_snr, changing_bin = snr_db(signal, noise_power)
    rate, duration = scan_rate(capture)
    turning = turning_period(some) if changing_snr is not None else NO_CHANGE
    ranges = capture.ranges_m
    # Half of a real sample's analytic noise power is the sample's own.
    noise_share = 1.0 if np.iscomplexobj(capture.samples) else 0.5
    return RecordingSummary(
        views=capture.views,
        bins=capture.bins,
        range_from_m=float(ranges[0]),
        range_to_m=float(ranges[-1]),
        noise=None if noise_power is None else math.sqrt(noise_share * noise_power),
        strongest_over_noise_db=over_noise_db(signal, noise_power)[0],
        snr_db=changing_snr,
        changing_range_m=None if changing_bin is None else float(ranges[changing_bin]),
        clipped_fraction=clipped_fraction(capture),
        lost_scans=lost_scans(capture),
        scan_rate_hz=rate,
        duration_s=duration,
        period_s=turning.period_s,
        period_sigma_s=turning.sigma_s,
        period_note=turning.note,
        strongest=strongest,
        every=every,
    )


def clipped_fraction(capture: Capture) -> float | None:
    """Fraction of samples at saturation: 127 * 2^PII counts if the integration index PII is recorded.

    Otherwise integer samples count as clipped at their extreme values if more than one sample has that
    value (a single maximum is not clipping). None for complex samples, and for floating-point samples
    without an index.
    """
    samples = capture.samples
    if np.iscomplexobj(samples):
        return None
    limit = capture.radar.clip_counts
    if limit is not None:
        return float(np.mean((samples >= limit) | (samples <= -limit)))
    if not np.issubdtype(samples.dtype, np.integer):
        return None
    high, low = samples.max(), samples.min()
    if high == low:
        return 0.0
    counts = [int(np.count_nonzero(samples == extreme)) for extreme in (high, low)]
    return sum(count for count in counts if count > 1) / samples.size


def lost_scans(capture: Capture) -> int | None:
    """Lost scans: gaps in the scan numbers, or the count of the recorder or importer if that is larger.

    The recorder's count includes scans lost before the first and after the last one. For one part of a long
    recording it is the count of the whole recording, so only the gaps are used.
    """
    gaps = None
    if capture.scan_id is not None and capture.views > 1:
        steps = np.diff(capture.scan_id)
        gaps = int((steps[steps > 1] - 1).sum())
    counted = capture.radar.scans_lost
    if counted is None or counted < 0:
        return gaps
    if gaps is not None and capture.radar.recording is not None:
        return gaps
    return max(counted, gaps or 0)


def thinned(capture: Capture) -> tuple[Capture, int]:
    """(capture of every n-th view, n) whose samples take at most `MOST_BYTES`; n is 1 if all fit.

    Plotting or inspecting a recording needs several times the memory of its samples.
    """
    every = max(1, -(-capture.samples.nbytes // MOST_BYTES))
    return (capture, 1) if every == 1 else (capture.select(slice(None, None, every)), every)


def scan_rate(capture: Capture) -> tuple[float | None, float | None]:
    """(scans per second, seconds from first to last) by the radar's clock, else the host's; None without one.

    Scan numbers are used if known, so that lost scans do not lower the rate.
    """
    position, label = slow_time(capture)
    if label != TIME_LABEL:
        return None, None
    duration = float(position[-1])
    scans = capture.views - 1
    if capture.scan_id is not None and np.all(np.diff(capture.scan_id) > 0):
        scans = int(capture.scan_id[-1] - capture.scan_id[0])
    return scans / duration, duration


def turning_period(capture: Capture) -> Turning:
    """The period after which the scans repeat.

    If the recording contains a speed (motion settings, or its angles), a period near it is searched;
    otherwise the shortest repetition is returned, which is a fraction of a turn for a symmetric object.
    """
    times, label = slow_time(capture)
    if label != TIME_LABEL:
        timed = capture.radar_time_ms is not None or capture.host_time_ns is not None
        return Turning(note="the scans' times do not advance" if timed else "the scans carry no times")
    nominal = nominal_period_s(capture, float(times[-1]))
    try:
        if capture.radar_time_ms is not None:
            times = fit_clock(capture.radar_time_ms, capture.scan_id).times_s
        estimate = find_period(capture.samples, times, nominal_s=nominal)
    except DataError as error:
        return Turning(note=error.message)
    notes = []
    if nominal is None:
        notes.append("shortest repetition; an n-fold symmetric object takes n times as long")
    if estimate.harmonic_ambiguous:
        others = ", ".join(f"{rival:.2f} s" for rival in estimate.rivals_s)
        notes.append(f"the scans also repeat after {others}" if others else "a multiple is possible")
    return Turning(float(estimate.period_s), float(estimate.sigma_s), "; ".join(notes))


def nominal_period_s(capture: Capture, duration_s: float) -> float | None:
    """Seconds per turn from the motion settings, else from the angles; None if no speed is known.

    A period or angles estimated from these scans (`source` is "data") are not independent and are not used.
    """
    resolved = capture.motion.resolved or ResolvedMotion()
    for stated in (resolved.nominal_rpm, capture.motion.nominal_rpm):
        rpm = _sensible(stated)
        if rpm is not None:
            return 60 / rpm
    if resolved.source == "data":
        return None
    nominal = _sensible(resolved.period_s)
    if nominal is not None or capture.angles_rad is None:
        return nominal
    turns = abs(float(capture.angles_rad[-1] - capture.angles_rad[0])) / (2 * math.pi)
    return duration_s / turns if turns > 0.5 else None


def _sensible(value: float | None) -> float | None:
    """A plausible speed or period of a turntable; None for anything else in a file."""
    return value if value is not None and 1e-3 < value < 1e6 else None


def strongest_return(signal: NDArray[np.complex64], capture: Capture) -> StrongReturn | None:
    """Position of the strongest return, in the mean and in each view; None if all samples are zero.

    The maximum of a single view jumps between returns of similar strength and between carrier cycles. So the
    mean scan around the strongest return is the template, every view is correlated with it, and the peak of
    the correlation's magnitude, refined by a parabola, gives the shift.
    """
    bins = signal.shape[1]
    envelope = np.abs(signal).mean(axis=0, dtype=np.float64)
    peak = int(envelope.argmax())
    if not envelope[peak] > 0:
        return None
    low, high = max(0, peak - _GATE_BINS), min(bins, peak + _GATE_BINS + 1)
    gate = signal[:, low:high].astype(np.complex128)  # the squares of faint samples vanish in float32
    template = gate.mean(axis=0)
    mean_power = float((np.abs(gate) ** 2).mean(axis=0, dtype=np.float64).sum())
    coherence = min(1.0, float((np.abs(template) ** 2).sum()) / mean_power)
    length = 1 << (2 * (high - low) - 1).bit_length()
    spectra = np.fft.fft(gate, length, axis=1) * np.conj(np.fft.fft(template, length))
    magnitude = np.fft.fftshift(np.abs(np.fft.ifft(spectra, axis=1)), axes=1)
    shifts = np.array([peak_place(curve) for curve in magnitude]) - length // 2
    ranges = capture.ranges_m
    return StrongReturn(peak, float(ranges[peak]), peak + shifts, coherence)
