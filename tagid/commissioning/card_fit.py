"""Axis, turning and reflectors at once, from a recording of the test card, whose marks are known.

The echo of the card is modelled view by view: the pulse that the reference target returned, delayed to each
reflector. All that is not known is fitted jointly by least squares (Gauss-Newton with Gaussian priors): the
distance of the axis, the period and the harmonics of the speed, the pose of the card, how far each reflector
stands from its mark, and its complex amplitude. Distance and phase are separated as in
`tagid.imaging.ats.calibration`: reflectors have any phase, so that the envelopes alone tell the distance. The
antennas' height is that of the tape: the scans see the card foreshortened by it, and a smaller card looks the
same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture, Pulse
from tagid.constants import SPEED_OF_LIGHT
from tagid.geometry import Aperture
from tagid.imaging.kernel import RangeGeometry
from tagid.rig import Measured
from tagid.signal import positive_spectrum
from tagid.types import Complex, Floats
from tagid.waveform import pulse_at

HARMONICS: Final = 4
SEARCH_M: Final = 0.12
"""Half width of the search for the axis: a tape read wrongly by a decimetre."""
_STEP_M: Final = 0.01
_REACH_M: Final = 0.13
"""The card, and how far from the axis it may lie."""
_PIXEL_M: Final = 0.005
_SHIFTS_M: Final = np.arange(-0.025, 0.026, 0.005)
_POSES: Final = 144
_SEARCH_VIEWS: Final = 90
_FIT_VIEWS: Final = 300
_FINER: Final = 8
_BEFORE_M: Final = 0.35
_AFTER_M: Final = 0.75
"""Ranges that are compared, around the axis: pulses ring for 3 ns."""
_CENTRE_M: Final = 0.02
_MARK_M: Final = 1e-3
_WOBBLE_RAD: Final = 0.03
_SPEED: Final = 0.02
"""Prior standard deviations: of the card about the axis, of a reflector about its mark (which is also that of
the printed scale), of the angle over the harmonic's order, and of the mean speed, relative."""
_STARTS: Final = 4
_ITERATIONS: Final = 15
_SECTORS: Final = 18
_CONVERGED: Final = 0.02
_DIFFERENCE: Final = 1e-6
_PHASE_CENTRE_M: Final = 5e-6
"""By how much phase centres and marks move at each harmonic of the turn, alike in all (emulated rigs)."""
_FREE: Final = 1e-4
"""Weight of the relative change of an amplitude, which is free."""


@dataclass(frozen=True)
class Known:
    """What was measured before.

    Attributes:
        axis_distance_m: of the antennas to the axis, by tape, m.
        height: of the antennas above the reflectors, by tape, m.
        separation_m: of the antennas, m.
        delay: by how much later than that of a point a reflector's echo peaks, beyond the path delay, and
            the standard error of both, as one-way range, m.
        pulse: as the card's reflectors return it.
        noise: standard deviation of the noise of a sample, counts.
    """

    axis_distance_m: float
    height: Measured
    separation_m: float
    delay: Measured
    pulse: Pulse
    noise: float


@dataclass(frozen=True, eq=False)
class CardFit:
    """The card and the rig that explain a recording best.

    Attributes:
        axis_distance_m: m; the errors of height and delay are in its standard error.
        speed: mean speed over that of the given angles.
        wobble: (HARMONICS, 2) cosine and sine of the angle's error over a turn, rad.
        speed_variation: RMS deviation of the speed, relative.
        mirrored: whether the marks' mirror image explains the recording, and not the marks.
        strengths: (marks,) amplitude of each reflector over that of the median one.
        unexplained: share of the changing echo's energy that is not explained, the noise subtracted.
    """

    axis_distance_m: Measured
    speed: Measured
    wobble: Floats
    speed_variation: Measured
    mirrored: bool
    strengths: Floats
    unexplained: float

    @property
    def speed_levels(self) -> Floats:
        """(HARMONICS,) RMS deviation of the speed in each harmonic of a turn, relative."""
        return _speed_levels(self.wobble)

    def speed_deviation(self, angles: Floats) -> Floats:
        """Relative deviation of the speed at angles (n,), rad."""
        orders = np.arange(1, HARMONICS + 1)
        phase = np.outer(angles, orders)
        cosine, sine = orders * self.wobble.T
        return np.asarray(np.cos(phase) @ sine - np.sin(phase) @ cosine)


def _speed_levels(wobble: Floats) -> Floats:
    orders = np.arange(1, HARMONICS + 1)
    return np.asarray(orders * np.linalg.norm(wobble, axis=1) / math.sqrt(2))


def fit_card(capture: Capture, angles: Floats, marks: Floats, known: Known) -> CardFit:
    """Fit the card, whose reflectors are at the marks (marks, 2), m, to a recording of at least one turn.

    The path delay is subtracted from the capture's ranges; its angles (views,), rad, are of constant speed,
    or as a device measured them.
    """
    few = slice(None, None, -(-len(angles) // _FIT_VIEWS))
    capture, angles = capture.select(few), angles[few]
    both = [_Data.of(capture, angles, marks * [1, side], known) for side in (1, -1)]
    starts = [(bright, x, mirrored) for mirrored in (0, 1) for bright, x in _starts(both[mirrored])]
    starts = sorted(starts, key=lambda start: -start[0])[:_STARTS]
    fits = [(_descended(both[mirrored], x), mirrored) for _, x, mirrored in starts]
    best, mirrored = min(fits, key=lambda fit: fit[0].noise)
    return _summary(both[mirrored], best, bool(mirrored))


@dataclass(frozen=True, eq=False)
class _Data:
    """Scans and what their model is made of.

    Attributes:
        scans: (views, bins) changing part, counts.
        ranges_m: (bins,) of the samples.
        angles: (views,) rad.
        marks: (marks, 2) m.
        known: as given.
        wavenumber: (frequencies,) rad/m, one-way.
        spectrum: (frequencies,) of the pulse at the first range.
    """

    scans: Floats
    ranges_m: Floats
    angles: Floats
    marks: Floats
    known: Known
    wavenumber: Floats
    spectrum: Complex

    @classmethod
    def of(cls, capture: Capture, angles: Floats, marks: Floats, known: Known) -> _Data:
        ranges, axis = capture.ranges_m, known.axis_distance_m
        inside = (ranges > axis - SEARCH_M - _BEFORE_M) & (ranges < axis + SEARCH_M + _AFTER_M)
        scans = capture.samples[:, inside].astype(np.float64)
        ranges = ranges[inside]
        step_s = 2 * capture.range_step_m / SPEED_OF_LIGHT
        length = 1 << (2 * len(ranges) + len(known.pulse.samples)).bit_length()
        offset = ((np.arange(length) + length // 2) % length - length // 2) * step_s
        spectrum = np.fft.fft(pulse_at(known.pulse, offset))[: length // 2 + 1]
        wavenumber: Floats = (
            2 * np.pi * np.arange(length // 2 + 1, dtype=np.float64) / (length * step_s * SPEED_OF_LIGHT)
        )
        return cls(_changing(scans), ranges, angles, marks, known, wavenumber, spectrum)

    @property
    def carrier(self) -> float:
        """Wavenumber of the middle of the pulse's spectrum, rad/m."""
        power = np.abs(self.spectrum) ** 2
        return float((self.wavenumber * power).sum() / power.sum())

    def changing(self, spectra: Complex) -> Floats:
        """(..., views, bins) changing part of scans of analytic spectra (..., views, frequencies)."""
        length = 2 * (len(self.wavenumber) - 1)
        padded = np.zeros((*spectra.shape[:-1], length), dtype=np.complex128)
        padded[..., : spectra.shape[-1]] = spectra
        scans = np.fft.ifft(padded, axis=-1)[..., : len(self.ranges_m)].real
        return _changing(scans)


def _changing(scans: Floats) -> Floats:
    """Scans (..., views, bins) without what is constant or drifts: the room, while the radar warms up."""
    time = np.linspace(-1, 1, scans.shape[-2])
    basis = np.stack([np.ones_like(time), time])
    basis /= np.linalg.norm(basis, axis=1, keepdims=True)
    return np.asarray(scans - basis.T @ (basis @ scans))


@dataclass(frozen=True, eq=False)
class _State:
    """Parameters of the model.

    Attributes:
        x: at the places below.
        amplitudes: (marks,) complex.
        noise: variance of a sample of the residual before the last step.
        covariance: of the parameters, then of the relative changes of the amplitudes.
    """

    x: Floats
    amplitudes: Complex
    noise: float = math.inf
    covariance: Floats | None = None


_AXIS: Final = 0
_SPEED_AT: Final = 1
_TURN: Final = 2
_CENTRE: Final = slice(3, 5)
_WOBBLE: Final = slice(5, 5 + 2 * HARMONICS)
_MARKS: Final = slice(5 + 2 * HARMONICS, None)
"""Places of the parameters: m, relative, rad, m, rad by cosine and sine of each harmonic, m."""


def _priors(data: _Data) -> tuple[Floats, Floats]:
    """Means and standard deviations of the parameters."""
    count = 5 + 2 * HARMONICS + 2 * len(data.marks)
    mean, sigma = np.zeros(count), np.full(count, _MARK_M)
    mean[_AXIS] = data.known.axis_distance_m
    sigma[[_AXIS, _SPEED_AT, _TURN]] = 1.0, _SPEED, 10.0
    sigma[_CENTRE] = _CENTRE_M
    sigma[_WOBBLE] = np.repeat(_WOBBLE_RAD / np.arange(1, HARMONICS + 1), 2)
    return mean, sigma


def _paths(data: _Data, x: Floats) -> tuple[float, Floats]:
    """(apparent range of the axis, m; ranges of the reflectors (views, marks) beyond it, m)."""
    angles = data.angles * (1 + x[_SPEED_AT])
    orders = np.arange(1, HARMONICS + 1)
    phase = np.outer(data.angles, orders)
    angles = angles + np.cos(phase) @ x[_WOBBLE][::2] + np.sin(phase) @ x[_WOBBLE][1::2]
    turn = np.array([[math.cos(x[_TURN]), -math.sin(x[_TURN])], [math.sin(x[_TURN]), math.cos(x[_TURN])]])
    points = (data.marks + x[_MARKS].reshape(-1, 2)) @ turn.T + x[_CENTRE]
    here = Aperture.turntable(angles, x[_AXIS], data.known.height.value, data.known.separation_m)
    slant = float(np.mean([np.linalg.norm(end[0]) for end in here.antennas]))
    every = np.column_stack([points, np.zeros(len(points))])
    ranges = np.mean([np.linalg.norm(end[:, None] - every[None], axis=2) for end in here.antennas], axis=0)
    return slant + data.known.delay.value, ranges - slant


def _echoes(data: _Data, axis_m: float, beyond_m: Floats) -> Complex:
    """(marks, views, frequencies) spectra of reflectors that have amplitude 1 on the axis.

    The distance of the axis turns no phase; echoes fall with the square of the range.
    """
    at = axis_m - data.ranges_m[0]
    envelope = np.exp(-2j * (data.wavenumber - data.carrier) * at) * data.spectrum
    strength = (1 + beyond_m.T[:, :, None] / axis_m) ** -2
    return np.asarray(strength * np.exp(-2j * beyond_m.T[:, :, None] * data.wavenumber) * envelope)


def _starts(data: _Data) -> list[tuple[float, Floats]]:
    """For each axis distance of the search: (how bright the marks are at the best pose, the parameters)."""
    some = slice(None, None, -(-len(data.angles) // _SEARCH_VIEWS))
    scans, angles = data.scans[some], data.angles[some]
    length = 2 * (len(data.wavenumber) - 1)
    matched = positive_spectrum(scans, length) * np.conj(data.spectrum)
    fine = np.zeros((len(scans), length * _FINER), dtype=np.complex128)
    fine[:, : matched.shape[1]] = matched
    rows = np.fft.ifft(fine, axis=1)
    step = (data.ranges_m[1] - data.ranges_m[0]) / _FINER
    side = np.arange(-_REACH_M, _REACH_M + _PIXEL_M / 2, _PIXEL_M)
    pixels = np.array([(a, b, 0.0) for a in side for b in side])
    turns = np.arange(_POSES) * 2 * np.pi / _POSES
    rotated = np.stack([
        np.outer(np.cos(turns), data.marks[:, 0]) - np.outer(np.sin(turns), data.marks[:, 1]),
        np.outer(np.sin(turns), data.marks[:, 0]) + np.outer(np.cos(turns), data.marks[:, 1]),
    ])  # fmt: skip
    mean, _ = _priors(data)
    starts = []
    for offset in np.arange(-SEARCH_M, SEARCH_M + _STEP_M / 2, _STEP_M):
        axis = data.known.axis_distance_m + offset
        here = Aperture.turntable(angles, axis, data.known.height.value, data.known.separation_m)
        geometry = RangeGeometry.of(here, pixels, (data.ranges_m[0], step), rows.shape[1])
        image = np.abs(geometry.gather(rows)).reshape(len(side), len(side))
        best = (-1.0, 0.0, 0.0, 0.0)
        for dx in _SHIFTS_M:
            for dy in _SHIFTS_M:
                a = np.rint((rotated[0] + dx + _REACH_M) / _PIXEL_M).astype(np.int64)
                b = np.rint((rotated[1] + dy + _REACH_M) / _PIXEL_M).astype(np.int64)
                bright = image[a, b].sum(axis=1)
                top = int(bright.argmax())
                best = max(best, (float(bright[top]), float(turns[top]), dx, dy))
        x = mean.copy()
        x[_AXIS], x[_TURN], x[_CENTRE] = axis, best[1], best[2:]
        starts.append((best[0], x))
    return starts


def _descended(data: _Data, x: Floats) -> _State:
    """The least residual from a start."""
    echoes = _echoes(data, *_paths(data, x))
    columns = data.changing(np.concatenate([echoes, 1j * echoes])).reshape(2 * len(data.marks), -1)
    real, imaginary = np.linalg.lstsq(columns.T, data.scans.ravel(), rcond=None)[0].reshape(2, -1)
    state = _State(x, real + 1j * imaginary)
    for _ in range(_ITERATIONS):
        state, moved = _stepped(data, state)
        if moved < _CONVERGED:
            break
    return state


def _stepped(data: _Data, state: _State) -> tuple[_State, float]:
    """(the state after a step of Gauss-Newton, its largest change over its standard error)."""
    x, amplitudes = state.x, state.amplitudes
    axis_m, beyond = _paths(data, x)
    echoes = _echoes(data, axis_m, beyond) * amplitudes[:, None, None]
    total = echoes.sum(axis=0)
    by_axis = -2j * (data.wavenumber - data.carrier) * total
    by_path = -2j * data.wavenumber * echoes
    columns = []
    for i in range(len(x)):
        there = x.copy()
        there[i] += _DIFFERENCE
        axis_there, beyond_there = _paths(data, there)
        column = by_axis * (axis_there - axis_m) / _DIFFERENCE
        # The curvature of the wavefront would tell the distance, too, but a phase centre or a mark that is
        # off by 0.01 mm moves that by several millimetres: the range of the envelope alone decides.
        if i != _AXIS:
            slope = (beyond_there - beyond) / _DIFFERENCE
            column = column + (by_path * slope.T[:, :, None]).sum(axis=0)
        columns.append(data.changing(column))
    columns += [data.changing(factor * echo) for echo in echoes for factor in (1.0, 1.0j)]
    residual = data.scans - data.changing(total)
    noise = float((residual**2).mean())
    jacobian = np.stack(columns, axis=2)
    mean, sigma = _priors(data)
    weight = np.concatenate([sigma**-2.0, np.full(2 * len(amplitudes), _FREE)])
    pull = np.concatenate([(mean - x) / sigma**2, np.zeros(2 * len(amplitudes))])
    flat = jacobian.reshape(-1, len(columns))
    inverse: Floats = np.asarray(np.linalg.inv(flat.T @ flat / noise + np.diag(weight)), dtype=np.float64)
    change = inverse @ (flat.T @ residual.ravel() / noise + pull)
    sector = np.floor(data.angles / (2 * np.pi) * _SECTORS).astype(np.int64) % _SECTORS
    covariance = _covariance(jacobian, residual, sector, noise, inverse, weight)
    relative = change[len(x) :].reshape(-1, 2).clip(-0.7, 1)
    amplitudes = amplitudes * (1 + relative[:, 0] + 1j * relative[:, 1])
    moved = float(np.abs(change[: len(x)] / np.sqrt(np.diag(inverse))[: len(x)]).max())
    limits = _limits(len(x))
    return _State(x + change[: len(x)].clip(-limits, limits), amplitudes, noise, covariance), moved


def _covariance(
    jacobian: Floats,
    residual: Floats,
    sector: NDArray[np.int64],
    noise: float,
    inverse: Floats,
    weight: Floats,
) -> Floats:
    """Covariance as the sectors of the turn differ, at least that of the noise.

    Where reflectors do not echo as the model says, neighbouring views are wrong alike (White, Econometrica
    48, 1980), and those of the same angle in every turn.
    """
    parts = [sector == number for number in range(_SECTORS)]
    scores = np.array([np.einsum("vbp,vb->p", jacobian[part], residual[part]) / noise for part in parts])
    scores -= scores.mean(axis=0)
    spread = scores.T @ scores * _SECTORS / (_SECTORS - 1) + np.diag(weight)
    larger = np.sqrt(np.maximum(np.diag(inverse @ spread @ inverse) / np.diag(inverse), 1.0))
    return np.asarray(inverse * np.outer(larger, larger))


def _limits(count: int) -> Floats:
    """Largest steps: no phase turns by more than about a radian."""
    limits = np.full(count, 2e-3)
    limits[[_AXIS, _SPEED_AT, _TURN]] = 0.008, 0.005, 0.1
    limits[_CENTRE], limits[_WOBBLE] = 0.006, 0.03
    return limits


def _summary(data: _Data, fit: _State, mirrored: bool) -> CardFit:
    assert fit.covariance is not None
    x, sigma = fit.x, np.sqrt(np.diag(fit.covariance))
    # What is measured is the slant distance.
    height = data.known.height
    by_height = height.value * height.sigma / float(x[_AXIS])
    orders = np.arange(1, HARMONICS + 1)
    wobble = x[_WOBBLE].reshape(-1, 2)
    total = float(np.linalg.norm(_speed_levels(wobble)))
    slope = np.zeros(len(sigma))
    slope[_WOBBLE] = (orders[:, None] ** 2 * wobble / (2 * max(total, 1e-9))).ravel()
    moved = _PHASE_CENTRE_M / float(np.sqrt((data.marks**2).sum(axis=1).mean()))
    variation = math.sqrt(slope @ fit.covariance @ slope + moved**2 * (slope @ slope))
    strengths = np.abs(fit.amplitudes)
    changing = float((data.scans**2).mean()) - data.known.noise**2
    return CardFit(
        Measured(float(x[_AXIS]), math.hypot(sigma[_AXIS], data.known.delay.sigma, by_height)),
        Measured(1 + float(x[_SPEED_AT]), float(sigma[_SPEED_AT])),
        wobble,
        Measured(total, variation),
        mirrored,
        strengths / float(np.median(strengths)),
        float(np.clip((fit.noise - data.known.noise**2) / max(changing, 1e-9), 0, 1)),
    )
