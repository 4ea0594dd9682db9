"""The forward operator: shapes, its matrix, its norm, and the model against the recorded echo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from imaging_scenes import helix, record, turn

from tagid.errors import UsageError
from tagid.geometry import ImageGrid
from tagid.imaging import memory
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import PreprocessSettings, preprocess

GRID = ImageGrid(0.4, 24)
POINTS = np.array([[0.1, 0.05], [-0.12, 0.0], [0.03, -0.17]])
APERTURES = {"turntable": turn(20), "raised": turn(20, 1.1, 0.4), "free": helix(20)}


def scans_of(aperture, points=POINTS, amplitudes=(1.0, 2.0, 0.5), matched=True):
    settings = PreprocessSettings(background="none", matched_filter=matched)
    return preprocess(record(points, list(amplitudes), aperture), settings=settings)


@pytest.fixture(params=list(APERTURES))
def aperture(request):
    return APERTURES[request.param]


@pytest.fixture(params=["grid", "points", "some views"])
def operator(request, aperture):
    scans = scans_of(aperture)
    if request.param == "points":
        return ForwardOperator(scans, POINTS)
    whole = ForwardOperator(scans, GRID)
    return whole if request.param == "grid" else whole.select(np.array([19, 3, 3, 11]))


def complex_noise(rng, shape):
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)


def test_shapes_and_dtypes(operator):
    y = operator.forward(np.ones(operator.points))
    assert y.dtype == np.complex64
    assert y.shape == (operator.views, operator.bins)
    assert operator.adjoint(y).dtype == np.complex64
    assert operator.adjoint(y.ravel()).shape == (operator.points,)
    assert operator.shape == (y.size, operator.points)


def test_the_matrix_is_the_operator(operator):
    rng = np.random.default_rng(2)
    x = complex_noise(rng, operator.points)
    assert operator.matrix.shape == operator.shape
    assert operator.matrix.dtype == np.complex64
    y = operator.forward(x).ravel()
    assert np.abs(operator.matrix @ x - y).max() < 1e-5 * np.abs(y).max()
    gather, spread = operator.stages
    two = (gather @ x).reshape(operator.views, -1) @ spread
    assert np.abs(two.ravel() - y).max() < 1e-5 * np.abs(y).max()


def test_norm_bounds_the_operator(operator):
    norm = operator.norm_squared(iterations=60)
    largest = np.linalg.svd(operator.matrix.toarray(), compute_uv=False)[0] ** 2
    assert norm == pytest.approx(largest, rel=0.02)
    assert operator.norm_squared() == operator.norm_squared()


@pytest.mark.parametrize("matched", [True, False])
def test_forward_of_points_is_the_recorded_echo(aperture, matched):
    """Against the time-domain formula through the whole preprocessing."""
    amplitudes = np.array([1.0, 2.0, 0.5])
    scans = scans_of(aperture, matched=matched)
    model = ForwardOperator(scans, POINTS).forward(amplitudes)
    assert np.abs(model - scans.samples).max() < 0.01 * np.abs(scans.samples).max()


def test_turning_the_object_is_turning_the_aperture_back(aperture):
    """Object turned by +a seen from the aperture = object as it was seen from the aperture turned by -a."""
    a = 0.3
    rotation = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    scans = scans_of(aperture)
    back = aperture.positions.copy()
    back[:, :2] = back[:, :2] @ rotation  # rows times R(a) turn by -a
    turned = ForwardOperator(scans, POINTS @ rotation.T).forward(np.ones(3))
    moved = replace(scans, aperture=type(aperture)(back))
    assert np.abs(turned - ForwardOperator(moved, POINTS).forward(np.ones(3))).max() < 0.02


def test_a_turn_is_a_shift_of_the_angles():
    """The object's own sign: turned by +a it looks as it will look a later on the table."""
    scans = scans_of(turn(36))
    a = 2 * np.pi / 36
    rotation = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    now = ForwardOperator(scans, POINTS @ rotation.T).forward(np.ones(3))
    later = np.roll(ForwardOperator(scans, POINTS).forward(np.ones(3)), -1, axis=0)
    assert np.abs(now - later).max() < 0.02


def test_chosen_views_are_rows_of_the_whole(aperture):
    whole = ForwardOperator(scans_of(aperture), GRID)
    x = complex_noise(np.random.default_rng(3), whole.points)
    for views in (slice(1, None, 3), np.array([18, 2, 17])):
        assert np.allclose(whole.select(views).forward(x), whole.forward(x)[views], atol=1e-4)


def test_too_large_is_refused_before_memory_is_taken(monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: 100_000)
    with pytest.raises(UsageError, match="GB") as caught:
        ForwardOperator(scans_of(turn(20)), GRID)
    assert "fewer views" in caught.value.remedy


@pytest.mark.parametrize("points", [np.zeros((0, 2)), np.zeros((4, 3)), np.zeros(4), np.full((2, 2), np.nan)])
def test_points_must_be_points(points):
    with pytest.raises(UsageError, match="points"):
        ForwardOperator(scans_of(turn(20)), points)
