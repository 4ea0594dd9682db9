"""The published model: its geometry and its physics against hand calculation, and that its fit converges."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tagid.geometry import Aperture, ImageGrid  # noqa: E402
from tagid.imaging.ats.fit_paper import (  # noqa: E402  # noqa: E402
    PaperSettings,
    RaySamples,
    fit_paper,
    positive_root,
    sample_view,
    synthesize_profile,
)
from tagid.imaging.preprocess import PreprocessSettings, preprocess  # noqa: E402
from tests.unit.imaging_scenes import record, turn  # noqa: E402

GRID = ImageGrid(0.3, 40)


def test_the_positive_root_lies_on_the_sphere() -> None:
    start = np.array([0.1, -0.2, 0.3])
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((5, 3))
    radii = np.array([0.5, 0.9, 2.0])
    depth = positive_root(start, directions, radii)
    on = start + depth[:, :, None] * directions[:, None]
    np.testing.assert_allclose(np.linalg.norm(on, axis=2), np.broadcast_to(radii, (5, 3)))
    assert (depth > 0).all()
    assert np.isnan(positive_root(np.array([0.0, 0.0, 2.0]), np.array([[1.0, 0.0, 0.0]]), radii[:1])).all()


@pytest.mark.parametrize("height", [0.0, 0.4])
def test_samples_lie_on_spheres_in_the_plane_and_in_the_beam(height: float) -> None:
    aperture = Aperture.turntable(np.array([0.7]), 1.0, height)
    radii = np.linspace(0.8, 1.3, 60)
    rays = sample_view(aperture, 0, GRID, radii, 0.02, np.deg2rad(60))
    kept = rays.weights > 0
    assert kept.any()
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
    scans = preprocess(
        record([[0.04, -0.03]], [1.0], turn(18)),
        settings=PreprocessSettings("none", False, extent_m=GRID.extent),
    )
    settings = PaperSettings(steps=50, views_per_step=9)
    image = fit_paper(scans, GRID, settings)
    assert image.settings["loss"] < 0.5 * image.settings["loss_first"]
    magnitude = np.abs(image.values)
    x, y = np.meshgrid(GRID.axis, GRID.axis)
    near = np.hypot(x - 0.04, y + 0.03) < 0.015
    assert magnitude[near].max() > 0.6 * magnitude.max()
    assert np.median(magnitude) < 0.2 * magnitude[near].max()
    again = fit_paper(scans, GRID, PaperSettings(steps=2))
    np.testing.assert_array_equal(again.values, fit_paper(scans, GRID, PaperSettings(steps=2)).values)
