"""Analysis through synthesis: fit a neural field until its synthesized scans equal the measured ones.

One field is fitted per scene, without any training data; what it cannot know it takes from the sparsity prior
and from the smoothness of the encoding.

Model of the "field" preset: sigma(p) = network(grid features at p), synthesized scan
y[v, b] = gain_v sum_p T_vp sigma_p response(R_b - d_vp) exp(-2jk d_vp) + static_b, where T is the light of
spreading and beam, and the loss is the Huber sum of |y - measured|^2 with sum |sigma|.
"""

from __future__ import annotations

import importlib.util
import math
import time
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError, MissingExtraError, UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.ats import calibration
from tagid.imaging.ats.calibration import Unknowns, illumination
from tagid.imaging.ats.problem import (
    Array,
    FieldShape,
    FieldWeights,
    FineRange,
    FirstImages,
    GridArrays,
    ViewArrays,
    draw_weights,
    view_arrays,
    view_subsets,
)
from tagid.imaging.ats.settings import (
    DECAY,
    FEATURES,
    LEARNING_RATE,
    LEAST_HELD_OUT,
    LEVELS,
    THREADS,
    WIDTH,
    WOBBLE_HARMONICS,
    AtsSettings,
    FieldPrior,
    FitSettings,
    StepProgress,
)
from tagid.imaging.ats.taps import BETA1, BETA2, CHECK_AT, EPSILON, first_support, next_support
from tagid.imaging.heldout import Prediction
from tagid.imaging.kernel import is_compiled
from tagid.imaging.memory import require_memory
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import select_views
from tagid.imaging.sparse import column_norm
from tagid.imaging.types import BasebandScans, Image
from tagid.types import Samples

_CALIBRATED_WAVELENGTHS = 0.79
"""Range that the calibration may move points by: one and a half times the search for the axis distance (60 mm
for a P440)."""

_LEARN_AT = (0.25, 0.4, 0.55, 0.7, 0.85)
"""Parts of the steps after which calibration and robust weights are brought up to date."""

MEAN_OVER = 0.3
"""Part of the steps, at the end, whose mean is the result: it is smoother than any of them, and the rounding
of an engine shows less in it."""

MEAN_EVERY = 3
"""Every so many of them are in the mean: neighbouring steps hardly differ."""

_MOST_SHRUNK = 2.0
"""The weight of the sparsity prior is at most half of what gives a blank image."""


class Engine(Protocol):
    """What runs the steps: `fit_native.NativeEngine` or `OnnxEngine`, or `fit_torch.TorchEngine`."""

    name: str

    def step(self, grid: GridArrays, views: ViewArrays, fine: FineRange, numbers: Array) -> float:
        """One step of Adam on some views; the loss before it."""

    def weights(self) -> FieldWeights:
        """The parameters as they are now."""


@dataclass(frozen=True, eq=False)
class AtsResult:
    """What a fit gives.

    Attributes:
        image: complex reflectivity on the grid asked for.
        calibration: what was learned beside the scene.
        unseen: (n,) numbers of the views that the fit did not see.
        prediction: what it predicts of them.
        seconds: of the whole fit, set-up included.
        field: the fitted field; None for blank data and where the linear solution took its place.
    """

    image: Image
    losses: tuple[float, ...]
    calibration: Unknowns
    unseen: NDArray[np.integer]
    prediction: Prediction
    seconds: float
    field: FieldWeights | None = field(default=None, repr=False)

    @property
    def held_out(self) -> float:
        """Energy of the residual on the unseen views over their energy, one complex factor fitted; nan
        without any."""
        return self.prediction.residual


def fit(
    scans: BasebandScans,
    grid: ImageGrid,
    settings: AtsSettings | None = None,
    progress: StepProgress | None = None,
    unseen: NDArray[np.integer] | None = None,
    start: FieldWeights | None = None,
    images: FirstImages | None = None,
) -> AtsResult:
    """Reconstruct by analysis through synthesis.

    Args:
        scans: preprocessed, best without matched filter.
        settings: parameters; the defaults are for 12 to 360 views of an object of up to a metre.
        progress: called after every step.
        unseen: numbers of the views that the fit does not see and on which it is judged; None: as
            `FitSettings.held_out` says.
        start: field to begin with, of an earlier fit on this grid with the same sizes of the network; None
            begins with the sparse solution.
        images: first images of other fits of these scans on this grid with other priors, to share them.

    Returns:
        Image in the units of the scans, with how it came about. Scans that are all zero give a zero image.

    Raises:
        DataError: samples are not finite.
        UsageError: settings that exclude each other, or sizes that do not fit into memory.
        MissingExtraError: the engine asked for is not installed.
    """
    if not np.isfinite(scans.samples).all():
        raise DataError("the scans hold samples that are not finite", "Leave out the broken scans.")
    plan = FitSettings.of(settings or AtsSettings()).for_views(scans.aperture.views)
    return _Fit(scans, grid, plan, unseen).run(progress, images or FirstImages(), start)


def unshrinking(seen: NDArray[np.complexfloating], data: NDArray[np.complexfloating]) -> float:
    """The factor, 1 to 2, by which the scans that a sparse scene predicts explain the data best.

    Both are (views, bins). The sparsity prior made the scene too dark.
    """
    energy = float(np.vdot(seen, seen).real)
    factor = float(np.vdot(seen, data).real) / energy if energy > 0 else 1.0
    return float(np.clip(factor, 1.0, _MOST_SHRUNK))


@dataclass(frozen=True)
class _Scales:
    """What makes the loss dimensionless: energy of the data, size of the output, weights of the priors.

    `step` is the factor by which backprojection explains the data best, `weight` that of the sparsity prior
    beside 1/2 ||A sigma - y||^2, and `back` the magnitude of A^H y, (pixels, pixels).
    """

    energy: float
    step: float
    output: float
    weight: float
    back: NDArray[np.float32]


class _Fit:
    def __init__(
        self, scans: BasebandScans, grid: ImageGrid, settings: FitSettings, unseen: NDArray[np.integer] | None
    ) -> None:
        self.begun = time.perf_counter()
        self.grid, self.settings, self.all = grid, settings, scans
        _foresee(scans, grid, settings)
        views = np.arange(scans.aperture.views)
        self.unseen = _held_out(len(views), settings.held_out) if unseen is None else unseen
        self.scans = select_views(scans, np.setdiff1d(views, self.unseen))
        # The subtracted background is known except for the mean of the scene's own echoes.
        self.what = settings.calibrate + (("static",) if scans.background_removed else ())
        self.known = calibration.begin(self.scans, grid, settings.calibrate, WOBBLE_HARMONICS)
        self.confidence: NDArray[np.floating] = np.ones(self.scans.samples.shape, dtype=np.float32)
        self.light = self._light(self.scans)
        self.support: NDArray[np.bool_] = np.ones((grid.pixels, grid.pixels), dtype=bool)
        self._made: tuple[tuple[float, bytes], tuple[ForwardOperator, ForwardOperator]] | None = None
        self.losses: list[float] = []

    def run(
        self, progress: StepProgress | None, images: FirstImages, start: FieldWeights | None
    ) -> AtsResult:
        now = self.scans.with_aperture(self.known.aperture(self.scans.aperture))
        scales = _scales(now, self._operators()[0], self.settings)
        shape = FieldShape.of(self.grid, self.scans.wavelength_m)
        if scales is None:
            return self._result(None, "none")
        if start is None:
            made = images.of(now, self.unseen, self.grid, shape.cells[-1], scales.step)
            first = np.asarray(made / scales.output, dtype=np.complex64)
            start = draw_weights(shape, self.grid, scales.output, self.settings.seed, first)
            if self._screened():
                self.support = first_support(scales.back, np.abs(start.image()), scales.weight)
        else:
            _check_continues(start, draw_weights(shape, self.grid, start.scale, self.settings.seed))
            scales = replace(scales, output=start.scale)
            # What the earlier fit left out is zero, whatever its network gives there.
            if self._screened() and start.support is not None:
                self.support = start.support
        engine = make_engine(start, self.settings)
        return self._result(self._optimise(engine, scales, shape.cells, progress), engine.name)

    def _optimise(
        self, engine: Engine, scales: _Scales, cells: tuple[int, ...], progress: StepProgress | None
    ) -> FieldWeights:
        """All steps; the mean field over the last of them."""
        steps = self.settings.steps
        native = engine.name == "native"
        fine = FineRange.of(self.all, self.grid.points, self._margin(), between=native)
        every = GridArrays.of(self.grid, cells)
        learn = {int(part * steps) for part in _LEARN_AT} if self._learns() else set()
        check = {max(1, int(part * steps)) for part in CHECK_AT} if self._screened() else set()
        grid = replace(every, pixels=self._pixels())
        subsets = self._subsets(fine, native)
        total: list[Array] = []
        count = 0
        for step in range(steps):
            views = subsets[step % len(subsets)]
            numbers = self._numbers(scales, step, views.aperture.views)
            self.losses.append(engine.step(grid, views, fine, numbers))
            if progress is not None:
                progress(step + 1, steps, self.losses[-1])
            if step + 1 in learn:
                self._learn(engine.weights(), late=step + 1 >= steps / 2)
                count = 0
            if step + 1 in check:
                self._screen(engine.weights(), scales.weight)
                grid = replace(every, pixels=self._pixels())
            if step + 1 in learn | check:
                subsets = self._subsets(fine, native)
            if step + 1 > steps * (1 - MEAN_OVER) and (steps - 1 - step) % MEAN_EVERY == 0:
                now = engine.weights().arrays
                total = [a + b for a, b in zip(total, now, strict=True)] if count else now
                count += 1
        field = engine.weights()
        if count:
            field = field.with_arrays([a / np.float32(count) for a in total])
        return self._unshrunk(replace(field, support=self.support))

    def _unshrunk(self, field: FieldWeights) -> FieldWeights:
        """The field times the one factor that explains the scans best: the prior made it too dark."""
        data = self.scans.samples - self.known.static
        seen = self._seen(field.image(), True)
        return replace(field, scale=field.scale * unshrinking(seen, data))

    def _numbers(self, scales: _Scales, step: int, views: int) -> Array:
        """The step's scalars in the order of `fit_torch.Step.numbers`."""
        rate = LEARNING_RATE * DECAY ** (step / self.settings.steps)
        data = self.scans.aperture.views / views / scales.energy
        corrections = (1 / (1 - BETA1 ** (step + 1)), 1 / (1 - BETA2 ** (step + 1)))
        numbers = (rate, *corrections, scales.output, data, 2 * scales.weight / scales.energy, EPSILON)
        return np.array(numbers, dtype=np.float32)

    def _pixels(self) -> NDArray[np.intp] | None:
        """Row-major numbers of the pixels of the support; None where they are all."""
        return None if self.support.all() else np.flatnonzero(self.support)

    def _screened(self) -> bool:
        """Whether dark pixels may be left out: their residual counts all points alike."""
        return self.light is None

    def _screen(self, field: FieldWeights, weight: float) -> None:
        """Choose the pixels again, by the residual of all views under the present field."""
        values = replace(field, support=self.support).image()
        rest = self.scans.samples - self.known.static - self._seen(values, True)
        back = self._operators()[0].adjoint(self._factors(True).conj()[:, None] * rest)
        self.support = next_support(np.abs(values), np.abs(back).reshape(values.shape), weight)

    def _operators(self) -> tuple[ForwardOperator, ForwardOperator]:
        """Operators of the views that are fitted and of the others, under the present calibration."""
        key = (self.known.offset_m, self.known.wobble.tobytes())
        if self._made is None or self._made[0] != key:
            aperture = self.known.aperture(self.all.aperture)
            whole = ForwardOperator(self.all.with_aperture(aperture), self.grid)
            fitted = np.setdiff1d(np.arange(whole.views), self.unseen)
            self._made = key, (whole.select(fitted), whole.select(self.unseen))
        return self._made[1]

    def _factors(self, fitted: bool) -> NDArray[np.complex128]:
        """(views,) what the calibration multiplies scans with; their gain is known where they were fitted."""
        phase = self.known.phase(self.scans.wavenumber)
        return np.asarray(phase * self.known.gain if fitted else np.full(len(self.unseen), phase))

    def _subsets(self, fine: FineRange, native: bool) -> list[ViewArrays]:
        """Interleaved subsets of the views under the present calibration.

        For the native engine they hold the pixels of the support only; the graph takes all.
        """
        aperture = self.known.aperture(self.scans.aperture)
        data = np.asarray(self.scans.samples - self.known.static, dtype=np.complex64)
        now = replace(self.scans, samples=data, aperture=aperture)
        points, some = self.grid.points, self._pixels()
        if native and some is not None:
            points = points[some]
        arrays = view_arrays(now, points, fine, self.confidence, self._factors(True), self.light)
        return [arrays.select(views) for views in view_subsets(aperture, self.settings.views_per_step)]

    def _learns(self) -> bool:
        s = self.settings
        return bool(self.what) or s.robust > 0

    def _margin(self) -> float:
        """Range that the calibration may move the points by, m."""
        moves = {"axis", "wobble"} & set(self.settings.calibrate)
        return _CALIBRATED_WAVELENGTHS * self.scans.wavelength_m if moves else 0.0

    def _learn(self, field: FieldWeights, late: bool) -> None:
        """Bring calibration and, once the scene stands, the weights of the samples up to date."""
        values = replace(field, support=self.support).image()
        # Half a scene would draw the geometry away from where the sparse scenes have put it.
        what = self.what if late else tuple(w for w in self.what if w not in ("axis", "wobble"))
        if what:
            points = self.grid.points
            self.known = calibration.improve(self.scans, points, values.ravel(), self.known, what)
        if self.settings.robust > 0 and late:
            residual = np.abs(self.scans.samples - self._seen(values, True) - self.known.static)
            sigma = max(self.scans.noise_std, float(np.median(residual)) / np.sqrt(np.log(2)), 1e-30)
            self.confidence = np.minimum(1, self.settings.robust * sigma / np.maximum(residual, 1e-30))

    def _light(self, scans: BasebandScans) -> NDArray[np.float32] | None:
        """Spreading and beam (views, points); None if the settings have neither."""
        s = self.settings
        if s.spreading == 0 and s.beam_width_deg == 0:
            return None
        positions = scans.aperture.positions
        return illumination(self.grid.points, positions, s.spreading, float(np.deg2rad(s.beam_width_deg)))

    def _seen(self, values: Samples, fitted: bool) -> Samples:
        """Synthesized scans of the field (pixels, pixels) in the views that were fitted, or in the others."""
        bright = values.ravel() != 0
        operator, flat = self._operators()[0 if fitted else 1].among(bright), values.ravel()[bright]
        light = self.light if fitted else self._light(select_views(self.all, self.unseen))
        if light is None:
            seen = operator.forward(flat)
        else:
            seen = operator.forward_by_view(flat * row for row in light[:, bright])
        return np.asarray(seen * self._factors(fitted)[:, None], dtype=np.complex64)

    def _result(self, field: FieldWeights | None, engine: str) -> AtsResult:
        """Of a field; None: a blank image."""
        blank = np.zeros((self.grid.pixels, self.grid.pixels), dtype=np.complex64)
        values = blank if field is None else field.image()
        prediction = Prediction.none()
        if len(self.unseen):
            data = self.all.samples[self.unseen] - self.known.static
            seen = np.zeros_like(data) if field is None else self._seen(values, False)
            prediction = Prediction.of(data, seen)
        nominal, held_out = self.all.aperture.axis_distance, prediction.residual
        distance_m = None if nominal is None else nominal + self.known.offset_m
        facts: dict[str, Any] = {
            "method": "ats",
            **self.settings.facts(),
            "engine": engine,
            "axis_distance_m": distance_m,
            "calibration": self.known.facts(distance_m, self.settings.calibrate),
            "steps_done": len(self.losses),
            "loss": self.losses[-1] if self.losses else 0.0,
            "held_out_residual": None if np.isnan(held_out) else held_out,
        }
        image = Image(values, self.grid, facts)
        seconds = time.perf_counter() - self.begun
        return AtsResult(image, tuple(self.losses), self.known, self.unseen, prediction, seconds, field)


SHARPENED = 3.0
"""How much brighter a point gets than backprojection shows it, once it is sharp: the output's scale."""


def make_engine(start: FieldWeights, settings: AtsSettings) -> Engine:
    """The engine that the settings ask for. Raises MissingExtraError: it is not installed. UsageError: it
    cannot do what is asked, or the device is not there.
    """
    name = settings.engine
    if name == "auto" and settings.device == "cpu" and is_compiled():
        name = "native"
    elif name == "auto":
        name = "onnx" if settings.device == "cpu" and importlib.util.find_spec("onnxruntime") else "torch"
    if name == "native":
        from tagid.imaging.ats.fit_native import NativeEngine

        return NativeEngine(start)
    if importlib.util.find_spec("torch" if name == "torch" else "onnxruntime") is None:
        raise MissingExtraError(
            f"ATS with `engine={name}` needs {'torch' if name == 'torch' else 'onnxruntime'}, "
            "which is not installed",
            "Install it with `pip install 'tagid[ats]'`." if name == "torch" else "Install tagid again.",
        )
    if name == "onnx":
        from tagid.imaging.ats.fit_native import OnnxEngine

        return OnnxEngine(start, THREADS)
    from tagid.imaging.ats.fit_torch import TorchEngine

    return TorchEngine(start, settings.device, THREADS)


def _check_continues(start: FieldWeights, new: FieldWeights) -> None:
    """Raise UsageError unless two fields have the same sizes."""
    sizes = [[a.shape for a in (*network.tables, *network.weights)] for network in (start, new)]
    if sizes[0] != sizes[1] or (start.extent, start.pixels) != (new.extent, new.pixels):
        raise UsageError(
            "the field to begin with was fitted on another grid or with other sizes",
            "Begin without it, or with the settings of its own fit.",
        )


def _foresee(scans: BasebandScans, grid: ImageGrid, settings: FitSettings) -> None:
    """Refuse sizes that will not fit before anything is allocated."""
    points = grid.pixels**2
    views = 2 * max(map(len, view_subsets(scans.aperture, settings.views_per_step)))
    per_pair = 8 + 4 * 6
    per_point = 4 * (6 * WIDTH + 4 * LEVELS * FEATURES) + 8 * 6
    light = 8 * scans.aperture.views * points if settings.spreading or settings.beam_width_deg else 0
    require_memory(
        points * (views * per_pair + per_point + 8 * scans.aperture.views) + light,
        f"steps of {views} views and {grid.pixels} x {grid.pixels} pixels",
        "Use fewer pixels (`imaging.pixels`), or fewer views a step.",
    )


def _held_out(views: int, share: float) -> NDArray[np.intp]:
    """Views that the fit does not see, spread over the turn."""
    count = max(1, round(views * share)) if share > 0 and views >= LEAST_HELD_OUT else 0
    return np.asarray((np.arange(count) + 0.5) * views / max(count, 1), dtype=np.intp)


def sparsity_weight(scans: BasebandScans, peak: float, prior: FieldPrior | FitSettings) -> float:
    """Weight of the sparsity prior beside 1/2 ||A sigma - y||^2 where |A^H y| is `peak` at most."""
    floor = prior.noise_factor * scans.noise_std * column_norm(scans)
    return min(max(prior.l1 * peak, floor), 0.5 * peak)


def _scales(scans: BasebandScans, operator: ForwardOperator, settings: FitSettings) -> _Scales | None:
    """Scales and weights; None if nothing is to be fitted (zero data, or none within the grid's reach)."""
    data = np.ascontiguousarray(scans.samples, dtype=np.complex64)
    back = operator.adjoint(data)
    energy = float(np.vdot(data, data).real)
    peak = float(np.abs(back).max(initial=0.0))
    if energy == 0 or peak == 0:
        return None
    seen = operator.forward(back)
    step = float(np.vdot(seen, data).real / np.vdot(seen, seen).real)
    weight = sparsity_weight(scans, peak, settings)
    side = math.isqrt(operator.points)
    magnitude = np.abs(back).reshape(side, side)
    return _Scales(energy, step, SHARPENED * step * peak, weight, magnitude)
