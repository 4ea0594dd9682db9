"""The prior follows the data: other priors are tried where unseen views ask for them, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tagid.geometry import ImageGrid
from tagid.imaging.ats.adapt import (
    ITERATIONS,
    changes_of,
    fit_adapted,
    folds,
    linear_image,
    linear_iterations,
)
from tagid.imaging.ats.settings import AtsSettings
from tagid.imaging.heldout import check, left_out
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tests.unit.imaging_scenes import record, turn

GRID = ImageGrid(0.3, 40)
QUICK = AtsSettings(steps=40)


def outline(views: int, phases: np.ndarray, power: float, radii: tuple[float, float]) -> BasebandScans:
    """Scans of an ellipse of scatterers, each seen by the cosine of its aspect to that power."""
    t = np.arange(len(phases)) * 2 * np.pi / len(phases)
    points = np.column_stack([radii[0] * np.cos(t), radii[1] * np.sin(t)])
    normals = np.column_stack([np.cos(t) / radii[0], np.sin(t) / radii[1]])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    aperture = turn(views)
    rows = []
    for view in range(views):
        sight = aperture.positions[view, :2] - points
        facing = (sight * normals).sum(axis=1) / np.linalg.norm(sight, axis=1)
        seen = phases * np.where(facing > 0, np.maximum(facing, 0) ** power, 0)
        one = aperture.select(np.array([view]))
        rows.append(record(points, seen, one, start_m=0.4, analytic=True).samples)
    whole = record(points, phases, aperture, start_m=0.4, analytic=True)
    return preprocess(
        replace(whole, samples=np.vstack(rows)),
        settings=PreprocessSettings("none", False, extent_m=GRID.extent),
    )


def rough(views: int = 60) -> BasebandScans:
    """An outline of random phases, each part seen only where it faces the antenna."""
    rng = np.random.default_rng(4)
    return outline(views, np.exp(2j * np.pi * rng.random(64)), 1.0, (0.11, 0.07))


def smooth(views: int = 60) -> BasebandScans:
    """A smooth round body about the axis' neighbourhood: its echo comes from the nearest wall."""
    return outline(views, np.ones(96), 1.0, (0.05, 0.055))


def residual_of(scans: BasebandScans, prior: str) -> tuple[float, float]:
    """Residual of a prior, and of backprojection, on views that took no part in its choice."""
    iterations = linear_iterations(prior)
    settings = replace(AtsSettings(adapt=0, held_out=0.0), **changes_of(prior))

    def make(some: BasebandScans):  # type: ignore[no-untyped-def]
        if iterations is not None:
            return linear_image(some, GRID, iterations)
        return fit_adapted(some, GRID, settings).image

    found = check(scans, scans, GRID, make)
    assert found is not None
    return found.residual, found.backprojection


@pytest.mark.parametrize("scene", [rough, smooth])
def test_an_extended_body_gets_a_prior_that_predicts_better(scene) -> None:
    scans = scene()
    settings = fit_adapted(scans, GRID, AtsSettings()).image.settings
    tried, chosen = settings["prior_trials"], settings["prior"]
    assert {"default", *(f"linear {k}" for k in (0, *ITERATIONS))} <= set(tried)
    assert tried[chosen] <= 1.05 * min(tried.values())
    for name, value in changes_of(chosen).items():
        assert settings[name] == value
    mine, backprojection = residual_of(scans, chosen)
    assert mine < backprojection + 1e-3
    assert mine < residual_of(scans, "default")[0] + 0.02


def test_where_nothing_predicts_clearly_better_the_image_is_backprojection() -> None:
    """Noise alone, said to be little: no scene is behind it."""
    rng = np.random.default_rng(1)
    scans = smooth(24)
    noise = rng.standard_normal((2, *scans.samples.shape)) * np.abs(scans.samples).max()
    samples = (noise[0] + 1j * noise[1]).astype(np.complex64)
    image = fit_adapted(replace(scans, samples=samples, noise_std=0.0), GRID, QUICK).image
    assert image.settings["prior"] in ("linear 0", "linear 1")
    iterations = linear_iterations(image.settings["prior"])
    assert iterations is not None
    expected = linear_image(replace(scans, samples=samples), GRID, iterations)
    np.testing.assert_array_equal(image.values, expected.values)


def test_points_keep_the_default_prior_without_a_trial() -> None:
    scans = preprocess(
        record([[0.05, 0.02], [-0.06, 0.01]], [1, 1], turn(36), noise=0.02),
        settings=PreprocessSettings("none", False, extent_m=GRID.extent),
    )
    assert "prior" not in fit_adapted(scans, GRID, AtsSettings()).image.settings


def test_points_at_twelve_views_keep_the_default_prior() -> None:
    """Too few views to hold one out of every fit: the default is tried on groups of views first."""
    scans = preprocess(
        record([[0.05, 0.02], [-0.06, 0.01]], [1, 1], turn(12), noise=0.02),
        settings=PreprocessSettings("none", False, extent_m=GRID.extent),
    )
    assert fit_adapted(scans, GRID, AtsSettings()).image.settings.get("prior", "default") == "default"


def test_a_prior_given_by_hand_is_not_changed() -> None:
    scans = rough(24)
    for settings in (AtsSettings(steps=5, adapt=0), AtsSettings(steps=5, l1=0.1)):
        assert "prior" not in fit_adapted(scans, GRID, settings).image.settings


@pytest.mark.parametrize("views", [8, 11, 33, 110, 330])
def test_groups_of_views_do_not_overlap_and_are_spread(views: int) -> None:
    groups = folds(views)
    together = np.concatenate(groups)
    assert len(np.unique(together)) == len(together) >= min(8, views - 2)
    for group in groups:
        assert len(group) <= max(2, views / 8)
        assert np.diff(group).max() <= 1.6 * views / len(group)


def test_the_views_of_the_last_judgement_take_no_part_in_the_choice() -> None:
    """Whatever they hold, the same prior is chosen."""
    scans = rough(36)
    wild = scans.samples.copy()
    wild[left_out(36)] *= -3j
    trials = [
        fit_adapted(replace(scans, samples=s), GRID, QUICK).image.settings.get("prior_trials")
        for s in (scans.samples, wild)
    ]
    assert trials[0] is not None
    assert trials[0] == trials[1]
