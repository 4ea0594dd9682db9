"""The delay of cables and antennas, from the echo of a target at a measured distance, and the empty scene.

Imaging requires ranges correct to a centimetre, while ten nanoseconds of cable are 1.5 m; so the delay is
measured with the same pulse and peak definition as imaging, and reported with its uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture, ViewFlag
from tagid.constants import BIN_PS, SPEED_OF_LIGHT
from tagid.errors import DataError, UsageError
from tagid.metadata import RadarInfo, RadarSettings, ReferenceFacts, ReferenceName
from tagid.radar.assembler import Scan
from tagid.radar.p440 import P440
from tagid.radar.settings import RadarConfig
from tagid.signal import from_positive, peak_place, positive_spectrum
from tagid.waveform import nominal_pulse, pulse_at

LONGEST_DELAY_PS = 25_000.0
"""Longest delay searched: 10 to 13 ns are typical; one metre more cable per antenna adds 10 ns."""

EDGE_PS = 3_000.0
"""Margin of the window beyond the searched times, so that no echo lies at its edge."""

_MOST_SCANS = 5000
_FINER = 16
_BLOCKS = 8
_LEAST_SNR_DB = 10.0
_APART_PS = 1_200.0
"""A pulse is 0.7 to 1.14 ns wide (measured); two maxima further apart than this are two echoes."""
_SIMILAR = 0.5


class TwoEchoesError(DataError):
    """Two echoes of similar strength stand out: which one is the target's is not known."""


class ClippedEchoError(DataError):
    """The target's echo is clipped, so that its peak cannot be found."""


@dataclass(frozen=True)
class DelayEstimate:
    """The two-way delay of cables and antennas.

    Attributes:
        delay_ps: the delay, ps; goes into `radar.cable_delay_ps`.
        sigma_ps: its standard deviation, ps: root sum of squares of the parts below.
        echo_ps: two-way time of the echo's peak on the radar's clock, ps.
        snr_db: power of the echo over the rest in the mean of all scans, behind the matched filter, dB.
        tape_ps: contribution of the error of the measured distance, ps.
        noise_ps: scatter between parts of the recording, ps.
        shape_ps: shift of the peak by the matched filter, because the pulse is not the nominal one.
    """

    delay_ps: float
    sigma_ps: float
    echo_ps: float
    snr_db: float
    tape_ps: float
    noise_ps: float
    shape_ps: float


def estimate_delay(
    target: Capture,
    distance_m: float,
    tape_error_m: float = 0.005,
    empty: NDArray[np.float64] | None = None,
    longest_ps: float = LONGEST_DELAY_PS,
) -> DelayEstimate:
    """The delay from scans of a static target: echo time less 2 d / c.

    The scans are averaged, the empty scene is subtracted, and the peak of the envelope behind a filter
    matched to the nominal pulse is found between delay 0 and `longest_ps`.

    Args:
        target: (views, bins) raw samples, ranges without delay correction.
        distance_m: measured from the antennas to the target's reflecting point, m.
        tape_error_m: standard deviation of the distance, m.
        empty: (bins,) mean scan without the target on the same grid, counts; None if there is none.
        longest_ps: longest delay searched, ps.

    Raises:
        UsageError: the distance or its error are out of range.
        DataError: too few scans, no distinct echo, two of them, or a clipped echo.
    """
    if not (0.1 <= distance_m <= 100 and 0 <= tape_error_m <= 1):
        raise UsageError(
            f"the target distance is {distance_m} m, its error {tape_error_m} m",
            "Give 0.1 to 100 m, and an error of at most 1 m.",
        )
    scans = usable(target)
    if len(scans) < 2 * _BLOCKS:
        raise DataError(f"{len(scans)} scans are too few for a calibration", f"Record {2 * _BLOCKS} or more.")
    air_ps = 2e12 * distance_m / SPEED_OF_LIGHT
    step_ps = 2e12 * target.range_step_m / SPEED_OF_LIGHT
    start_ps = 2e12 * target.range_start_m / SPEED_OF_LIGHT
    low, high = (round((t - start_ps) / step_ps * _FINER) for t in (air_ps, air_ps + longest_ps))
    low, high = max(low, 0), min(high, target.bins * _FINER - 1)
    if high - low < 4 * _FINER:
        raise DataError(
            f"the scans do not reach the target's echo at {air_ps / 1e3:.1f} ns or later",
            "Record a later window: `tagid radar calibrate` chooses one automatically.",
        )
    background = np.zeros(target.bins) if empty is None else empty
    raw, matched = _envelopes(scans.mean(axis=0) - background, step_ps * 1e-12)
    peak = peak_place(matched, low, high)
    to_ps = step_ps / _FINER
    snr_db = _check_echo(target, scans, matched, (low, high), peak, start_ps, to_ps)
    edges = np.linspace(0, len(scans), _BLOCKS + 1).astype(int)
    near = round(_APART_PS / step_ps * _FINER)
    around = max(low, round(peak) - near), min(high, round(peak) + near)
    parts = [
        peak_place(_envelopes(scans[a:b].mean(axis=0) - background, step_ps * 1e-12)[1], *around)
        for a, b in pairwise(edges)
    ]
    noise_ps = float(np.std(parts, ddof=1)) / math.sqrt(_BLOCKS) * to_ps
    shape_ps = abs(peak_place(raw, *around) - peak) * to_ps
    tape_ps = 2e12 * tape_error_m / SPEED_OF_LIGHT
    # The radar reports its window in whole ps; the window starts on a grid of 1.9 ps.
    grid_ps = BIN_PS / math.sqrt(12)
    echo_ps = start_ps + peak * to_ps
    sigma = math.sqrt(tape_ps**2 + noise_ps**2 + shape_ps**2 + grid_ps**2)
    return DelayEstimate(echo_ps - air_ps, sigma, echo_ps, snr_db, tape_ps, noise_ps, shape_ps)


def usable(capture: Capture) -> NDArray[np.float64]:
    """(views, bins) samples without the first scan of a run, which is often bad (measured)."""
    samples = capture.samples
    if capture.flags is not None and len(samples) > 1:
        samples = samples[(capture.flags & ViewFlag.FIRST) == 0]
    if np.iscomplexobj(samples):
        raise DataError("complex samples cannot be used for calibration", "Use the radar's raw scans.")
    return np.asarray(samples, dtype=np.float64)


def make_reference(empty: Capture) -> Capture:
    """The empty scene as stored: the recording, with its noise and mean power in `radar.reference`.

    Raises DataError for fewer than 16 scans.
    """
    scans = usable(empty)
    if len(scans) < 2 * _BLOCKS:
        raise DataError(f"{len(scans)} scans are too few for a reference", f"Record {2 * _BLOCKS} or more.")
    noise = float(np.sqrt(np.var(scans, axis=0, ddof=1).mean()))
    rms = float(np.sqrt((scans.mean(axis=0) ** 2).mean()))
    return replace(empty, radar=replace(empty.radar, reference=ReferenceFacts(noise, len(scans), rms)))


def reference_on(reference: Capture, capture: Capture) -> NDArray[np.float64]:
    """(bins,) mean scan of the empty scene on the ranges of a capture, counts.

    The two windows may differ by a fraction of a sample: the mean is resampled to a 16 times finer step by
    Fourier transform and interpolated linearly. It is scaled by 2^PII for the integration.

    Raises DataError if the reference does not cover the capture or was recorded with other settings.
    """
    here, there = capture.radar.config or RadarSettings(), reference.radar.config or RadarSettings()
    for name in ("transmit_gain", "antenna_mode", "code_channel"):
        now, then = getattr(here, name), getattr(there, name)
        if now != then:
            raise DataError(
                f"the background reference was recorded with {name} {then}, not {now}",
                "Record it again with `tagid radar calibrate --step empty`.",
            )
    shift = _two_way(capture) - _two_way(reference)
    first = (capture.range_start_m - reference.range_start_m + shift) / reference.range_step_m
    at = first + np.arange(capture.bins) * (capture.range_step_m / reference.range_step_m)
    if at[0] < -0.5 or at[-1] > reference.bins - 0.5:
        raise DataError(
            "the background reference does not cover the window of these scans",
            "Record it again with `tagid radar calibrate --step empty`.",
        )
    mean = usable(reference).mean(axis=0)
    fine = np.fft.irfft(np.fft.rfft(np.concatenate([mean, mean[::-1]])), 2 * len(mean) * _FINER) * _FINER
    values = np.interp(at * _FINER, np.arange(len(fine)), fine)
    more = (here.base_integration_index or 0) - (there.base_integration_index or 0)
    return np.asarray(values * 2.0**more)


def without_background(capture: Capture, reference: Capture) -> Capture:
    """The capture with the empty scene subtracted, float32; raises the errors of `reference_on`.

    Unlike subtracting the mean over the angles, this keeps the rotationally symmetric echo of the object.
    """
    if np.iscomplexobj(capture.samples):
        raise DataError("complex samples have no background reference", "Use `background=mean`.")
    samples = (capture.samples - reference_on(reference, capture)).astype(np.float32)
    name = ReferenceName(reference.uuid, reference.created_utc)
    return replace(capture, samples=samples, radar=replace(capture.radar, background_reference=name))


def calibration_window(distances_m: Sequence[float], longest_ps: float, base: RadarConfig) -> RadarConfig:
    """The settings whose window contains the echoes from all these distances, for any delay."""
    times = [2e12 * distance / SPEED_OF_LIGHT for distance in distances_m]
    start = max(round(min(times) - EDGE_PS), 0)
    stop = round(max(times) + longest_ps + EDGE_PS)
    return replace(base, scan_start_ps=start, scan_stop_ps=stop, persist=0)


def take_scans(
    radar: P440, count: int, progress: Callable[[int, Scan], None] = lambda done, scan: None
) -> Capture:
    """A capture of `count` scans with the radar's settings, without a delay correction, in memory.

    The progress is called with how many there are, and the newest.

    Raises UsageError for more than 5000 scans, DataError if none arrives, DeviceError and its subclasses.
    """
    if not 2 * _BLOCKS <= count <= _MOST_SCANS:
        raise UsageError(f"{count} scans are requested", f"Give {2 * _BLOCKS} to {_MOST_SCANS}.")
    config, status = radar.config, radar.status()
    scans = []
    for scan in radar.scans(count):
        scans.append(scan)
        progress(len(scans), scan)
    if not scans:
        raise DataError("no complete scan arrived", "Check the radar with `tagid radar monitor`.")
    return Capture(
        np.stack([scan.samples for scan in scans]),
        config.range_start_m(),
        config.range_step_m,
        host_time_ns=np.array([scan.host_time_ns for scan in scans], dtype=np.int64),
        radar_time_ms=np.array([scan.radar_time_ms for scan in scans], dtype=np.float64),
        scan_id=np.array([scan.scan_id for scan in scans], dtype=np.int64),
        flags=np.array([ViewFlag.FIRST] + [0] * (len(scans) - 1), dtype=np.uint8),
        radar=RadarInfo(config=config.stored(), serial=status.serial, cable_delay_ps=0.0),
    )


def _envelopes(scan: NDArray[np.float64], step_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(bins * 16,) envelope, and envelope after a filter matched to the nominal pulse."""
    bins = len(scan)
    length = 1 << (2 * bins - 1).bit_length()
    half = length // 2
    spectrum = positive_spectrum(scan - scan.mean(), length)
    offset = (np.arange(length) + half) % length - half
    pulse = np.fft.fft(pulse_at(nominal_pulse(), offset * step_s))[: half + 1]
    both = np.stack([spectrum, spectrum * np.conj(pulse)])
    envelopes = np.abs(from_positive(both, length, bins, _FINER))
    return envelopes[0], envelopes[1]


def _check_echo(
    target: Capture,
    scans: NDArray[np.float64],
    matched: NDArray[np.float64],
    searched: tuple[int, int],
    peak: float,
    start_ps: float,
    to_ps: float,
) -> float:
    """`DelayEstimate.snr_db`; DataError if there is no echo, more than one, or a clipped one.

    Args:
        target, scans, matched: the recording, its usable scans, and the envelope of their mean.
        searched, peak: first and last index of the search in the envelope, and index of its peak.
        start_ps, to_ps: two-way time of index 0, and from index to index, ps.
    """
    low, high = searched
    near = round(_APART_PS / to_ps)
    away = np.ones(len(matched), dtype=bool)
    away[max(0, round(peak) - 2 * near) : round(peak) + 2 * near + 1] = False
    height = float(matched[round(peak)])
    # For white noise of variance s^2 the filter output is 4 s^2 sum |p|^2 (negative frequencies are folded).
    offset = np.arange(-200, 201) * to_ps * _FINER * 1e-12
    energy = float((np.abs(pulse_at(nominal_pulse(), offset)) ** 2).sum())
    floor = 4 * energy * (float(scans.var(axis=0, ddof=1).mean()) + 1 / 12) / len(scans)
    if away.any():
        floor = max(floor, float(np.median(matched[away] ** 2)) / math.log(2))
    snr_db = 10 * math.log10(max(height**2 / floor, 1e-9))
    if snr_db < _LEAST_SNR_DB or not low < peak < high:
        raise DataError(
            f"no echo of a target stands out ({snr_db:.1f} dB over the rest)",
            "Use a larger reflector, point both antennas at it, and check the measured distance.",
        )
    rivals = matched.copy()
    rivals[max(0, round(peak) - near) : round(peak) + near + 1] = 0
    rival = low + int(rivals[low : high + 1].argmax())
    if rivals[rival] > _SIMILAR * height:
        times = [f"{(start_ps + index * to_ps) / 1e3:.2f} ns" for index in sorted((peak, rival))]
        raise TwoEchoesError(
            f"two echoes of similar strength stand out, at {times[0]} and {times[1]}",
            "Record the scene without the target first (`step=both`), or use a larger reflector.",
        )
    clip = target.radar.clip_counts
    sample = round(peak / _FINER)
    gate = scans[:, max(0, sample - 8) : sample + 9]
    if clip is not None and np.abs(gate).max() >= clip:
        raise ClippedEchoError(
            "the target's echo is clipped, its peak cannot be found",
            "Lower the gain (`tagid config set radar.gain`), or use a smaller or more distant reflector.",
        )
    return snr_db


def _two_way(capture: Capture) -> float:
    """Range that was subtracted for the cable delay, m."""
    return (capture.radar.cable_delay_ps or 0.0) * 1e-12 * SPEED_OF_LIGHT / 2
