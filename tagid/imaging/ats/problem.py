"""What one fit works on, as plain arrays: the field's parameters and the image that it begins with, the
geometry of the grid and of the views.

Both engines read the same arrays, so that an image does not depend on which of them was installed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tagid.geometry import Aperture, ImageGrid
from tagid.imaging import operator
from tagid.imaging.ats.settings import COARSEST, FEATURES, LEVELS, WIDTH
from tagid.imaging.ats.taps import Taps
from tagid.imaging.kernel import RangeGeometry
from tagid.imaging.lengths import finest_cell_m
from tagid.imaging.operator import ForwardOperator, interpolation_gain, reach_of
from tagid.imaging.restore import beam_sigma_m, blurred
from tagid.imaging.sparse import SparseSettings, sparse_amplitudes
from tagid.imaging.types import BasebandScans
from tagid.types import Samples

Array = NDArray[np.float32]

PHASE_STEP = 0.05
"""Phase of the carrier between fine range bins, rad, where a point goes to the nearest bin, at most 0.025 rad
off. Engines that put a point between two bins need only those of `operator.PHASE_STEP`."""

LEAST_PATH_VIEWS = 36
"""Views of a step along a path: of a rail with 600 views, 12 a step lose a reflector in 1 of 9 fits."""

MAGNITUDE_FLOOR = 1e-2
"""Of |sigma| / scale in the square root of the sparsity prior: below it a pixel is no longer pushed about
zero, where rounding would decide its sign and two engines would part."""

TABLE_INIT = 1e-2
"""Features start uniform in +-1e-2, small beside the network's weights, so that a fit starts near zero."""

PARTS = ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0))
"""Feature and sign of the units that pass the first image on: a ReLU lets only one sign through."""

REST = 0.3
"""What is left of the output's random weights, so that the first image stands out of them."""


@dataclass(frozen=True, eq=False)
class FieldShape:
    """Sizes of the neural field.

    Attributes:
        cells: cells along a side of the imaged square, one number a level, coarse to fine.
        features: features of a vertex.
        width: units of the hidden layer.
    """

    cells: tuple[int, ...]
    features: int
    width: int

    @classmethod
    def of(cls, grid: ImageGrid, wavelength_m: float) -> FieldShape:
        """Sizes for a grid: the finest cell follows the wavelength, or is a pixel where that is larger."""
        finest = min(grid.pixels, max(COARSEST, round(grid.extent / finest_cell_m(wavelength_m))))
        series = np.geomspace(min(COARSEST, finest), finest, LEVELS)
        cells = tuple(int(n) for n in np.floor(series + 1e-9))
        return cls(cells, FEATURES, WIDTH)


@dataclass(eq=False)
class FieldWeights:
    """Parameters of the field, and its image, which needs neither engine.

    Attributes:
        tables: (features, cells + 1, cells + 1) vertex features of every level.
        weights, biases: (out, in) and (out, 1) of every layer.
        scale: what the network's output is multiplied with.
        extent, pixels: the square that the field covers, m, and the grid it was fitted on.
        support: (pixels, pixels) bool, pixels that are not zero; None: all.
    """

    tables: list[Array]
    weights: list[Array]
    biases: list[Array]
    scale: float
    extent: float
    pixels: int
    support: NDArray[np.bool_] | None = None

    def image(self) -> NDArray[np.complex64]:
        """Reflectivity of the pixels, (pixels, pixels) complex64; zero outside the support."""
        wanted = None
        if self.support is not None and not self.support.all():
            wanted = np.flatnonzero(self.support)
        taps = Taps.of(self.pixels, [table.shape[1] - 1 for table in self.tables], wanted)
        features = len(self.tables[0])
        table = np.concatenate([t.reshape(features, -1) for t in self.tables], axis=1)
        inputs = np.empty((len(taps.index), len(self.tables) * features), dtype=np.float32)
        taps.interpolate(np.ascontiguousarray(table.T), inputs)
        layer = inputs.T
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            layer = weight @ layer + bias
            if i < len(self.weights) - 1:
                np.maximum(layer, 0, out=layer)
        real, imaginary = layer * np.float32(self.scale)
        values = np.zeros(self.pixels**2, dtype=np.complex64)
        values[slice(None) if wanted is None else wanted] = real + 1j * imaginary
        return values.reshape(self.pixels, self.pixels)

    @property
    def arrays(self) -> list[Array]:
        """All parameters: tables, weights, biases."""
        return [*self.tables, *self.weights, *self.biases]

    def with_arrays(self, arrays: list[Array]) -> FieldWeights:
        """The same field with other parameters, in the order of `arrays`."""
        cut, layers = len(self.tables), len(self.weights)
        return replace(
            self, tables=arrays[:cut], weights=arrays[cut : cut + layers], biases=arrays[cut + layers :]
        )


def draw_weights(
    shape: FieldShape,
    grid: ImageGrid,
    scale: float,
    seed: int,
    first: NDArray[np.complexfloating] | None = None,
) -> FieldWeights:
    """Initial parameters: random ones from a seed, the same on every machine, that carry a first image.

    Layers are uniform with variance 1 / (3 fan-in). The finest level holds the first image, (cells + 1, cells
    + 1) at its vertices, rows along y, relative to the scale, in its features, and the first four hidden
    units pass it on as positive and negative real and imaginary parts; None: a dark field. From a random
    field a fit of a full turn often ends in a ring of points about the true one.
    """
    rng = np.random.default_rng(seed)
    tables = [uniform(rng, TABLE_INIT, shape.features, n + 1, n + 1) for n in shape.cells]
    inputs = shape.features * len(shape.cells)
    weights, biases = [], []
    for fan_in, fan_out in ((inputs, shape.width), (shape.width, 2)):
        bound = 1 / np.sqrt(fan_in)
        weights.append(uniform(rng, bound, fan_out, fan_in))
        biases.append(uniform(rng, bound, fan_out, 1))
    carry(first, tables, weights, biases)
    return FieldWeights(tables, weights, biases, scale, grid.extent, grid.pixels)


def uniform(rng: np.random.Generator, bound: float, *size: int) -> Array:
    """Numbers within +- a bound."""
    return ((rng.random(size, dtype=np.float32) * 2 - 1) * np.float32(bound)).astype(np.float32)


def carry(
    first: NDArray[np.complexfloating] | None, tables: list[Array], weights: list[Array], biases: list[Array]
) -> None:
    """Make random parameters give a first image at the vertices of the finest level, in place."""
    hidden, output = weights
    features = len(tables[-1])
    output *= np.float32(REST)
    if first is not None and (peak := float(np.abs(first).max())) > 0:
        tables[-1][0] += (first.real / peak).astype(np.float32)
        tables[-1][1] += (first.imag / peak).astype(np.float32)
        for row, (part, sign) in enumerate(PARTS):
            hidden[row], biases[0][row], output[:, row] = 0, 0, 0
            hidden[row, hidden.shape[1] - features + part] = sign
            output[part, row] = sign * peak
    # What the biases alone give is an echo of the whole scene: it would be the first thing to be unlearned.
    biases[1][:] = -output @ np.maximum(biases[0], 0)


def interpolation(pixels: int, cells: int) -> Array:
    """(pixels, cells + 1) weights of the vertices at the pixel centres along one axis."""
    at = (np.arange(pixels) + 0.5) / pixels * cells
    corner = np.minimum(at.astype(np.intp), cells - 1)
    out = np.zeros((pixels, cells + 1), dtype=np.float32)
    out[np.arange(pixels), corner] = 1 - (at - corner)
    out[np.arange(pixels), corner + 1] = at - corner
    return out


@dataclass(frozen=True, eq=False)
class GridArrays:
    """What a step reads of the grid: see `Step` for the members of the same names.

    Attributes:
        pixels: (n,) numbers of the pixels that a step works on, or None for all. The native engine computes
            no others; the graph sets them to zero.
    """

    interpolation: list[Array]
    pixels: NDArray[np.intp] | None = None

    @property
    def _side(self) -> int:
        return len(self.interpolation[0])

    @cached_property
    def taps(self) -> Taps:
        """The vertices about every pixel of a step."""
        cells = [matrix.shape[1] - 1 for matrix in self.interpolation]
        return Taps.of(self._side, cells, self.pixels)

    @cached_property
    def support(self) -> Array:
        """(1, pixels^2) 1 for the pixels that a step works on, else 0."""
        mask = np.ones((1, self._side**2), dtype=np.float32)
        if self.pixels is not None:
            mask[:] = 0
            mask[0, self.pixels] = 1
        return mask

    @classmethod
    def of(cls, grid: ImageGrid, cells: tuple[int, ...]) -> GridArrays:
        """Arrays of a grid for levels of so many cells."""
        return cls([interpolation(grid.pixels, n) for n in cells])


@dataclass(frozen=True, eq=False)
class ViewArrays:
    """What a step reads of some views: see `Step` for the members of the same names."""

    aperture: Aperture
    points: NDArray[np.float64]
    fine: FineRange
    real: Array
    imaginary: Array
    samples: Array
    confidence: Array
    transmission: Array

    @cached_property
    def index(self) -> NDArray[np.int32]:
        """(views, points) nearest fine bin of every point."""
        return fine_index(self.aperture, self.points, self.fine)

    @cached_property
    def geometry(self) -> RangeGeometry:
        """Where the points lie between the fine bins."""
        first = (float(self.fine.offset) + 0.5) * self.fine.step
        return RangeGeometry.of(self.aperture, self.points, (first, self.fine.step), len(self.fine.spread))

    @cached_property
    def one_by_one(self) -> list[RangeGeometry]:
        """`geometry` of every view by itself, for views that see the points in lights of their own."""
        return [self.geometry.select(slice(view, view + 1)) for view in range(self.geometry.views)]

    @cached_property
    def factors(self) -> NDArray[np.complex64]:
        """(views, 1) what the calibration multiplies scans with."""
        return np.asarray(self.real[:, :1] + 1j * self.imaginary[:, :1], dtype=np.complex64)

    @cached_property
    def measured(self) -> NDArray[np.complex64]:
        """(views, bins) `samples` as complex values."""
        return np.asarray(self.samples[0] + 1j * self.samples[1], dtype=np.complex64)

    def rows_of(self, values: Samples) -> Samples:
        """(views, fine bins) of the points (points,), as every view sees them."""
        if len(self.transmission) > 1:
            seen = values * self.transmission
            rows = np.concatenate([v.scatter(row) for v, row in zip(self.one_by_one, seen, strict=True)])
        else:
            rows = self.geometry.scatter(values)
        return np.asarray(rows * self.factors, dtype=np.complex64)

    def points_of(self, rows: Samples) -> Samples:
        """(points,) of rows, the adjoint of `rows_of`."""
        rows = rows * self.factors.conj()
        if len(self.transmission) > 1:
            back = np.stack([v.gather(row[None]) for v, row in zip(self.one_by_one, rows, strict=True)])
            return np.asarray((back * self.transmission).sum(axis=0), dtype=np.complex64)
        return self.geometry.gather(rows)

    def select(self, views: NDArray[np.integer] | slice) -> ViewArrays:
        """The same of some views only."""
        return ViewArrays(
            self.aperture.select(views),
            self.points,
            self.fine,
            np.ascontiguousarray(self.real[views]),
            np.ascontiguousarray(self.imaginary[views]),
            np.ascontiguousarray(self.samples[:, views]),
            np.ascontiguousarray(self.confidence[views]),
            np.ascontiguousarray(self.transmission[views if len(self.transmission) > 1 else slice(None)]),
        )


@dataclass(frozen=True, eq=False)
class FineRange:
    """The fine range grid of the step.

    Attributes:
        step: m.
        offset: range of the first bin in steps, less the half that makes a cut a rounding.
        spread: (fine bins, 2B) carrier and range response, real part before imaginary part.
    """

    step: float
    offset: np.float32
    spread: Array

    @cached_property
    def complex_spread(self) -> NDArray[np.complex64]:
        """(fine bins, B) `spread` as complex values."""
        real, imaginary = np.split(self.spread, 2, axis=1)
        return np.asarray(real + 1j * imaginary, dtype=np.complex64)

    @cached_property
    def complex_collect(self) -> NDArray[np.complex64]:
        """(B, fine bins) the adjoint of `complex_spread`."""
        return np.ascontiguousarray(self.complex_spread.conj().T)

    @classmethod
    def of(
        cls,
        scans: BasebandScans,
        points: NDArray[np.float64],
        margin_m: float = 0.0,
        between: bool = False,
    ) -> FineRange:
        """Fine grid that holds points (points, 2), m, for all views even where the antennas move by a margin.

        `between`: for an engine that puts a point between two bins; else for one that takes the nearest.
        """
        near, far = reach_of(scans.aperture, points)
        near, far = near - margin_m, far + margin_m
        phase_step = operator.PHASE_STEP if between else PHASE_STEP
        step = phase_step / (2 * scans.wavenumber)
        start = near - 2 * step
        fine = start + step * np.arange(int(np.ceil((far - near) / step)) + 5, dtype=np.float64)
        carrier = np.exp(-2j * scans.wavenumber * fine) * (interpolation_gain(phase_step) if between else 1)
        matrix = scans.response(scans.ranges_m[None, :] - fine[:, None]) * carrier[:, None]
        return cls(
            step,
            np.float32(start / step - 0.5),
            np.concatenate([matrix.real, matrix.imag], axis=1).astype(np.float32),
        )


def view_subsets(aperture: Aperture, views_per_step: int) -> list[NDArray[np.intp]]:
    """Interleaved subsets of the views, of about `views_per_step` each; together they are all of them.

    On a turntable each is an even turn. Along a path even spacing would give grating lobes, one replica of
    every reflector at the same place in every subset, which the fit then takes for a reflector; so there each
    subset draws one view at random from every piece of the path, and has `LEAST_PATH_VIEWS` at least.
    """
    if aperture.angles is None:
        views_per_step = max(views_per_step, LEAST_PATH_VIEWS)
    stride = max(1, round(aperture.views / views_per_step))
    if aperture.angles is not None or stride == 1:
        return [np.arange(k, aperture.views, stride) for k in range(stride)]
    rng = np.random.default_rng(0)
    whole = np.arange(aperture.views)
    pieces = [rng.permutation(whole[at : at + stride]) for at in range(0, aperture.views, stride)]
    return [np.array([p[k] for p in pieces if k < len(p)]) for k in range(stride)]


def fine_index(aperture: Aperture, points: NDArray[np.float64], fine: FineRange) -> NDArray[np.int32]:
    """(views, points) nearest fine bin of every point (points, 2), m, in single precision.

    Sum by sum, not as a product of matrices: so every machine rounds alike and finds the same bin.
    """
    x, y = (points / fine.step).T.astype(np.float32)
    out = np.empty((aperture.views, len(points)), dtype=np.int32)
    for view in range(aperture.views):
        ways = []
        for antenna in aperture.antennas:
            ax, ay, az = antenna[view] / fine.step
            across, along = x - np.float32(ax), y - np.float32(ay)
            ways.append(np.sqrt(across * across + along * along + np.float32(az * az)))
        distance = ways[0] if len(ways) == 1 else np.float32(0.5) * (ways[0] + ways[1])
        out[view] = (distance - fine.offset).astype(np.int32)
    return out


def view_arrays(
    scans: BasebandScans,
    points: NDArray[np.float64],
    fine: FineRange,
    confidence: NDArray[np.floating],
    factors: NDArray[np.complexfloating],
    transmission: NDArray[np.floating] | None = None,
) -> ViewArrays:
    """Arrays of all views of pixel centres (points, 2), m.

    `confidence` (views, bins) weighs the samples, `factors` (views,) is what the calibration multiplies scans
    with, `transmission` (views, points) what is left of each point's echo; None: all.
    """
    samples = np.stack([scans.samples.real, scans.samples.imag]).astype(np.float32)
    return ViewArrays(
        scans.aperture,
        points,
        fine,
        np.stack([factors.real, -factors.imag], axis=1).astype(np.float32),
        np.stack([factors.imag, factors.real], axis=1).astype(np.float32),
        samples,
        np.asarray(confidence, dtype=np.float32),
        np.ones((1, 1), np.float32) if transmission is None else np.asarray(transmission, dtype=np.float32),
    )


_PAIRS = 2 * 10**6
"""Pairs of view and vertex of the sparse solution: all for a P440 and 360 views of 0.5 m."""

_LARGE_PAIRS = 30 * 10**6
"""Pairs of view and pixel from which an image is large: 360 views of 0.5 m at 24 GHz, but not of 2 m of a
P440."""

_ITERATIONS_OF_LARGE = 40
"""Iterations of the sparse solution of a large image. Its echoes keep FISTA busy to its last iteration, which
is two thirds of a fit, and the fit then leaves about as much of unseen views as after 150: of two outlines
and a box at 24 GHz 22.1, 53.4 and 83.8 %, after 150 iterations 22.5, 52.5 and 86.2 %."""


class FirstImages:
    """First images by the views that a fit does not see, each computed once.

    Fits of the same scans on the same grid share them: the sparse solution is up to half of a fit.
    """

    def __init__(self) -> None:
        self._made: dict[tuple[bytes, int], NDArray[np.complex128]] = {}

    def of(
        self, scans: BasebandScans, unseen: NDArray[np.integer], grid: ImageGrid, cells: int, step: float
    ) -> NDArray[np.complex128]:
        """As `first_image`; `scans` are those without the views `unseen`."""
        key = np.asarray(unseen, dtype=np.int64).tobytes(), cells
        if key not in self._made:
            self._made[key] = first_image(scans, grid, cells, step)
        return self._made[key]


def first_image(scans: BasebandScans, grid: ImageGrid, cells: int, step: float) -> NDArray[np.complex128]:
    """(cells + 1, cells + 1) sparse solution with the restoring beam at the vertices of the finest level, in
    the units of the scans.

    From backprojection, whose sidelobes of a dozen views are half as bright as its points, the steps do not
    get rid of them: 8.8 % of unseen views are left of twelve views of reflectors, 2.7 % from here. From bare
    pixels the points stay where their pixels are: 1.0 mm off at 36 views, 0.6 mm from here. Where the sparse
    solution is blank it is backprojection times `step`, by which that explains the scans best. The brightest
    vertices of a large image take part.
    """
    axis = np.linspace(-grid.extent / 2, grid.extent / 2, cells + 1)
    vertices = np.stack([part.ravel() for part in np.meshgrid(axis, axis)], axis=1)
    operator = ForwardOperator(scans, vertices)
    back = operator.adjoint(np.ascontiguousarray(scans.samples, dtype=np.complex64))
    most = max(1, _PAIRS // scans.aperture.views)
    chosen = np.zeros(len(vertices), dtype=bool)
    chosen[np.argsort(-np.abs(back), kind="stable")[:most]] = True
    large = len(vertices) * scans.aperture.views > _LARGE_PAIRS
    settings = SparseSettings(iterations=_ITERATIONS_OF_LARGE) if large else SparseSettings()
    sparse, _ = sparse_amplitudes(scans, vertices[chosen], settings, operator=operator.among(chosen))
    if not sparse.any():
        return np.asarray(back * step, np.complex128).reshape(cells + 1, cells + 1)
    bare = np.zeros(len(vertices), dtype=np.complex128)
    bare[chosen] = sparse
    width = beam_sigma_m(scans.wavenumber) / (grid.extent / cells)
    parts = [blurred(part.reshape(cells + 1, cells + 1), width) for part in (bare.real, bare.imag)]
    # A vertex is spread over the pixels of a cell.
    share = (cells / grid.pixels) ** 2
    return np.asarray((parts[0] + 1j * parts[1]) * share, dtype=np.complex128)
