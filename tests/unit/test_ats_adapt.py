"""Coupled pixels, a Gaussian prior whose variance neighbours share, and the prior that follows the data: they
take the field's place where unseen views ask for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.geometry import ImageGrid
from tagid.imaging.ats.adapt import ASKS, ENOUGH, fit_adapted, settings_of
from tagid.imaging.ats.fit import fit
from tagid.imaging.ats.problem import FirstImages
from tagid.imaging.ats.settings import AtsSettings, FitSettings
from tagid.imaging.backprojection import backproject
from tagid.imaging.coupled import coupled_recovery, damped
from tagid.imaging.facts import facts_of
from tagid.imaging.heldout import left_out, residual
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import select_views
from tagid.imaging.sparse import sparse_recovery
from tagid.imaging.types import BasebandScans
from tagid.operate.words import COUPLED_PIXELS, learned_words, method_shown
from tagid.pipeline.reconstruct import reconstruct
from tagid.pipeline.settings import ImagingSettings
from tests.unit.imaging_scenes import record, scans_from, turn

GRID = ImageGrid(0.3, 40)
COARSE = ImageGrid(0.3, 6)
QUICK = AtsSettings(steps=40)


def arc(views: int, noise: float = 0.0) -> BasebandScans:
    """Scans of a third of a circle of 8 cm, of points a sixth of a wavelength apart."""
    t = np.linspace(0, 2 * np.pi / 3, 14)
    points = 0.08 * np.column_stack([np.cos(t), np.sin(t)])
    phases = np.exp(2j * np.pi * np.random.default_rng(1).random(14))
    return scans_from(record(points, phases, turn(views), noise=noise, analytic=True), GRID.extent)


def test_conjugate_gradients_solve_the_damped_normal_equations() -> None:
    scans = arc(20)
    operator = ForwardOperator(scans, COARSE)
    units = (operator.among(np.arange(operator.points) == point) for point in range(operator.points))
    dense = np.stack([unit.forward(np.ones(1)).ravel() for unit in units], axis=1).astype(np.complex128)
    root = np.linspace(0.2, 1.0, operator.points).astype(np.float32)
    damping = 0.05 * float(np.linalg.norm(dense, 2) ** 2)
    scaled = dense * root
    right = scaled.conj().T @ scans.samples.ravel()
    direct = np.linalg.solve(scaled.conj().T @ scaled + damping * np.eye(len(right)), right)
    mine = damped(operator, scans.samples, root, damping)
    assert np.linalg.norm(mine - direct) < 0.02 * np.linalg.norm(direct)


@pytest.mark.parametrize("views", [24, 36])
def test_views_between_are_predicted_where_sparse_pixels_predict_half(views: int) -> None:
    scans, between = arc(views, noise=0.1), arc(180)
    remaining = residual(between, coupled_recovery(scans, GRID))
    assert remaining < 0.5 * residual(between, sparse_recovery(scans, GRID))


def test_noise_that_is_known_is_not_imaged_and_silence_neither() -> None:
    scans, between = arc(36, noise=2.0), arc(180)
    unaware = replace(scans, noise_std=0.0)
    remaining = residual(between, coupled_recovery(scans, GRID))
    assert remaining < 0.5 * residual(between, coupled_recovery(unaware, GRID))
    assert not coupled_recovery(replace(scans, samples=0 * scans.samples), GRID).values.any()


def test_a_point_keeps_its_amplitude_and_its_place() -> None:
    """Its echo is spread over a resolution cell, whose sum it is."""
    amplitude = 2.0 * np.exp(0.4j)
    scans = scans_from(record([[0.05, -0.03]], [amplitude], turn(36), analytic=True), GRID.extent)
    values = coupled_recovery(scans, GRID).values.ravel()
    away = np.hypot(*(GRID.points - [0.05, -0.03]).T)
    assert away[np.abs(values).argmax()] < GRID.step
    assert values[away < 0.02].sum() == pytest.approx(amplitude, rel=0.15)


def facing(points: np.ndarray, normals: np.ndarray, phases: np.ndarray, views: int) -> Capture:
    """A turn of scatterers, each seen only where its side faces the antenna."""
    normals = normals / np.linalg.norm(normals, axis=1)[:, None]
    aperture = turn(views)
    sight = aperture.positions[:, None, :2] - points
    cosine = (sight * normals).sum(axis=2) / np.linalg.norm(sight, axis=2)
    rows = [
        record(points, phases * seen, aperture.select(np.array([view])), start_m=0.4, analytic=True).samples
        for view, seen in enumerate(np.maximum(cosine, 0))
    ]
    whole = record(points, phases, aperture, start_m=0.4, analytic=True)
    return replace(whole, samples=np.vstack(rows))


def faced(points: np.ndarray, normals: np.ndarray, phases: np.ndarray, views: int) -> BasebandScans:
    return scans_from(facing(points, normals, phases, views), GRID.extent)


@cache
def rough(views: int) -> BasebandScans:
    """Scans of an ellipse of 64 scatterers of random phase, each seen only where it faces the antenna."""
    phases = np.exp(2j * np.pi * np.random.default_rng(4).random(64))
    t = np.arange(64) * 2 * np.pi / 64
    points = np.column_stack([0.11 * np.cos(t), 0.07 * np.sin(t)])
    return faced(points, np.column_stack([np.cos(t) / 0.11, np.sin(t) / 0.07]), phases, views)


def flat_sides(views: int) -> BasebandScans:
    """Scans of a square of 24 cm whose sides flash: a few views hold most of the energy."""
    along = np.linspace(-0.12, 0.12, 25)
    side = np.column_stack([np.full(25, 0.12), along])
    turns = [np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]
    points = np.vstack([side @ turn.T for turn in turns])
    normals = np.vstack([np.tile(turn @ [1.0, 0.0], (25, 1)) for turn in turns])
    return faced(points, normals, np.ones(100, dtype=complex), views)


def two_cans(views: int) -> BasebandScans:
    """Scans of two circles of 3 cm, 20 cm apart, of which each point is seen where it faces the antenna."""
    t = np.arange(48) * 2 * np.pi / 48
    out = np.column_stack([np.cos(t), np.sin(t)])
    points = np.vstack([0.03 * out + [0.1, 0.01], 0.03 * out - [0.1, 0]])
    return faced(points, np.vstack([out, out]), np.ones(96, dtype=complex), views)


@pytest.mark.parametrize("views", [12, 36])
def test_points_keep_the_default_prior_without_a_trial_and_all_views_are_fitted(views: int) -> None:
    scans = scans_from(
        record([[0.07, 0.03], [-0.06, 0.01], [0.01, -0.08]], [1, 1, 1], turn(views), noise=0.1), GRID.extent
    )
    image = fit_adapted(scans, GRID, AtsSettings()).image
    assert "prior" not in image.settings
    np.testing.assert_array_equal(image.values, fit(scans, GRID, AtsSettings()).image.values)


def test_of_a_scene_that_points_explain_nearly_the_better_prior_is_taken() -> None:
    scans, between = arc(60), arc(180)
    result, field = fit_adapted(scans, GRID, AtsSettings()), fit(scans, GRID, AtsSettings())
    assert ENOUGH < field.held_out < ASKS
    assert result.image.settings["prior"] == "coupled"
    assert residual(between, result.image) < 0.5 * residual(between, field.image)


def test_an_extended_scene_is_shown_about_the_axis_that_the_fit_has_learned() -> None:
    scans = rough(36)
    result = fit_adapted(scans, GRID, replace(QUICK, calibrate=("axis",)))
    learned = scans.with_aperture(result.calibration.aperture(scans.aperture))
    assert result.calibration.offset_m != 0
    np.testing.assert_array_equal(result.image.values, coupled_recovery(learned, GRID).values)


@pytest.mark.parametrize("beside", [{"robust": 3.0}, {"spreading": 2.0}, {"calibrate": ("gain",)}])
def test_what_is_weighed_or_learned_beside_the_scene_is_a_fields(beside: dict[str, Any]) -> None:
    result = fit_adapted(rough(36), GRID, AtsSettings(steps=20, **beside))
    assert "prior" not in result.image.settings and result.field is not None


def test_every_view_takes_part_often_enough_for_a_scene_whose_views_differ() -> None:
    """Of a dozen views a step the flashes of flat sides pull the field to and fro until the steps end."""
    scans = flat_sides(240)
    made = fit_adapted(scans, GRID, AtsSettings()).image.settings
    assert made["views_per_step"] == 24
    unseen = left_out(240)
    seen = select_views(scans, np.setdiff1d(np.arange(240), unseen))
    plain = residual(select_views(scans, unseen), backproject(seen, GRID))
    settings = settings_of(facts_of(made), AtsSettings())
    assert settings.views_per_step == 24
    settled = fit(scans, GRID, settings, unseen=unseen).held_out
    few = fit(scans, GRID, replace(settings, views_per_step=12), unseen=unseen)
    assert settled < 0.8 * min(plain, few.held_out)


def test_a_dozen_views_a_step_are_enough_where_the_steps_see_each_ten_times() -> None:
    plain = FitSettings()
    assert [plain.seeing_all(n).views_per_step for n in (12, 36, 120, 121, 360)] == [12, 12, 12, 13, 36]
    assert replace(plain, steps=400).seeing_all(360).views_per_step == 12
    assert replace(plain, steps=5).seeing_all(60).views_per_step == 60
    assert replace(plain, views_per_step=48).seeing_all(360).views_per_step == 48


@pytest.mark.parametrize(("scene", "views", "share"), [(rough, 24, 0.8), (two_cans, 12, 0.6)])
def test_few_views_of_an_extended_scene_show_more_than_sparse_pixels_do(
    scene: Callable[[int], BasebandScans], views: int, share: float
) -> None:
    """A view that is left out is predicted by nothing, but views in between show which image is right."""
    scans, between = scene(views), scene(180)
    image = fit_adapted(scans, GRID, AtsSettings()).image
    assert image.settings["prior"] == "coupled"
    np.testing.assert_array_equal(image.values, coupled_recovery(scans, GRID).values)
    remaining = residual(between, image)
    assert remaining < share * residual(between, sparse_recovery(scans, GRID))
    assert remaining < share * residual(between, backproject(scans, GRID))


def test_a_prior_given_by_hand_is_not_changed() -> None:
    scans = rough(24)
    for settings in (AtsSettings(steps=5, prior="default"), AtsSettings(steps=5, prior="sparse")):
        assert "prior" not in fit_adapted(scans, GRID, settings).image.settings


def test_a_shared_first_image_changes_nothing() -> None:
    scans, unseen = rough(36), np.array([3, 17, 30])
    images = FirstImages()
    fit(scans, GRID, QUICK, unseen=unseen, images=images)
    dense = replace(QUICK, prior="dense")
    shared = fit(scans, GRID, dense, unseen=unseen, images=images).image
    np.testing.assert_array_equal(shared.values, fit(scans, GRID, dense, unseen=unseen).image.values)
    others = fit(scans, GRID, dense, unseen=unseen + 1, images=images).image
    np.testing.assert_array_equal(others.values, fit(scans, GRID, dense, unseen=unseen + 1).image.values)


def test_a_dense_outline_is_drawn_by_default_and_its_axis_stays() -> None:
    """A rough surface of about 4 wavelengths radius: no part of it is a point model's."""
    t = np.arange(180) * 2 * np.pi / 180
    place = 0.3 * (1 + 0.16 * np.cos(2 * t + 0.4) + 0.09 * np.cos(3 * t + 2)) * np.exp(1j * t)
    normal = -1j * np.gradient(np.concatenate([place[-2:], place, place[:2]]))[2:-2]
    rng = np.random.default_rng(8)
    surface = rng.standard_normal(180) + 1j * rng.standard_normal(180)
    points, normals = (np.column_stack([z.real, z.imag]) for z in (place, normal))
    capture = facing(points, normals, surface, 120)
    noise = 0.02 * np.abs(capture.samples).max() * rng.standard_normal(capture.samples.shape)
    noisy = replace(capture, samples=(capture.samples.real + noise).astype(np.float32))
    result = reconstruct(noisy, ImagingSettings(extent_m=0.95, free_pixels=True))
    settings = result.image.settings
    assert result.method == "ats"
    assert settings["axis_distance_m"] == pytest.approx(1.0, abs=0.0759 / 8)
    power = np.abs(result.image.values.ravel()) ** 2
    distance = np.linalg.norm(result.image.grid.points[:, None] - points, axis=2)
    # A bright pixel within half a wavelength, and the energy within one.
    assert (distance[power > power.max() * 10**-2.5] < 0.038).any(axis=0).mean() > 0.8
    assert power[distance.min(axis=1) < 0.0759].sum() > 0.8 * power.sum()
    assert settings["held_out"]["residual"] < settings["held_out"]["backprojection"]
    assert COUPLED_PIXELS in learned_words(result)
    assert method_shown(result) == "ATS, coupled pixels"
