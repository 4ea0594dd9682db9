"""One suite for every linear map of the imaging, which joins by an entry in `MAPS`: adjoint and linearity;
the forward operator against the echo of the formula; and where backprojection puts a point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from tagid.errors import UsageError
from tagid.geometry import Aperture, ImageGrid
from tagid.imaging import kernel, memory
from tagid.imaging import operator as operator_module
from tagid.imaging.backprojection import backproject
from tagid.imaging.farfield import polar_format
from tagid.imaging.kernel import RangeGeometry
from tagid.imaging.operator import ForwardOperator, fine_range
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tests.unit.imaging_scenes import helix, record, scans_from, turn

GRID = ImageGrid(0.3, 18)
PIXELS = GRID.pixels**2
POINTS = np.array([[0.1, 0.05], [-0.12, 0.0], [0.03, -0.11]])
APERTURES = {
    "turntable": turn(20),
    "raised": turn(20, 1.1, 0.4),
    "free": helix(20),
    "two antennas": turn(20, 1.1, 0.4, 0.2),
    "free pairs": Aperture.two_antennas(helix(20).positions + np.array([0, 0.1, 0.05]), helix(20).positions),
}


@dataclass(frozen=True)
class Map:
    """A linear map from (n,) to some shape, and its adjoint where it has one."""

    size: int
    forward: Callable[[np.ndarray], np.ndarray]
    adjoint: Callable[[np.ndarray], np.ndarray] | None = None


def scans_of(aperture: Aperture, matched: bool = False) -> BasebandScans:
    return scans_from(record(POINTS, [1.0, 2.0, 0.5], aperture), GRID.extent, matched=matched)


def operator_map(aperture: Aperture, views: np.ndarray | None = None) -> Map:
    operator = ForwardOperator(scans_of(aperture), GRID)
    if views is not None:
        operator = operator.select(views)
    return Map(PIXELS, operator.forward, operator.adjoint)


def slope_map() -> Map:
    return Map(PIXELS, ForwardOperator(scans_of(APERTURES["raised"]), GRID).slope)


def kernel_map(compiled: bool, pair: bool = False, high: bool = False) -> Map:
    aperture = helix(11)
    if pair:
        aperture = Aperture.two_antennas(aperture.positions, aperture.positions + np.array([0.1, -0.1, 0.05]))
    heights = np.random.default_rng(1).uniform(-0.2, 0.2, PIXELS)
    points = np.column_stack([GRID.points, heights]) if high else GRID.points

    def run(job: Callable[[RangeGeometry], np.ndarray]) -> np.ndarray:
        with pytest.MonkeyPatch.context() as patch:
            if not compiled:
                patch.setattr(kernel, "_compiled", None)
            return job(RangeGeometry.of(aperture, points, (0.7, 0.002), 400))

    return Map(
        PIXELS,
        lambda x: run(lambda g: g.scatter(x)),
        lambda y: run(lambda g: g.gather(np.ascontiguousarray(y, np.complex64))),
    )


def image_map(method: Callable[[BasebandScans, ImageGrid], object]) -> Map:
    scans = scans_of(APERTURES["turntable"], matched=True)

    def forward(x: np.ndarray) -> np.ndarray:
        samples = np.asarray(x, np.complex64).reshape(scans.samples.shape)
        return method(replace(scans, samples=samples), GRID).values  # type: ignore[attr-defined]

    return Map(scans.samples.size, forward)


def preprocess_map() -> Map:
    capture = record(POINTS, [1.0, 2.0, 0.5], APERTURES["turntable"], analytic=True)
    settings = PreprocessSettings("mean", True, extent_m=GRID.extent)

    def forward(x: np.ndarray) -> np.ndarray:
        samples = np.asarray(x, np.complex64).reshape(capture.samples.shape)
        return preprocess(replace(capture, samples=samples), settings=settings).samples

    return Map(capture.samples.size, forward)


MAPS: dict[str, Callable[[], Map]] = {
    **{f"operator, {name}": lambda a=a: operator_map(a) for name, a in APERTURES.items()},  # type: ignore[misc]
    "operator, some views": lambda: operator_map(APERTURES["free"], np.array([19, 3, 3, 11])),
    "operator's slope": slope_map,
    "kernel in C": lambda: kernel_map(True),
    "kernel in numpy": lambda: kernel_map(False),
    "kernel in C, both": lambda: kernel_map(True, pair=True, high=True),
    "kernel in numpy, both": lambda: kernel_map(False, pair=True, high=True),
    "backprojection": lambda: image_map(backproject),
    "polar format": lambda: image_map(polar_format),
    "preprocessing": preprocess_map,
}


def noise(seed: int, *shape: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)


ONE_WAY = {"operator's slope", "backprojection", "polar format", "preprocessing"}
"""Maps that nothing in the package takes the adjoint of."""


def made(name: str) -> Map:
    if name.startswith("kernel in C") and not kernel.is_compiled():
        pytest.skip("no compiler was present at installation")
    return MAPS[name]()


@pytest.mark.parametrize("name", MAPS)
def test_linear(name: str) -> None:
    linear = made(name)
    a, b = noise(1, linear.size), noise(2, linear.size)
    together = linear.forward(2.5 * a - 3 * b)
    apart = 2.5 * linear.forward(a) - 3 * linear.forward(b)
    assert np.abs(apart).max() > 0
    assert np.abs(together - apart).max() < 2e-5 * np.abs(apart).max()


@pytest.mark.parametrize("name", [name for name in MAPS if name not in ONE_WAY])
def test_adjoint(name: str) -> None:
    """<y, A x> = <A^H y, x>."""
    linear = made(name)
    x = noise(3, linear.size)
    seen = linear.forward(x)
    y = noise(4, *seen.shape)
    left = np.vdot(y.astype(complex), seen.astype(complex))
    right = np.vdot(linear.adjoint(y).ravel().astype(complex), x.astype(complex))
    assert abs(left - right) < 1e-5 * np.linalg.norm(y) * np.linalg.norm(seen)


def matrix_of(operator: ForwardOperator) -> np.ndarray:
    """(views * bins, points), column by column."""
    units = (operator.among(np.arange(operator.points) == point) for point in range(operator.points))
    return np.stack([unit.forward(np.ones(1)).ravel() for unit in units], axis=1)


@pytest.fixture(params=["turntable", "raised", "free"])
def scans(request: pytest.FixtureRequest) -> BasebandScans:
    return scans_of(APERTURES[request.param])


@pytest.mark.parametrize("what", ["grid", "points", "some views"])
def test_the_operator_is_the_sum_of_its_columns_and_its_norm_bounds_it(
    scans: BasebandScans, what: str
) -> None:
    operator = ForwardOperator(scans, POINTS if what == "points" else GRID)
    if what == "some views":
        operator = operator.select(np.array([19, 3, 3, 11]))
    x, matrix = noise(2, operator.points), matrix_of(operator)
    y = operator.forward(x)
    assert y.dtype == operator.adjoint(y).dtype == np.complex64
    assert operator.shape == (y.size, operator.points) and y.shape == (operator.views, operator.bins)
    assert np.abs(matrix @ x - y.ravel()).max() < 1e-5 * np.abs(y).max()
    largest = np.linalg.eigvalsh(matrix.conj().T @ matrix)[-1]
    assert 0.9 * largest < operator.norm_squared < 1.001 * largest


def test_what_the_bins_cannot_see_has_no_norm() -> None:
    scans = scans_of(turn(20))
    assert ForwardOperator(replace(scans, range_start_m=90.0), GRID).norm_squared == 0.0
    assert ForwardOperator(scans, GRID).norm_squared == ForwardOperator(scans, GRID).norm_squared > 0


def test_the_fine_range_holds_all_points_in_steps_of_the_stated_phase(scans: BasebandScans) -> None:
    """One step more on either side, so that each point lies between two samples, and none is wasted."""
    start, step, bins = fine_range(scans, POINTS)
    assert step == pytest.approx(0.2 / (2 * scans.wavenumber))
    away = scans.aperture.distances(POINTS)
    reach = np.hypot(*POINTS.T).max()
    assert start <= away.min() - step * 0.99
    assert start + step * (bins - 1) >= away.max() + step * 0.99
    assert step * bins <= 2 * reach + np.ptp(np.linalg.norm(scans.aperture.positions, axis=1)) + 4 * step
    coarse = replace(scans, range_step_m=step / 3)
    assert fine_range(coarse, POINTS)[1] == step / 3


def test_the_model_and_its_slope_are_those_of_the_formula(scans: BasebandScans) -> None:
    """0.33 % are lost without the gain; what stays is the scatter that the module states, 0.15 % rms.

    The slope is the difference of two models over 20 um of distance, in amplitude and in phase.
    """
    rng = np.random.default_rng(8)
    for point in rng.uniform(-0.15, 0.15, (12, 2)):
        away = np.linalg.norm(scans.aperture.positions - np.append(point, 0.0), axis=1)[:, None]

        def echo(distance: np.ndarray) -> np.ndarray:
            return scans.response(scans.ranges_m - distance) * np.exp(-2j * scans.wavenumber * distance)

        operator, exact = ForwardOperator(scans, point[None]), echo(away)
        model, slope = operator.forward(np.ones(1)), operator.slope(np.ones(1))
        assert abs(np.vdot(exact, model) / np.vdot(exact, exact) - 1) < 1e-3
        assert np.linalg.norm(model - exact) < 2.5e-3 * np.linalg.norm(exact)
        steep = (echo(away + 1e-5) - echo(away - 1e-5)) / 2e-5
        assert np.linalg.norm(slope - steep) < 0.01 * np.linalg.norm(steep)
        assert abs(np.vdot(steep, slope) / np.vdot(steep, steep) - 1) < 4e-3


def test_chosen_views_are_rows_of_the_whole(scans: BasebandScans) -> None:
    whole = ForwardOperator(scans, GRID)
    x = noise(3, whole.points)
    for views in (slice(1, None, 3), np.array([18, 2, 17])):
        assert np.allclose(whole.select(views).forward(x), whole.forward(x)[views], atol=1e-4)


def test_too_large_is_refused_before_memory_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "free_memory", lambda: 100_000)
    with pytest.raises(UsageError, match="GB") as caught:
        ForwardOperator(scans_of(turn(20)), GRID)
    assert "fewer views" in caught.value.remedy


@pytest.mark.parametrize("points", [np.zeros((0, 2)), np.zeros((4, 4)), np.zeros(4), np.full((2, 2), np.nan)])
def test_points_must_be_points(points: np.ndarray) -> None:
    with pytest.raises(UsageError, match="points"):
        ForwardOperator(scans_of(turn(20)), points)


def test_the_blocks_of_a_long_window_are_the_whole_operator(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only bins near a fine range are kept; what is left out is zero."""
    path = Aperture(np.stack([np.linspace(-3, 3, 9), np.full(9, -6.0), np.ones(9)], axis=1))
    scans = scans_from(record([[0.5, 0.1], [-2.0, 1.5]], [1.0, 0.7], path, start_m=2.0, bins=900), 5.0)
    points = np.random.default_rng(3).uniform(-2.5, 2.5, (40, 2))
    banded = ForwardOperator(scans, points)
    monkeypatch.setattr(operator_module, "_BANDED_FROM", np.inf)
    whole = ForwardOperator(scans, points)
    assert len(banded._spread.blocks) > 3 and len(whole._spread.blocks) == 1
    x = noise(4, 40)
    for method, values in (("forward", x), ("slope", x), ("adjoint", scans.samples)):
        first, other = getattr(banded, method)(values), getattr(whole, method)(values)
        assert np.abs(first - other).max() < 1e-5 * np.abs(other).max()


WIDE = ImageGrid(0.5, 100)


@pytest.mark.parametrize(
    "aperture", [turn(72), turn(72, 1.2, 0.5), helix(72)], ids=["turntable", "raised", "free"]
)
@pytest.mark.parametrize("matched", [True, False])
def test_a_point_peaks_at_its_place_with_its_amplitude(aperture: Aperture, matched: bool) -> None:
    # An asymmetric place on a pixel centre: a mirrored or transposed image would put it elsewhere.
    row, column = 27, 65
    capture = record([(WIDE.axis[column], WIDE.axis[row])], [2.5], aperture)
    image = backproject(scans_from(capture, WIDE.extent, matched=matched), WIDE)
    assert image.values.dtype == np.complex64
    assert np.unravel_index(np.abs(image.values).argmax(), image.values.shape) == (row, column)
    assert image.values[row, column] == pytest.approx(2.5, rel=0.01)


def test_exact_sum_of_the_definition() -> None:
    """f(p) = 1/V sum_v z_v(d) exp(2jkd), z the response itself: upsampling and rounding add < 1 %."""
    aperture, point, grid = turn(90), np.array([[0.06, -0.13]]), ImageGrid(0.4, 40)
    scans = scans_from(record(point, [1.0], aperture), 0.5, matched=True)
    off = (aperture.distances(grid.points) - aperture.distances(point)).T
    truth = (scans.response(off) * np.exp(2j * scans.wavenumber * off)).mean(axis=1)
    image = backproject(scans, grid)
    assert np.abs(image.values.ravel() - truth).max() < 0.01
    assert backproject(scans, ImageGrid(40.0, 16)).values[0, 0] == 0, "beyond the data"
