"""Analysis through synthesis in three dimensions: a neural field on a 3-D grid, fitted to scans of several
heights.

The field starts as the backprojection, and only voxels that this shows bright are fitted, so that time and
memory follow the object and not the volume. The model is that of `tagid.imaging.ats.fit` without calibration:
sigma(p) = network(grid features at p), y = A sigma, loss = |y - measured|^2 / |measured|^2 + l sum |sigma|.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.geometry import VolumeGrid
from tagid.imaging.ats.fit import MEAN_OVER, SHARPENED, sparsity_weight, unshrinking
from tagid.imaging.ats.problem import MAGNITUDE_FLOOR, TABLE_INIT, Array, carry, uniform
from tagid.imaging.ats.settings import DECAY, LEARNING_RATE, FieldPrior
from tagid.imaging.ats.taps import BETA1, BETA2, EPSILON, SMALLEST
from tagid.imaging.lengths import finest_cell_m
from tagid.imaging.memory import require_memory
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.types import BasebandScans
from tagid.imaging.volume import Volume, backproject_volume, part_of, vertical_resolution_m
from tagid.types import Progress

_CELLS_PER_RESOLUTION = 2.0
"""Cells of the finest level per vertical resolution, as in the plane per null radius of the point
response."""
_SAMPLE_VIEWS = 1500
"""Views from which scales and the first image are computed; more would not change them."""
_SEED_SHARE = 0.35
"""Part of the progress that the backprojection takes."""

STEPS = 80
_VIEWS_PER_STEP = 400
"""Most views of one step."""
_LEVELS, _FEATURES, _COARSEST, _WIDTH = 6, 2, 6, 16
"""Resolutions of the grid, features of each, cells a side of the coarsest, units of the hidden layer."""
_ACTIVE_SHARE = 0.1
"""Voxels under this share of the backprojection's maximum stay zero."""
MOST_ACTIVE = 200_000
"""Most voxels that are fitted, the brightest ones."""
_SEED = 0
"""Of the initial weights and of the order of the views."""


def fit_volume(
    matched: BasebandScans,
    scans: BasebandScans,
    grid: VolumeGrid,
    progress: Progress | None = None,
    steps: int = STEPS,
) -> Volume:
    """Reconstruct a volume by analysis through synthesis of `scans`; their matched-filtered ones give the
    backprojection that seeds the fit.

    Raises UsageError: the volume or the fit would not fit into memory.
    """
    first = backproject_volume(matched, grid, part_of(progress, 0, _SEED_SHARE))
    bright = np.abs(first.values).ravel()
    values, facts = _Fit(scans, grid, steps, bright).run(part_of(progress, _SEED_SHARE, 1))
    shape = (grid.levels, grid.square.pixels, grid.square.pixels)
    fixed = {
        "learning_rate": LEARNING_RATE, "decay": DECAY, "l1": FieldPrior.l1,
        "noise_factor": FieldPrior.noise_factor, "views_per_step": _VIEWS_PER_STEP,
        "active_share": _ACTIVE_SHARE, "most_active": MOST_ACTIVE, "levels": _LEVELS, "features": _FEATURES,
        "coarsest": _COARSEST, "width": _WIDTH, "seed": _SEED,
    }  # fmt: skip
    return Volume(values.reshape(shape), grid, {"method": "ats", "steps": steps, **fixed, **facts})


class _Fit:
    """`bright`: (voxels,) magnitude of the backprojection."""

    def __init__(
        self, scans: BasebandScans, grid: VolumeGrid, steps: int, bright: NDArray[np.floating]
    ) -> None:
        self.scans, self.grid, self.steps = scans, grid, steps
        self.active = _active(bright)
        per_voxel = 4 * (8 * 2 * _LEVELS + 6 * _WIDTH + 4 * _LEVELS * _FEATURES)
        require_memory(
            per_voxel * len(self.active) + 16 * grid.voxels,
            f"fits of {len(self.active):,} voxels",
            "Use fewer pixels (`imaging.pixels`) or levels (`levels`).",
        )
        rng = np.random.default_rng(_SEED)
        views = scans.aperture.views
        self.order = rng.permutation(views)
        self.sample = np.sort(self.order[: min(views, _SAMPLE_VIEWS)])

    def run(self, progress: Progress) -> tuple[NDArray[np.complex64], dict[str, float]]:
        """(voxels,) complex64 values, and the facts of the fit."""
        out = np.zeros(self.grid.voxels, dtype=np.complex64)
        energy = float(np.vdot(self.scans.samples, self.scans.samples).real)
        if not len(self.active) or energy == 0:
            return out, {"steps_done": 0, "active_voxels": 0}
        points = _points(self.grid, self.active)
        operator = ForwardOperator(self.scans, points)
        whole = self.scans.aperture.views / len(self.sample)
        some, data = operator.select(self.sample), self.scans.samples[self.sample]
        back = some.adjoint(data) * np.float32(whole)
        peak = float(np.abs(back).max())
        seen = some.forward(back)
        step = float(np.vdot(seen, data).real / max(float(np.vdot(seen, seen).real), 1e-300))
        weight = sparsity_weight(self.scans, peak, FieldPrior())
        scale = SHARPENED * step * peak
        field = self._field(scale, step, whole)
        mean, losses = self._optimise(field, operator, energy, 2 * weight / energy, progress)
        sigma = mean.evaluate(mean.layers()[-1])
        seen = some.forward(sigma)
        out[self.active] = sigma * np.float32(unshrinking(seen, data))
        return out, {"steps_done": len(losses), "active_voxels": len(self.active), "loss": losses[-1]}

    def _field(self, scale: float, step: float, whole: float) -> Field:
        """The field that carries the backprojection."""
        grid = self.grid
        cells = _cells(self.scans, grid)
        axes = [_axes(grid, cell) for cell in cells]
        vertices = np.stack([part.ravel() for part in np.meshgrid(*axes[-1][::-1], indexing="ij")], axis=1)
        some = ForwardOperator(self.scans, vertices[:, ::-1]).select(self.sample)
        back = some.adjoint(self.scans.samples[self.sample])
        first = back * np.complex64(step * whole / scale)
        points = _points(grid, self.active)
        at = [Interpolation.of(points, axis) for axis in axes]
        return Field.carrying(first, at, scale)

    def _optimise(
        self, field: Field, operator: ForwardOperator, energy: float, sparsity: float, progress: Progress
    ) -> tuple[Field, list[float]]:
        """All steps; the mean field over the last of them, and the losses."""
        views = self.scans.aperture.views
        count = min(_VIEWS_PER_STEP, views)
        stride = max(1, round(views / count))
        mean, since, losses = field, 0, list[float]()
        for step in range(self.steps):
            chosen = np.sort(self.order[step % stride :: stride])
            data = self.scans.samples[chosen]
            some = operator.select(chosen)
            layers = field.layers()
            sigma = field.evaluate(layers[-1])
            residual = some.forward(sigma) - data
            share = views / len(chosen) / energy
            magnitude = np.sqrt(np.abs(sigma) ** 2 + np.float32((field.scale * MAGNITUDE_FLOOR) ** 2))
            losses.append(share * float(np.vdot(residual, residual).real) + sparsity * float(magnitude.sum()))
            slope = np.float32(2 * share) * some.adjoint(residual) + np.float32(sparsity) * sigma / magnitude
            rate = LEARNING_RATE * DECAY ** (step / self.steps)
            field.descend(layers, slope, rate, step + 1)
            if step + 1 > self.steps * (1 - MEAN_OVER):
                since += 1
                mean = (field if since == 1 else mean).mixed(field, 1 / since)
            progress(step + 1, self.steps, "")
        return (mean if since else field), losses


@dataclass(frozen=True, eq=False)
class Interpolation:
    """Trilinear interpolation of a grid's vertices at many points.

    Attributes:
        index: (points, 8) numbers of the vertices about each point, in (z, y, x) order.
        weight: (points, 8) float32 their weights.
    """

    index: NDArray[np.int32]
    weight: Array
    vertices: int

    @classmethod
    def of(cls, points: NDArray[np.float64], axes: tuple[NDArray[np.float64], ...]) -> Interpolation:
        """At points (n, 3), m, of a grid with these vertices along x, y and z, m."""
        corners, parts = [], []
        for axis, along in zip(axes, points.T, strict=True):
            place = np.clip((along - axis[0]) / (axis[1] - axis[0]), 0, len(axis) - 1)
            corner = np.minimum(place.astype(np.int32), len(axis) - 2)
            corners.append(corner)
            parts.append((place - corner).astype(np.float32))
        across, along_y, up = (len(axis) for axis in axes)
        index = np.empty((len(points), 8), dtype=np.int32)
        weight = np.empty((len(points), 8), dtype=np.float32)
        for number, steps in enumerate(itertools.product((0, 1), repeat=3)):
            x, y, z = (corner + step for corner, step in zip(corners, steps, strict=True))
            index[:, number] = (z * along_y + y) * across + x
            shares = [part if step else 1 - part for part, step in zip(parts, steps, strict=True)]
            weight[:, number] = shares[0] * shares[1] * shares[2]
        return cls(index, weight, across * along_y * up)

    def read(self, table: Array) -> Array:
        """(features, points) of a table (features, vertices)."""
        out = np.zeros((len(table), len(self.index)), dtype=np.float32)
        for number in range(self.index.shape[1]):
            out += table.take(self.index[:, number], axis=1) * self.weight[:, number]
        return out

    def spread(self, values: Array) -> Array:
        """(features, vertices), the transpose of `read` of values (features, points)."""
        where = self.index.ravel()
        rows = [np.bincount(where, (self.weight * row[:, None]).ravel(), self.vertices) for row in values]
        return np.asarray(rows, dtype=np.float32)


class Field:
    """A network over features on grids of several resolutions, at the active voxels.

    Args:
        parameters: one (features, vertices) table per level, (out, in) and (out, 1) of both layers.
        at: interpolation of every level.
        scale: factor of the output.
    """

    def __init__(self, parameters: list[Array], at: list[Interpolation], scale: float) -> None:
        self.parameters, self.at, self.scale = parameters, at, scale
        self._first = [np.zeros_like(parameter) for parameter in parameters]
        self._second = [np.zeros_like(parameter) for parameter in parameters]

    @classmethod
    def carrying(cls, first: NDArray[np.complexfloating], at: list[Interpolation], scale: float) -> Field:
        """A field whose output is a first image, beside random features: (vertices,) of the finest level,
        relative to the scale."""
        rng = np.random.default_rng(_SEED)
        tables = [uniform(rng, TABLE_INIT, _FEATURES, level.vertices) for level in at]
        inputs = _FEATURES * len(at)
        weights = [uniform(rng, inputs**-0.5, _WIDTH, inputs), uniform(rng, _WIDTH**-0.5, 2, _WIDTH)]
        biases = [uniform(rng, inputs**-0.5, _WIDTH, 1), np.zeros((2, 1), np.float32)]
        carry(first, tables, weights, biases)
        return cls([*tables, *weights, *biases], at, scale)

    def layers(self) -> list[Array]:
        """Features, hidden layer and output, each (units, voxels)."""
        *tables, hidden, output, bias, last_bias = self.parameters
        features = np.concatenate([at.read(table) for at, table in zip(self.at, tables, strict=True)])
        middle = np.maximum(hidden @ features + bias, 0)
        return [features, middle, output @ middle + last_bias]

    def evaluate(self, output: Array) -> NDArray[np.complex64]:
        """(voxels,) reflectivity of the network's output (2, voxels)."""
        return np.asarray((output[0] + 1j * output[1]) * np.float32(self.scale), dtype=np.complex64)

    def descend(
        self, layers: list[Array], slope: NDArray[np.complexfloating], rate: float, step: int
    ) -> None:
        """One step of Adam along the gradient by the reflectivity (voxels,), a complex number re + j im."""
        hidden, output = self.parameters[-4:-2]
        by_output = np.stack([slope.real, slope.imag]).astype(np.float32) * np.float32(self.scale)
        by_middle = (output.T @ by_output) * (layers[1] > 0)
        by_features = hidden.T @ by_middle
        count = len(by_features) // len(self.at)
        gradients: list[Any] = [
            at.spread(by_features[level * count : (level + 1) * count]) for level, at in enumerate(self.at)
        ]
        gradients += [by_middle @ layers[0].T, by_output @ layers[1].T]
        gradients += [by_middle.sum(axis=1, keepdims=True), by_output.sum(axis=1, keepdims=True)]
        moved = zip(self.parameters, gradients, self._first, self._second, strict=True)
        for parameter, gradient, first, second in moved:
            first += np.float32(1 - BETA1) * (gradient - first)
            second += np.float32(1 - BETA2) * (gradient * gradient - second)
            size = np.sqrt(second / np.float32(1 - BETA2**step))
            ahead = np.float32(rate / (1 - BETA1**step)) * first
            parameter -= ahead / (size + np.float32(EPSILON) * size.max() + np.float32(SMALLEST))

    def mixed(self, other: Field, share: float) -> Field:
        """Parameters (1 - share) of this field and share of the other's."""
        pairs = zip(self.parameters, other.parameters, strict=True)
        mixed: list[Any] = [a + np.float32(share) * (b - a) for a, b in pairs]
        return Field(mixed, self.at, self.scale)


def _active(bright: NDArray[np.floating]) -> NDArray[np.intp]:
    """Numbers of the voxels that are fitted, rising."""
    top = float(bright.max(initial=0.0))
    if top == 0:
        return np.zeros(0, dtype=np.intp)
    active = np.flatnonzero(bright >= _ACTIVE_SHARE * top)
    if len(active) > MOST_ACTIVE:
        order = np.argpartition(bright[active], len(active) - MOST_ACTIVE)
        active = np.sort(active[order[-MOST_ACTIVE:]])
    return np.asarray(active, dtype=np.intp)


def _points(grid: VolumeGrid, voxels: NDArray[np.intp]) -> NDArray[np.float64]:
    """(n, 3) centres of some voxels, m."""
    level, row, column = np.unravel_index(voxels, (grid.levels, grid.square.pixels, grid.square.pixels))
    axis = grid.square.axis
    return np.column_stack([axis[column], axis[row], grid.heights[level]])


def _cells(scans: BasebandScans, grid: VolumeGrid) -> list[tuple[int, int]]:
    """(cells across, cells upwards) of every level, coarse to fine: half a resolution at the finest."""
    across = max(1, min(grid.square.pixels, round(grid.square.extent / finest_cell_m(scans.wavelength_m))))
    rise = (grid.top - grid.bottom) * _CELLS_PER_RESOLUTION / vertical_resolution_m(scans)
    up = int(np.clip(round(rise), 1, grid.levels))
    series = np.geomspace(min(_COARSEST, across), across, _LEVELS)
    return [(int(n), max(1, round(up * n / across))) for n in np.floor(series + 1e-9)]


def _axes(grid: VolumeGrid, cells: tuple[int, int]) -> tuple[NDArray[np.float64], ...]:
    """Vertices along x, y and z of a level, m."""
    half = grid.square.extent / 2
    across = np.linspace(-half, half, cells[0] + 1)
    return across, across, np.linspace(grid.bottom, grid.top, cells[1] + 1)
