"""One suite for every linear map of the imaging, which joins by an entry in `MAPS`: adjoint and linearity;
and where backprojection puts a point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from imaging_scenes import helix, record, turn

from tagid.geometry import Aperture, ImageGrid
from tagid.imaging import kernel
from tagid.imaging.backprojection import backproject
from tagid.imaging.farfield import polar_format
from tagid.imaging.kernel import RangeGeometry
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans

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
    settings = PreprocessSettings("none", matched, extent_m=GRID.extent)
    return preprocess(record(POINTS, [1.0, 2.0, 0.5], aperture), settings=settings)


def operator_map(aperture: Aperture, views: np.ndarray | None = None) -> Map:
    operator = ForwardOperator(scans_of(aperture), GRID)
    if views is not None:
        operator = operator.select(views)
    return Map(PIXELS, operator.forward, operator.adjoint)


def slope_map() -> Map:
    return Map(PIXELS, ForwardOperator(scans_of(APERTURES["raised"]), GRID).slope)


def kernel_map(compiled: bool, pair: bool = False, high: bool = False) -> Map:
    single = helix(11)
    aperture = (
        Aperture.two_antennas(single.positions, single.positions + np.array([0.1, -0.1, 0.05]))
        if pair
        else single
    )
    heights = np.random.default_rng(1).uniform(-0.2, 0.2, PIXELS)
    points = np.column_stack([GRID.points, heights]) if high else GRID.points

    def engine() -> RangeGeometry:
        return RangeGeometry.of(aperture, points, (0.7, 0.002), 400)

    def run(job: Callable[[RangeGeometry], np.ndarray]) -> np.ndarray:
        before = kernel._compiled
        if not compiled:
            kernel._compiled = None
        try:
            return job(engine())
        finally:
            kernel._compiled = before

    return Map(
        PIXELS,
        lambda x: run(lambda g: g.scatter(x)),
        lambda y: run(lambda g: g.gather(np.ascontiguousarray(y, np.complex64))),
    )


def image_map(method: Callable[[BasebandScans, ImageGrid], object]) -> Map:
    scans = scans_of(APERTURES["turntable"], matched=True)
    shape = scans.samples.shape

    def forward(x: np.ndarray) -> np.ndarray:
        samples = np.asarray(x, np.complex64).reshape(shape)
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


WIDE = ImageGrid(0.5, 100)


def image_of(points, amplitudes, aperture, matched=True):
    settings = PreprocessSettings(background="none", matched_filter=matched)
    return backproject(preprocess(record(points, amplitudes, aperture), settings=settings), WIDE)


@pytest.mark.parametrize(
    "aperture", [turn(72), turn(72, 1.2, 0.5), helix(72)], ids=["turntable", "raised", "free"]
)
@pytest.mark.parametrize("matched", [True, False])
def test_a_point_peaks_at_its_place_with_its_amplitude(aperture, matched):
    # An asymmetric place on a pixel centre: a mirrored or transposed image would put it elsewhere.
    row, column = 27, 65
    point = (WIDE.axis[column], WIDE.axis[row])
    image = image_of([point], [2.5], aperture, matched=matched)
    assert image.values.dtype == np.complex64
    assert np.unravel_index(np.abs(image.values).argmax(), image.values.shape) == (row, column)
    assert image.values[row, column] == pytest.approx(2.5, rel=0.01)


def test_exact_sum_of_the_definition():
    """f(p) = 1/V sum_v z_v(d) exp(2jkd), z the response itself: upsampling and rounding add < 1 %."""
    aperture, point = turn(90), np.array([0.06, -0.13])
    settings = PreprocessSettings(background="none")
    scans = preprocess(record([point], [1.0], aperture), settings=settings)
    grid = ImageGrid(0.4, 40)
    d = np.linalg.norm(aperture.positions[None, :, :2] - grid.points[:, None], axis=2)
    base = np.linalg.norm(aperture.positions[:, :2] - point, axis=1)
    truth = (scans.response(d - base) * np.exp(2j * scans.wavenumber * (d - base))).mean(axis=1)
    assert np.abs(backproject(scans, grid).values.ravel() - truth).max() < 0.01


def test_pixels_outside_the_data_are_zero():
    scans = preprocess(record([(0.0, 0.1)], [1.0], turn(8)), settings=PreprocessSettings(extent_m=0.3))
    image = backproject(scans, ImageGrid(40.0, 16))
    assert image.values[0, 0] == 0
