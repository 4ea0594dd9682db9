"""One suite for every linear map of the imaging: adjoint, linearity, and gradients by finite differences.

A map joins by one entry in `MAPS`; of a torch map, torch's own gradient is the adjoint, so that a wrong sign
or a missing conjugate shows in whatever the fits rest on.
"""

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


def by_autograd(size: int, forward: Callable[[object], object], complex_: bool = True) -> Map:
    """A torch map with torch's gradient of Re <y, A x> as its adjoint A^H y."""
    torch = pytest.importorskip("torch", reason="analysis through synthesis needs the extra 'ats'")
    kind = torch.complex64 if complex_ else torch.float32

    def apply(x: np.ndarray) -> np.ndarray:
        return forward(torch.tensor(x if complex_ else x.real, dtype=kind)).detach().numpy()  # type: ignore[attr-defined]

    def adjoint(y: np.ndarray) -> np.ndarray:
        x = torch.zeros(size, dtype=kind, requires_grad=True)
        out = forward(x)
        weight = torch.tensor(np.asarray(y if complex_ else y.real).reshape(out.shape), dtype=kind)  # type: ignore[attr-defined]
        (out * weight.conj()).sum().real.backward()
        return x.grad.numpy()

    return Map(size, apply, adjoint)


def hash_map() -> Map:
    pytest.importorskip("torch", reason="analysis through synthesis needs the extra 'ats'")
    from tagid.imaging.ats.fit_paper import EncodingSettings, encoding_matrix, interpolate

    settings = EncodingSettings(levels=3, features=2, coarsest=4, finest=30, log2_entries=8)
    matrix = encoding_matrix(GRID.points / GRID.extent + 0.5, settings)
    entries = matrix.shape[1]
    return by_autograd(
        entries * 2,
        lambda x: interpolate(x.view(entries, 2), matrix, matrix.T.tocsr(), settings),  # type: ignore[attr-defined]
        complex_=False,
    )


def tables_map() -> Map:
    torch = pytest.importorskip("torch", reason="analysis through synthesis needs the extra 'ats'")
    from tagid.imaging.ats.fit_torch import features
    from tagid.imaging.ats.problem import interpolation

    at = [torch.from_numpy(interpolation(18, n)) for n in (5, 9)]

    def forward(x: object) -> object:
        parts = [x[: 3 * 36].view(3, 6, 6), x[3 * 36 :].view(3, 10, 10)]  # type: ignore[index]
        return features(parts, at)

    return by_autograd(3 * 36 + 3 * 100, forward, complex_=False)


def paper_map() -> Map:
    """The published model without what bends it: nothing hides (opacity 0), every surface faces (floor 1)."""
    pytest.importorskip("torch", reason="the published model needs the extra 'ats'")
    from tagid.imaging.ats.fit_paper import sample_view, synthesize_profile

    rays = sample_view(turn(7), 2, GRID, 0.75 + 0.01 * np.arange(50), 0.02, 1.5)
    shape = rays.depths.shape
    return by_autograd(
        shape[0] * shape[1],
        lambda x: synthesize_profile(x.view(shape), rays, lambert_floor=1.0, opacity=0.0),  # type: ignore[attr-defined]
    )


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
    "hash encoding": hash_map,
    "dense encoding": tables_map,
    "published model": paper_map,
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
    assert linear.adjoint is not None
    x = noise(3, linear.size)
    seen = linear.forward(x)
    if not np.iscomplexobj(seen):
        x = x.real
    y = noise(4, *seen.shape)
    y = y if np.iscomplexobj(seen) else y.real
    left = np.vdot(y.astype(complex), seen.astype(complex))
    right = np.vdot(linear.adjoint(y).ravel().astype(complex), x.astype(complex))
    assert abs(left - right) < 1e-5 * np.linalg.norm(y) * np.linalg.norm(seen)


def test_slope_is_the_difference_of_two_distances() -> None:
    """Points on the axis of a turntable all move away by the step in its radius."""
    centre, step = np.zeros((1, 2)), 1e-4
    scans = scans_of(turn(12))
    ahead, behind = (
        ForwardOperator(scans.with_aperture(turn(12, 1 + d)), centre).forward(np.ones(1))
        for d in (step, -step)
    )
    slope = ForwardOperator(scans, centre).slope(np.ones(1))
    difference = (ahead - behind) / (2 * step)
    assert np.abs(slope - difference).max() < 0.02 * np.abs(difference).max()


def test_published_gradient_by_finite_differences() -> None:
    """With transmission and Lambert factor the model is not linear; its gradient is torch's."""
    torch = pytest.importorskip("torch", reason="the published model needs the extra 'ats'")
    from tagid.imaging.ats.fit_paper import sample_view, synthesize_profile

    rays = sample_view(turn(7), 2, GRID, 0.85 + 0.02 * np.arange(14), 0.04, 1.5)
    rng = np.random.default_rng(5)
    start = torch.tensor(40 * noise(6, *rays.depths.shape).astype(complex), requires_grad=True)
    weight = torch.tensor(rng.standard_normal(14))

    def loss(sigma: object) -> object:
        return (synthesize_profile(sigma, rays, 0.2, 0.02).abs().square() * weight).sum()

    loss(start).backward()  # type: ignore[attr-defined]
    for seed in range(4):
        direction = torch.tensor(noise(10 + seed, *rays.depths.shape).astype(complex))
        with torch.no_grad():
            ahead, behind = (float(loss(start + s * 1e-4 * direction)) for s in (1, -1))  # type: ignore[arg-type]
        expected = float((start.grad.conj() * direction).sum().real)
        assert (ahead - behind) / 2e-4 == pytest.approx(expected, rel=1e-3, abs=1e-6 * abs(ahead))
