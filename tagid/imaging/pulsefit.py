"""The pulse estimated from the capture itself, for radars whose pulse nobody has measured.

A wrong pulse smears every method's image in range. Scene and pulse are found by turns: the sparse scene that
explains the scans under the present pulse, then the pulse that explains the scans of that scene.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture, Pulse
from tagid.geometry import ImageGrid
from tagid.imaging.autofocus import focus_axis_distance
from tagid.imaging.lengths import finest_cell_m, search_range_m
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import (
    MARGIN_WAVELENGTHS,
    Background,
    PreprocessSettings,
    assumed_pulse,
    preprocess,
    select_views,
)
from tagid.imaging.sparse import SparseSettings, sparse_amplitudes
from tagid.imaging.types import BasebandScans, PointResponse
from tagid.types import Samples
from tagid.waveform import analytic_pulse, pulse_at

Taps = NDArray[np.complex128]
Progress = Callable[[int, int], None]
"""Called with (scenes fitted, scenes at most)."""

BEFORE, AFTER = 1.7013, 5.1038
"""How far the pulse may reach before and after the assumed one, in range resolutions c / 2B: 0.15 and 0.45 m
(1 and 3 ns) for a P440, whose recorded pulses ring for 1.1 ns and have an echo at 1.6 to 2.3 ns."""

LEAST_EVIDENCE = 6.0
"""The estimate is taken where views that it has not seen speak for it by this logarithm of the ratio of
likelihoods at least (in Gaussian noise: independent samples times the log of the ratio of residuals)."""

_LEAST_VIEWS = 8
_MOST_VIEWS = 120
"""Views of the estimate: some ten numbers are found from them, and scenes cost time."""
_ROUNDS = 6
_TAP_PRIOR = 0.5
"""Standard deviation of a tap about the assumed pulse, whose one tap is 1."""
_MOST_PIXELS = 160
_SCENES = 2 * _ROUNDS + 2
"""Sparse scenes at most: two alternations, and one under each pulse to judge by."""
_LATER = SparseSettings(iterations=40, tolerance=5e-3)
"""Of every scene but the first: it begins at the one before, from which a change of the pulse moves it
little."""
_CANDIDATE_SHARE = 0.25
"""Backprojection over its maximum from which a pixel stays a candidate after the first scene."""


@dataclass(frozen=True, eq=False)
class PulseEstimate:
    """What the estimate of the pulse found.

    Attributes:
        pulse: the one to use: the estimate where it was taken, the assumed one else.
        taken: whether it is the estimate.
        assumed_residual, residual: energy of what the assumed and the estimated pulse leave unexplained of
            views that they have not seen, over the energy of those; nan where there was too little to try.
    """

    pulse: Pulse
    taken: bool
    assumed_residual: float
    residual: float


def estimate_pulse(
    capture: Capture,
    grid: ImageGrid,
    background: Background = "mean",
    focus_m: float | None = None,
    progress: Progress | None = None,
) -> PulseEstimate:
    """The received pulse, from the scans of one capture, whose angles or antenna positions, and path delay,
    are known.

    The estimate is sum_m q_m p(t - 2 m D / c): the assumed pulse p (the capture's, or the nominal one of its
    band) seen again after m range bins D of the baseband scans, q by least squares with the prior that it is
    1 at m = 0 and 0 elsewhere. So it keeps to the assumed pulse's band. What no scan can tell is fixed: the
    envelope's peak is 1 (a reflector could be stronger instead), and of all delays and phases (the axis could
    be farther, a reflector could have a phase) the one with the largest and positive correlation with the
    assumed pulse. Every fourth view is kept out; only where they speak for the estimate by `LEAST_EVIDENCE`
    is it taken, and only then made again from all views.

    The grid holds the scene. The axis distance is searched to +-`focus_m`; 0 takes it as given, None:
    `search_range_m`. Raises DataError as `preprocess`.
    """
    assumed = assumed_pulse(capture)
    resolution = capture.wave_speed_m_s / (2 * capture.bandwidth_hz)
    if focus_m is None:
        focus_m = search_range_m(capture.wavelength_m)
    margin = max(MARGIN_WAVELENGTHS * capture.wavelength_m, focus_m) + AFTER * resolution
    settings = PreprocessSettings(background, False, assumed, grid.extent, margin)
    scans = preprocess(capture, settings=settings)
    if scans.aperture.views < _LEAST_VIEWS:
        return PulseEstimate(assumed, False, float("nan"), float("nan"))
    pixels = int(
        np.clip(round(grid.extent / finest_cell_m(capture.wavelength_m)), min(16, grid.pixels), _MOST_PIXELS)
    )
    square = ImageGrid(grid.extent, pixels)
    if focus_m > 0:
        scans, _ = focus_axis_distance(scans, square, focus_m)
    scans = select_views(scans, slice(None, None, -(-scans.aperture.views // _MOST_VIEWS)))
    reach = (BEFORE * resolution, AFTER * resolution)
    problem = _Blind(scans, square, reach, background != "none", progress)
    views = np.arange(scans.aperture.views)
    unseen = views[2::4]
    seen = np.setdiff1d(views, unseen)
    start = problem.identity
    before = problem.unexplained(start, seen, unseen)
    taps = problem.alternate(start, seen)
    after = problem.unexplained(taps, seen, unseen)
    samples = scans.independent_samples * len(unseen) / len(views)
    if progress is not None:
        progress(_SCENES, _SCENES)
    if not samples * np.log(before / max(after, 1e-9)) > LEAST_EVIDENCE:
        return PulseEstimate(assumed, False, before, after)
    taps = problem.alternate(taps, views)
    delays = np.asarray(2 * problem.shifts * scans.range_step_m / scans.wave_speed_m_s, dtype=np.float64)
    return PulseEstimate(_as_pulse(assumed, taps, delays, scans.carrier_hz), True, before, after)


class _Blind:
    """Scene and taps by turns, on some of the views.

    The first scene is fitted on all pixels. The later ones are fitted on those that were bright in it or in
    backprojection, and begin at the scene before: the pulse decides how strong and how blurred a reflector
    is, not where reflectors can be.
    """

    def __init__(
        self,
        scans: BasebandScans,
        grid: ImageGrid,
        reach_m: tuple[float, float],
        removed: bool,
        progress: Progress | None,
    ) -> None:
        self.scans, self.points, self.removed, self.progress = scans, grid.points, removed, progress
        self.known: Samples | None = None
        self.scenes = 0
        first, last = (round(reach / scans.range_step_m) for reach in reach_m)
        self.shifts = np.arange(-first, last + 1)
        self.identity = np.where(self.shifts == 0, 1.0, 0.0).astype(np.complex128)

    def alternate(self, taps: Taps, views: NDArray[np.intp]) -> Taps:
        """Taps after some rounds on these views."""
        part = select_views(self.scans, views)
        for _ in range(_ROUNDS):
            taps = self._taps(part, self._scene(part, taps))
        return taps

    def unexplained(self, taps: Taps, seen: NDArray[np.intp], unseen: NDArray[np.intp]) -> float:
        """Relative residual on unseen views of the scene that the others give; its scale is left free."""
        sigma = self._scene(select_views(self.scans, seen), taps)
        part = select_views(self.scans, unseen)
        model = np.tensordot(taps, self._shifted(part, sigma), axes=1)
        energy = float(np.vdot(part.samples, part.samples).real)
        power = float(np.vdot(model, model).real)
        if energy == 0 or power == 0:
            return 1.0
        return float(1 - abs(np.vdot(model, part.samples)) ** 2 / (energy * power))

    def _scene(self, part: BasebandScans, taps: Taps) -> Samples:
        """Reflectivities (points,) of the sparse scene under the pulse of these taps."""
        now = replace(part, response=self._response(taps))
        operator = ForwardOperator(now, self.points)
        if self.known is None:
            strength = np.abs(operator.adjoint(now.samples))
            amplitudes, _ = sparse_amplitudes(now, self.points, operator=operator)
            kept = (amplitudes != 0) | (strength > _CANDIDATE_SHARE * strength.max(initial=0))
            if kept.any():
                self.points, amplitudes = self.points[kept], amplitudes[kept]
                self.known = amplitudes
        else:
            amplitudes, _ = sparse_amplitudes(now, self.points, _LATER, operator=operator, start=self.known)
            self.known = amplitudes if amplitudes.any() else self.known
        self.scenes += 1
        if self.progress is not None:
            self.progress(min(self.scenes, _SCENES), _SCENES)
        return amplitudes

    def _response(self, taps: Taps) -> PointResponse:
        """Range response of the pulse of these taps."""
        old, step = self.scans.response, self.scans.range_step_m
        reach = int(np.ceil((np.abs(self.shifts).max() * step + old.half_width_m) / old.step_m)) + 2
        offsets = np.arange(-reach, reach + 1) * old.step_m
        samples = sum(q * old(offsets - m * step) for q, m in zip(taps, self.shifts, strict=True))
        return PointResponse(np.asarray(samples, dtype=np.complex128), old.step_m)

    def _shifted(self, part: BasebandScans, sigma: Samples) -> Samples:
        """(taps, views, bins) scans of a scene under the assumed pulse, moved by every shift."""
        lit = np.flatnonzero(sigma)
        shape = (len(self.shifts), *part.samples.shape)
        if not len(lit):
            return np.zeros(shape, dtype=np.complex64)
        first, last = -int(self.shifts[0]), int(self.shifts[-1])
        bins = part.samples.shape[1]
        wide = np.zeros((len(part.samples), bins + first + last), dtype=np.complex64)
        longer = replace(part, samples=wide, range_start_m=part.range_start_m - last * part.range_step_m)
        seen = ForwardOperator(longer, self.points[lit]).forward(sigma[lit])
        if self.removed:
            seen = seen - seen.mean(axis=0)
        return np.stack([seen[:, last - m : last - m + bins] for m in self.shifts])

    def _taps(self, part: BasebandScans, sigma: Samples) -> Taps:
        """Least-squares taps with their prior; those of the assumed pulse where the scene is blank."""
        columns = self._shifted(part, sigma).reshape(len(self.shifts), -1)
        normal = (columns.conj() @ columns.T).astype(np.complex128)
        power = float(normal[-int(self.shifts[0]), -int(self.shifts[0])].real)
        if power == 0:
            return self.identity
        data = part.samples.ravel()
        match = (columns.conj() @ data).astype(np.complex128)
        # The sparse scene is too weak and its phase is free: the prior is for taps relative to the first.
        scale = match[-int(self.shifts[0])] / power
        match = match / scale - normal @ self.identity
        oversampled = max(1.0, part.samples.size / max(part.independent_samples, 1.0))
        residual = float(np.vdot(data, data).real) / abs(scale) ** 2 - power
        ridge = max(residual, 1e-3 * power) / data.size * oversampled / _TAP_PRIOR**2
        change = np.linalg.solve(normal + ridge * np.eye(len(normal)), match)
        return np.asarray(self.identity + change, dtype=np.complex128)


def _as_pulse(assumed: Pulse, taps: Taps, delays: NDArray[np.float64], carrier_hz: float) -> Pulse:
    """sum_m q_m p(t - delay_m) with the delay, phase and scale of the convention."""
    reach = len(assumed.samples) // 2 + int(np.ceil(2 * float(np.abs(delays).max()) / assumed.step))
    time = np.arange(-reach, reach + 1) * assumed.step
    z = np.zeros(len(time), dtype=np.complex128)
    for q, delay in zip(taps, delays, strict=True):
        z += q * np.exp(2j * np.pi * carrier_hz * delay) * pulse_at(assumed, time - delay)
    reference = pulse_at(assumed, time)
    n = 2 * len(time)
    match = np.fft.ifft(np.fft.fft(z, n) * np.fft.fft(reference, n).conj())
    lag = int(np.argmax(np.abs(match)))
    phase = np.exp(-1j * np.angle(match[lag]))
    moved = np.roll(np.concatenate([z, np.zeros(n - len(time))]), -lag)[: len(time)]
    real = (moved * phase).real
    return Pulse(real / np.abs(analytic_pulse(Pulse(real, assumed.step), 4)).max(), assumed.step)
