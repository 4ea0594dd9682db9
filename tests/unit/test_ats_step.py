"""The written-out step of torch against autograd, and the shapes of the exported graph."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the reference engine needs the extra 'ats'")

from imaging_scenes import record, scans_from, turn  # noqa: E402

from tagid.geometry import ImageGrid  # noqa: E402
from tagid.imaging.ats import fit_torch  # noqa: E402
from tagid.imaging.ats.fit_native import NativeEngine  # noqa: E402
from tagid.imaging.ats.fit_torch import TorchEngine  # noqa: E402
from tagid.imaging.ats.problem import (  # noqa: E402
    FieldShape,
    FineRange,
    GridArrays,
    draw_weights,
    view_arrays,
)
from tagid.imaging.operator import ForwardOperator  # noqa: E402

GRID = ImageGrid(0.3, 20)
SHAPE = FieldShape((4, 9), features=3, width=5, channels=3)
RNG = np.random.default_rng(4)


@pytest.fixture(scope="module")
def scans():
    points, amplitudes = [[0.05, -0.08], [-0.1, 0.02]], [1.0, 0.6j]
    capture = record(points, amplitudes, turn(24), analytic=True, noise=0.05, seed=1)
    return scans_from(capture, 0.3)


def problem(scans):
    weights = draw_weights(SHAPE, GRID, 3.0, seed=2)
    for bias in weights.biases:  # away from the kinks of ReLU at zero
        bias += 0.1
    fine = FineRange.of(scans, GRID.points)
    aspect = np.exp(1j * RNG.uniform(0, 6, (24, 3)))
    confidence = RNG.uniform(0.2, 1, scans.samples.shape)
    shadow = RNG.uniform(0.3, 1, (24, GRID.pixels**2))
    return weights, GridArrays.of(GRID, SHAPE.cells), fine, aspect, confidence, shadow


def test_the_gradient_is_that_of_the_loss_by_autograd(scans) -> None:
    weights, grid, fine, aspect, confidence, shadow = problem(scans)
    views = view_arrays(scans, GRID.points, fine, confidence, aspect, shadow)
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
    channels = torch.complex(sigma[:3], sigma[3:])
    seen = torch.complex(*(torch.zeros(24, GRID.pixels**2) for _ in range(2)))
    seen = torch.from_numpy(aspect.astype(np.complex64)) @ channels * torch.from_numpy(shadow).float()
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


def test_nearest_bins_are_the_operator_to_a_percent_and_a_half(scans) -> None:
    fine = FineRange.of(scans, GRID.points)
    x = (RNG.standard_normal(400) + 1j * RNG.standard_normal(400)).astype(np.complex64)
    mine = (matrix_of_nearest_bins(scans, fine) @ torch.from_numpy(x)).numpy()
    truth = ForwardOperator(scans, GRID).forward(x)
    assert np.linalg.norm(mine - truth) < 0.02 * np.linalg.norm(truth)


class NearestBins:
    """What `RangeGeometry` is to the native engine, with every point in the nearest bin."""

    def __init__(self, index: np.ndarray, bins: int) -> None:
        self.index, self.bins = index, bins

    def scatter(self, values: np.ndarray, light: np.ndarray | None = None) -> np.ndarray:
        out = np.zeros((len(self.index), self.bins), np.complex64)
        for view, (row, at) in enumerate(zip(out, self.index, strict=True)):
            np.add.at(row, at, values if light is None else light[view] @ values)
        return out

    def gather(self, rows: np.ndarray, light: np.ndarray | None = None) -> np.ndarray:
        result = np.take_along_axis(rows, self.index.astype(np.intp), axis=1)
        return result.sum(axis=0) if light is None else light.T @ result


@pytest.mark.parametrize("harmonics", [0, 1])
def test_one_native_step_is_that_of_torch(scans, harmonics) -> None:
    """Loss, gradient and update with the nearest bins of the graph in the place of the kernel's two."""
    shape = FieldShape((4, 9), features=3, width=5, channels=2 * harmonics + 1)
    weights = draw_weights(shape, GRID, 0.3, seed=2)
    fine = FineRange.of(scans, GRID.points)
    aspect = np.exp(1j * RNG.uniform(0, 6, (24, shape.channels)))
    confidence = RNG.uniform(0.2, 1, scans.samples.shape)
    views = view_arrays(scans, GRID.points, fine, confidence, aspect).select(np.arange(0, 24, 2))
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


def test_the_manifest_has_the_shapes_of_the_step() -> None:
    """A step that was changed without exporting it again shows here, and in the image compared above."""
    from tagid.models_store import manifest
    from train.ats_step import dimensions

    entry = manifest()["ats_step"]
    shapes = dimensions()
    assert {**entry.inputs, **entry.outputs} == {
        name: shapes[name] for name in (*entry.inputs, *entry.outputs)
    }
