"""The published model: geometry, physics, encoding and network by hand calculation, and its fit converges."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tagid.geometry import Aperture, ImageGrid  # noqa: E402
from tagid.imaging.ats.fit_paper import (  # noqa: E402
    EncodingSettings,
    PaperSettings,
    RaySamples,
    encoding_matrix,
    fit_paper,
    interpolate,
    level_sizes,
    sample_view,
    synthesize_profile,
    vertex_entry,
)
from tests.unit.imaging_scenes import record, scans_from, turn  # noqa: E402

GRID = ImageGrid(0.3, 40)


@pytest.mark.parametrize("height", [0.0, 0.4])
def test_samples_lie_on_spheres_in_the_plane_and_in_the_beam(height: float) -> None:
    aperture = Aperture.turntable(np.array([0.7]), 1.0, height)
    radii = np.linspace(0.8, 1.3, 60)
    rays = sample_view(aperture, 0, GRID, radii, 0.02, np.deg2rad(60))
    kept = rays.weights > 0
    assert kept.any() and (rays.depths[kept] > 0).all()
    distance = np.linalg.norm(np.dstack([rays.points, np.zeros(kept.shape)]) - aperture.positions[0], axis=2)
    np.testing.assert_allclose(distance[kept], np.broadcast_to(radii, kept.shape)[kept])
    assert (np.abs(rays.points[kept]) < GRID.extent / 2).all()
    # Arc lengths of a sphere's neighbours fill the scene's width: their sum is the chord within it.
    middle = int(np.argmin(np.abs(radii - np.hypot(1.0, height))))
    assert 0.25 < rays.weights[:, middle].sum() < 0.45


def one_ray(bins: int = 6) -> RaySamples:
    depths = np.tile(0.5 + 0.1 * np.arange(bins), (3, 1))
    return RaySamples(np.zeros((3, bins, 2)), depths, np.ones((3, bins)) * np.array([[0], [1], [0]]), 0.01)


def test_transmission_is_the_running_product_squared() -> None:
    sigma = torch.zeros((3, 6), dtype=torch.complex64)
    sigma[1, 1], sigma[1, 4] = 2.0, 1j
    full = synthesize_profile(sigma, one_ray(), lambert_floor=1.0, opacity=1.0)
    # |sigma| dl = 0.2 before the second: T = exp(-0.2), squared.
    assert abs(complex(full[1]) - 2.0) < 1e-3
    assert abs(complex(full[4]) - 1j * np.exp(-0.4)) < 2e-3
    open_scene = synthesize_profile(sigma, one_ray(), lambert_floor=1.0, opacity=0.0)
    assert abs(complex(open_scene[4]) - 1j) < 1e-3


def test_lambert_dims_what_is_seen_from_the_side() -> None:
    rays = RaySamples(np.zeros((9, 9, 2)), np.tile(0.5 + 0.02 * np.arange(9), (9, 1)), np.ones((9, 9)), 0.04)
    ahead = torch.zeros((9, 9), dtype=torch.complex64)
    ahead[:, 4:] = 50.0
    aside = torch.zeros((9, 9), dtype=torch.complex64)
    aside[4:] = 50.0
    facing = synthesize_profile(ahead, rays, 0.1, 0.0).abs()[4] / 9
    edge = synthesize_profile(aside, rays, 0.1, 0.0).abs()[4] / 5
    assert float(facing) > 0.7 * 50
    assert float(edge) < 0.2 * 50


def test_the_fit_converges_on_a_simulated_point_and_repeats() -> None:
    scans = scans_from(record([[0.04, -0.03]], [1.0], turn(18)), GRID.extent)
    before = torch.random.get_rng_state()
    image = fit_paper(scans, GRID, PaperSettings(steps=50, views_per_step=9))
    assert torch.equal(before, torch.random.get_rng_state()), "the global random state is left alone"
    assert image.settings["loss"] < 0.5 * image.settings["loss_first"]
    magnitude = np.abs(image.values)
    x, y = np.meshgrid(GRID.axis, GRID.axis)
    near = np.hypot(x - 0.04, y + 0.03) < 0.015
    assert magnitude[near].max() > 0.6 * magnitude.max()
    assert np.median(magnitude) < 0.2 * magnitude[near].max()
    again = fit_paper(scans, GRID, PaperSettings(steps=2))
    np.testing.assert_array_equal(again.values, fit_paper(scans, GRID, PaperSettings(steps=2)).values)


def vertices(cells: int) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(cells + 1), np.arange(cells + 1)), -1).reshape(-1, 2)


def test_dense_levels_interpolate_linearly() -> None:
    """Vertices that hold their places: every level gives a point its place."""
    settings = EncodingSettings(levels=3, features=2, coarsest=4, finest=40)
    points = np.random.default_rng(0).uniform(0, 1, (50, 2))
    points[:4] = [[0, 0], [1, 1], [0, 1], [0.5, 0.25]]
    tables = []
    for cells, size in zip(settings.resolutions(), level_sizes(settings), strict=True):
        tables.append(np.zeros((size, 2), np.float32))
        tables[-1][vertex_entry(vertices(cells), cells, settings)] = vertices(cells) / cells
    matrix = encoding_matrix(points, settings)
    features = interpolate(torch.from_numpy(np.concatenate(tables)), matrix, matrix.T, settings)
    np.testing.assert_allclose(features.numpy(), np.tile(points, 3), atol=1e-6)


def test_dense_levels_have_no_collisions_and_hashed_ones_stay_in_their_table() -> None:
    settings = EncodingSettings(levels=2, coarsest=8, finest=100, log2_entries=8)
    assert sorted(vertex_entry(vertices(8), 8, settings)) == list(range(81))
    hashed = vertex_entry(vertices(100), 100, settings)
    assert hashed.min() >= 0 and hashed.max() < 256
    assert len(set(hashed)) > 200
    assert level_sizes(settings) == [81, 256]


def test_encoding_gradient_is_the_transpose() -> None:
    settings = EncodingSettings(levels=3, features=2, coarsest=4, finest=16, log2_entries=6)
    points = np.random.default_rng(2).uniform(0, 1, (20, 2))
    matrix = encoding_matrix(points, settings)
    table = torch.zeros(sum(level_sizes(settings)), 2, requires_grad=True)
    weight = torch.rand(20, settings.width, generator=torch.Generator().manual_seed(1))
    (interpolate(table, matrix, matrix.T, settings) * weight).sum().backward()
    expected = matrix.T @ weight.numpy().reshape(-1, settings.features)
    np.testing.assert_allclose(table.grad.numpy(), expected, rtol=1e-5, atol=1e-6)
