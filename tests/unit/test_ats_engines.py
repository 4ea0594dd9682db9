"""One suite for what runs the steps of a fit, numpy with compiled kernels, onnxruntime and torch; and the
field's inner loops, compiled against scipy and numpy."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import numpy as np
import pytest

from tagid.errors import MissingExtraError, UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.ats import fit as fit_module
from tagid.imaging.ats import taps as module
from tagid.imaging.ats.fit import fit, make_engine
from tagid.imaging.ats.fit_native import NativeEngine
from tagid.imaging.ats.problem import (
    FieldShape,
    FineRange,
    GridArrays,
    draw_weights,
    interpolation,
    view_arrays,
)
from tagid.imaging.ats.settings import AtsSettings
from tagid.imaging.ats.taps import Adam, Taps, first_support, next_support
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.types import BasebandScans
from tagid.models_store import manifest
from tests.unit.imaging_scenes import record, scans_from, turn

GRID = ImageGrid(0.3, 20)
POINTS = [[0.05, -0.08], [-0.1, 0.02]]
TORCH = importlib.util.find_spec("torch") is not None
needs_torch = pytest.mark.skipif(not TORCH, reason="needs torch, of the extra 'ats'")
if TORCH:
    import torch

    from tagid.imaging.ats import fit_torch
    from tagid.imaging.ats.fit_torch import TorchEngine


@pytest.fixture(scope="module")
def scans() -> BasebandScans:
    capture = record(POINTS, [1.0, 0.6j], turn(24), analytic=True, noise=0.05, seed=1)
    return scans_from(capture, GRID.extent)


@pytest.fixture(params=["native", "onnx", pytest.param("torch", marks=needs_torch)])
def settings(request: pytest.FixtureRequest) -> AtsSettings:
    """Settings that ask for an engine."""
    return AtsSettings(engine=request.param, seed=3)


def test_the_engines_give_one_image(scans, settings) -> None:
    first, again = (fit(scans, GRID, settings).image for _ in range(2))
    np.testing.assert_array_equal(first.values, again.values)
    assert first.settings["engine"] == settings.engine
    graph = fit(scans, GRID, AtsSettings(engine="onnx", seed=3)).image.values
    # The graph puts a point into the nearest bin, the native engine between two.
    most = 0.03 if settings.engine == "native" else 0.01
    assert np.linalg.norm(first.values - graph) < most * np.linalg.norm(graph)


def test_the_step_sees_what_the_operator_sees(scans, settings) -> None:
    """Its loss without priors is ||A sigma - y||^2 with the forward operator of every other method."""
    shape = FieldShape.of(GRID, scans.wavelength_m)
    weights = draw_weights(shape, GRID, 0.3, seed=2)
    engine = make_engine(weights, settings)
    fine = FineRange.of(scans, GRID.points, between=engine.name == "native")
    ones = np.ones(scans.samples.shape), np.ones(24, dtype=complex)
    views = view_arrays(scans, GRID.points, fine, *ones, np.ones((24, GRID.pixels**2), np.float32))
    numbers = np.array([0, 1, 1, 0.3, 1, 0, 1e-8], dtype=np.float32)
    loss = engine.step(GridArrays.of(GRID, shape.cells), views, fine, numbers)
    residual = ForwardOperator(scans, GRID).forward(weights.image().ravel()) - scans.samples
    assert loss == pytest.approx(float(np.vdot(residual, residual).real), rel=0.02)
    # The rate is zero: a step changes nothing.
    for before, after in zip(weights.arrays, engine.weights().arrays, strict=True):
        np.testing.assert_array_equal(before, after)


def test_spreading_and_beam_are_in_every_engine(scans, settings) -> None:
    rich = {"spreading": 2.0, "beam_width_deg": 30.0, "robust": 3.0, "steps": 30}
    remaining = fit(scans, GRID, replace(settings, **rich)).held_out
    reference = fit(scans, GRID, AtsSettings(engine="onnx", seed=3, **rich)).held_out
    assert remaining == pytest.approx(reference, rel=0.2)


def test_auto_is_the_fastest_engine_that_is_there(scans, monkeypatch) -> None:
    monkeypatch.setattr(fit_module, "is_compiled", lambda: True)
    assert fit(scans, GRID, AtsSettings(steps=2)).image.settings["engine"] == "native"
    monkeypatch.setattr(fit_module, "is_compiled", lambda: False)
    assert fit(scans, GRID, AtsSettings(steps=2)).image.settings["engine"] == "onnx"


def test_a_missing_engine_is_named(scans, monkeypatch) -> None:
    monkeypatch.setattr(fit_module.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="torch"):
        fit(scans, GRID, AtsSettings(steps=2, engine="torch"))


@needs_torch
def test_a_device_that_is_not_there_is_named(scans) -> None:
    if not torch.cuda.is_available():
        with pytest.raises(UsageError, match="cuda"):
            fit(scans, GRID, AtsSettings(steps=2, device="cuda"))
    with pytest.raises(UsageError, match="device"):
        fit(scans, GRID, AtsSettings(steps=2, device="abacus"))


@needs_torch
def test_cuda_gives_the_image_of_the_processor(scans) -> None:
    if not torch.cuda.is_available():
        pytest.skip("there is no CUDA device")
    images = [fit(scans, GRID, AtsSettings(engine="torch", device=d)).image.values for d in ("cpu", "cuda")]
    assert np.linalg.norm(images[0] - images[1]) < 0.02 * np.linalg.norm(images[0])


RNG = np.random.default_rng(3)
compiled = pytest.mark.skipif(module._compiled is None, reason="no compiler was present at installation")


@pytest.mark.parametrize("features", [2, 3])
@pytest.mark.parametrize("native", [pytest.param(True, marks=compiled), False])
def test_interpolation_is_that_of_the_field_and_has_its_transpose(features, native, monkeypatch) -> None:
    if not native:
        monkeypatch.setattr(module, "_compiled", None)
    cells = (3, 7)
    tables = [RNG.standard_normal((features, n + 1, n + 1)).astype(np.float32) for n in cells]
    some = np.array([0, 4, 17, 80])
    taps = Taps.of(9, list(cells), some)
    table = np.concatenate([t.reshape(features, -1) for t in tables], axis=1).T.copy()
    rows = np.empty((4, 2 * features), np.float32)
    taps.interpolate(table, rows)
    along = [interpolation(9, n) for n in cells]
    dense = [at @ table @ at.T for at, table in zip(along, tables, strict=True)]
    expected = np.concatenate([part.reshape(features, -1)[:, some] for part in dense])
    np.testing.assert_allclose(rows.T, expected, atol=1e-6)
    slope = RNG.standard_normal(rows.shape).astype(np.float32)
    back = np.full_like(table, 7)
    taps.accumulate(slope, back)
    assert float((rows * slope).sum()) == pytest.approx(float((table * back).sum()), rel=1e-4)


@compiled
def test_the_compiled_update_is_that_of_numpy(monkeypatch) -> None:
    start, *gradients = RNG.standard_normal((4, 18)).astype(np.float32)
    states = []
    for native in (True, False):
        if not native:
            monkeypatch.setattr(module, "_compiled", None)
        adam, parameters = Adam.of([5, 12, 1]), start.copy()
        for gradient in gradients:
            adam.update(parameters, gradient.copy(), np.array([0.1, 0.02, 0.3], np.float32), 3.0, 0.1)
        states.append((parameters, adam.first, adam.second))
    for first, other in zip(*states, strict=True):
        np.testing.assert_allclose(first, other, rtol=1e-5, atol=1e-7)


@compiled
def test_buffers_that_do_not_fit_are_refused() -> None:
    taps, rows = Taps.of(4, [3]), np.zeros((16, 2), np.float32)
    for vertices, pixels in ((15, 16), (16, 3)):  # it has 16 of each
        with pytest.raises(ValueError, match="fit together"):
            taps.interpolate(np.zeros((vertices, 2), np.float32), rows[:pixels])
    with pytest.raises(ValueError, match="fit together"):
        Adam.of([4]).update(*(np.zeros(3, np.float32) for _ in range(2)), np.ones(1, np.float32), 1.0, 0.1)


def test_dark_pixels_are_left_out_and_zero_and_a_late_reflector_joins() -> None:
    strength, drawn, residual = np.zeros((3, 9, 9))
    strength[4, 4], residual[0, 8] = 1, 0.2
    first = first_support(strength, drawn, 0.1)
    assert first.sum() == 9 and first[3:6, 3:6].all()
    drawn[0, 0], drawn[8, 0] = 1, 0.01
    assert first_support(strength, drawn, 0.1).sum() == 13  # four about what the first image shows
    later = next_support(strength, residual, 0.1)
    assert later.sum() == 13 and later[0, 8]  # nine about the bright pixel, four in the corner
    assert not next_support(strength, residual / 4, 0.1)[0, 8]
    assert next_support(np.ones((9, 9)), residual, 0.1).all()


def test_the_image_is_zero_outside_the_support() -> None:
    scans = scans_from(record([[0.05, 0.02]], [1], turn(24), noise=0.02), 0.3)
    result = fit(scans, ImageGrid(0.3, 40), AtsSettings(steps=30))
    dark = ~result.field.support
    assert dark.mean() > 0.7
    assert not result.image.values[dark].any()
    assert result.image.values[result.field.support].any()


@needs_torch
def test_the_gradient_is_that_of_the_loss_by_autograd(scans) -> None:
    shape = FieldShape((4, 9), features=3, width=5)
    weights, grid = draw_weights(shape, GRID, 3.0, seed=2), GridArrays.of(GRID, shape.cells)
    for bias in weights.biases:  # away from the kinks of ReLU at zero
        bias += 0.1
    fine = FineRange.of(scans, GRID.points)
    factors = np.exp(1j * RNG.uniform(0, 6, 24))
    confidence = RNG.uniform(0.2, 1, scans.samples.shape)
    light = RNG.uniform(0.3, 1, (24, GRID.pixels**2))
    views = view_arrays(scans, GRID.points, fine, confidence, factors, light)
    numbers = np.array([0, 1, 1, 3.0, 2e-3, 1e-3, 1e-8], dtype=np.float32)
    engine = TorchEngine(weights)
    loss = engine.step(grid, views, fine, numbers)
    count = len(engine._state) // 3
    written_out = [m / (1 - fit_torch.BETA1) for m in engine._state[count : 2 * count]]

    leaves = [
        torch.tensor(a, requires_grad=True) for a in (*weights.tables, *weights.weights, *weights.biases)
    ]
    tables, layers, biases = leaves[:2], leaves[2:4], leaves[4:]
    features = fit_torch.features(tables, [torch.from_numpy(a) for a in grid.interpolation])
    sigma = fit_torch.activations(features, layers, biases)[-1] * 3.0
    seen = torch.from_numpy(factors.astype(np.complex64))[:, None] * torch.complex(*sigma)
    seen = seen * torch.from_numpy(light).float()
    rows = matrix_of_nearest_bins(scans, fine) @ seen.reshape(24, -1, 1)
    residual = rows[:, :, 0] - torch.from_numpy(scans.samples)
    data = (torch.from_numpy(confidence).float() * 2e-3 * residual.abs().square()).sum()
    sparsity = 1e-3 * (sigma.square().sum(0) + (3.0 * fit_torch.MAGNITUDE_FLOOR) ** 2).sqrt().sum()
    total = data + sparsity
    total.backward()
    assert loss == pytest.approx(float(total.detach()), rel=1e-4)
    for mine, leaf in zip(written_out, leaves, strict=True):
        assert float((mine - leaf.grad).norm()) < 2e-3 * float(leaf.grad.norm()), leaf.shape


def matrix_of_nearest_bins(scans, fine):
    """(views, bins, points) complex: every point in the nearest fine bin, written out view by view."""
    points = np.column_stack([GRID.points, np.zeros(GRID.pixels**2)])
    real, imaginary = np.split(fine.spread, 2, axis=1)
    out = []
    for antenna in scans.aperture.positions:
        place = np.linalg.norm(points - antenna, axis=1) / fine.step - fine.offset
        out.append((real + 1j * imaginary)[place.astype(int)].T)
    return torch.from_numpy(np.stack(out).astype(np.complex64))


class NearestBins:
    """What `RangeGeometry` is to the native engine, with every point in the nearest bin."""

    def __init__(self, index: np.ndarray, bins: int) -> None:
        self.index, self.bins = index, bins

    def scatter(self, values: np.ndarray) -> np.ndarray:
        out = np.zeros((len(self.index), self.bins), np.complex64)
        for row, at in zip(out, self.index, strict=True):
            np.add.at(row, at, values)
        return out

    def gather(self, rows: np.ndarray) -> np.ndarray:
        return np.take_along_axis(rows, self.index.astype(np.intp), axis=1).sum(axis=0)


@needs_torch
def test_one_native_step_is_that_of_torch(scans) -> None:
    """Loss, gradient and update with the nearest bins of the graph in the place of the kernel's two."""
    shape = FieldShape((4, 9), features=3, width=5)
    weights = draw_weights(shape, GRID, 0.3, seed=2)
    fine = FineRange.of(scans, GRID.points)
    factors = np.exp(1j * RNG.uniform(0, 6, 24))
    confidence = RNG.uniform(0.2, 1, scans.samples.shape)
    views = view_arrays(scans, GRID.points, fine, confidence, factors).select(np.arange(0, 24, 2))
    views.__dict__["geometry"] = NearestBins(views.index, len(fine.spread))
    numbers = np.array([0, 1, 1, 0.3, 1, 1e-3, 0.1], np.float32)
    arrays = GridArrays.of(GRID, shape.cells)
    torch_engine, native = TorchEngine(weights), NativeEngine(weights)
    losses = [engine.step(arrays, views, fine, numbers) for engine in (torch_engine, native)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)
    count = len(native._state)
    for first, other in zip(torch_engine._state[count : 2 * count], native._first, strict=True):
        assert np.linalg.norm(first.numpy() - other) < 1e-3 * np.linalg.norm(other)  # of Adam: the gradient
    moving = np.array([0.06, 10, 20, 0.3, 1, 1e-3, 0.1], np.float32)
    for engine in (torch_engine, native):
        engine.step(arrays, views, fine, moving)
    after = [engine.weights() for engine in (torch_engine, native)]
    for name in ("tables", "weights", "biases"):
        for start, first, other in zip(*(getattr(w, name) for w in (weights, *after)), strict=True):
            assert np.linalg.norm(first - other) < 2e-3 * np.linalg.norm(first - start)


@needs_torch
def test_the_manifest_has_the_shapes_of_the_step() -> None:
    """A step that was changed without exporting it again shows here, and in the image compared above."""
    from train.ats_step import dimensions

    entry = manifest()["ats_step"]
    shapes = dimensions()
    assert {**entry.inputs, **entry.outputs} == {
        name: shapes[name] for name in (*entry.inputs, *entry.outputs)
    }
