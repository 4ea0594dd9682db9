"""One suite for what runs the steps of a fit: numpy with compiled kernels, onnxruntime and torch."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import numpy as np
import pytest

from tagid.errors import MissingExtraError, UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.ats import fit as fit_module
from tagid.imaging.ats.fit import fit, make_engine
from tagid.imaging.ats.problem import FieldShape, FineRange, GridArrays, draw_weights, view_arrays
from tagid.imaging.ats.settings import AtsSettings
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tests.unit.imaging_scenes import record, turn

GRID = ImageGrid(0.3, 20)
POINTS = [[0.05, -0.08], [-0.1, 0.02]]
TORCH = importlib.util.find_spec("torch") is not None
needs_torch = pytest.mark.skipif(not TORCH, reason="needs torch, of the extra 'ats'")


@pytest.fixture(scope="module")
def scans() -> BasebandScans:
    capture = record(POINTS, [1.0, 0.6j], turn(24), analytic=True, noise=0.05, seed=1)
    return preprocess(capture, settings=PreprocessSettings("none", False, extent_m=GRID.extent))


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
    shape = FieldShape.of(GRID, scans.wavelength_m, 1)
    weights = draw_weights(shape, GRID, 0.3, seed=2)
    engine = make_engine(weights, settings)
    fine = FineRange.of(scans, GRID.points, between=engine.name == "native")
    ones = np.ones(scans.samples.shape), np.ones((24, 1), dtype=complex)
    views = view_arrays(scans, GRID.points, fine, *ones, np.ones((24, GRID.pixels**2), np.float32))
    numbers = np.array([0, 1, 1, 0.3, 1, 0, 1e-8], dtype=np.float32)
    loss = engine.step(GridArrays.of(GRID, shape.cells), views, fine, numbers)
    residual = ForwardOperator(scans, GRID).forward(weights.image().ravel()) - scans.samples
    assert loss == pytest.approx(float(np.vdot(residual, residual).real), rel=0.02)
    # The rate is zero: a step changes nothing.
    for before, after in zip(weights.arrays, engine.weights().arrays, strict=True):
        np.testing.assert_array_equal(before, after)


def test_shadows_and_aspect_are_in_every_engine(scans, settings) -> None:
    rich = {"aspect_harmonics": 1, "occlusion": 0.3, "robust": 3.0, "steps": 30}
    remaining = fit(scans, GRID, replace(settings, **rich)).held_out
    reference = fit(scans, GRID, AtsSettings(engine="onnx", seed=3, **rich)).held_out
    assert remaining == pytest.approx(reference, rel=0.2)


def test_auto_is_the_fastest_engine_that_is_there(scans, monkeypatch) -> None:
    monkeypatch.setattr(fit_module, "is_compiled", lambda: True)
    assert fit(scans, GRID, AtsSettings(steps=2)).image.settings["engine"] == "native"
    monkeypatch.setattr(fit_module, "is_compiled", lambda: False)
    assert fit(scans, GRID, AtsSettings(steps=2)).image.settings["engine"] == "onnx"


@needs_torch
def test_a_device_that_is_not_there_is_named(scans) -> None:
    import torch

    if not torch.cuda.is_available():
        with pytest.raises(UsageError, match="cuda"):
            fit(scans, GRID, AtsSettings(steps=2, device="cuda"))
    with pytest.raises(UsageError, match="device"):
        fit(scans, GRID, AtsSettings(steps=2, device="abacus"))


def test_a_missing_engine_is_named(scans, monkeypatch) -> None:
    monkeypatch.setattr(fit_module.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="torch"):
        fit(scans, GRID, AtsSettings(steps=2, engine="torch"))


@needs_torch
def test_cuda_gives_the_image_of_the_processor(scans) -> None:
    import torch

    if not torch.cuda.is_available():
        pytest.skip("there is no CUDA device")
    images = [fit(scans, GRID, AtsSettings(engine="torch", device=d)).image.values for d in ("cpu", "cuda")]
    assert np.linalg.norm(images[0] - images[1]) < 0.02 * np.linalg.norm(images[0])
