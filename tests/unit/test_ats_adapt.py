"""The prior follows the data: other priors are tried where unseen views ask for them, and nowhere else."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.geometry import ImageGrid
from tagid.imaging.ats import adapt, problem
from tagid.imaging.ats.adapt import (
    BACKPROJECTIONS,
    LINEAR,
    SHADED,
    fit_adapted,
    folds,
    image_without_field,
    settings_of,
)
from tagid.imaging.ats.fit import fit, sparsity_weight
from tagid.imaging.ats.problem import FirstImages
from tagid.imaging.ats.settings import AtsSettings, FieldPrior, FitSettings, Prior
from tagid.imaging.heldout import Prediction, left_out, residual
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import select_views
from tagid.imaging.sparse import column_norm, sparse_recovery
from tagid.imaging.types import BasebandScans
from tagid.operate.words import prior_words
from tagid.pipeline.reconstruct import reconstruct
from tagid.pipeline.settings import ImagingSettings
from tests.unit.imaging_scenes import record, scans_from, turn

GRID = ImageGrid(0.3, 40)
QUICK = AtsSettings(steps=40)


def facing(points: np.ndarray, normals: np.ndarray, phases: np.ndarray, views: int) -> Capture:
    """A turn of scatterers, each seen only where its side faces the antenna."""
    normals = normals / np.linalg.norm(normals, axis=1)[:, None]
    aperture = turn(views)
    rows = []
    for view in range(views):
        sight = aperture.positions[view, :2] - points
        cosine = (sight * normals).sum(axis=1) / np.linalg.norm(sight, axis=1)
        single = aperture.select(np.array([view]))
        seen = phases * np.maximum(cosine, 0)
        rows.append(record(points, seen, single, start_m=0.4, analytic=True).samples)
    whole = record(points, phases, aperture, start_m=0.4, analytic=True)
    return replace(whole, samples=np.vstack(rows))


def faced(points: np.ndarray, normals: np.ndarray, phases: np.ndarray, views: int) -> BasebandScans:
    """Its scans."""
    return scans_from(facing(points, normals, phases, views), GRID.extent)


@cache
def rough(views: int) -> BasebandScans:
    """Scans of an ellipse of 64 scatterers of random phase, each seen only where it faces the antenna."""
    phases = np.exp(2j * np.pi * np.random.default_rng(4).random(64))
    t = np.arange(64) * 2 * np.pi / 64
    points = np.column_stack([0.11 * np.cos(t), 0.07 * np.sin(t)])
    return faced(points, np.column_stack([np.cos(t) / 0.11, np.sin(t) / 0.07]), phases, views)


@pytest.fixture
def left_out_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Priors are chosen by views that are left out, however few there are."""
    monkeypatch.setattr(adapt, "FEW_VIEWS", 0)


@cache
def quick_facts() -> dict[str, Any]:
    """Of the image of 36 rough views, whose prior is chosen as by `left_out_in_turn`."""
    return fit_adapted(rough(36), GRID, QUICK).image.settings


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


@pytest.mark.usefixtures("left_out_in_turn")
def test_sparse_pixels_make_the_image_where_they_predict_more_than_a_field() -> None:
    scans = two_cans(18)
    image = fit_adapted(scans, GRID, AtsSettings()).image
    tried = image.settings["prior_trials"]
    assert image.settings["prior"] == Prior.PIXELS
    assert tried[Prior.PIXELS] == min(tried.values())
    np.testing.assert_array_equal(image.values, image_without_field(scans, GRID, Prior.PIXELS).values)
    unseen = left_out(18)
    seen = select_views(scans, np.setdiff1d(np.arange(18), unseen))
    remaining = residual(select_views(scans, unseen), image_without_field(seen, GRID, Prior.PIXELS))
    assert remaining < fit(scans, GRID, AtsSettings(), unseen=unseen).held_out
    # Its amplitudes are not those that the sparsity prior shrank.
    shrunk = sparse_recovery(scans, GRID).values
    ratio = image.values[shrunk != 0] / shrunk[shrunk != 0]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-5)
    assert 1 < abs(ratio[0]) <= 2
    assert "sparse solution without a field" in prior_words(image.settings)[0]


@pytest.mark.parametrize("views", [12, 36])
def test_points_keep_the_default_prior_without_a_trial_and_all_views_are_fitted(views: int) -> None:
    scans = scans_from(
        record([[0.07, 0.03], [-0.06, 0.01], [0.01, -0.08]], [1, 1, 1], turn(views), noise=0.1), GRID.extent
    )
    image = fit_adapted(scans, GRID, AtsSettings()).image
    assert "prior" not in image.settings
    np.testing.assert_array_equal(image.values, fit(scans, GRID, AtsSettings()).image.values)


def test_a_prior_and_the_defaults_are_compared_on_the_views_that_both_were_tried_on() -> None:
    rng = np.random.default_rng(3)
    measured = rng.standard_normal((8, 5)) + 1j * rng.standard_normal((8, 5))
    seen = measured + np.linspace(0, 2, 8)[:, None] * rng.standard_normal((8, 5))
    every = Prediction.of(measured, seen)
    assert every.first(3).residual == pytest.approx(Prediction.of(measured[:3], seen[:3]).residual)
    settings = {"prior": "linear 2", "prior_trials": {"linear 2": 0.84, "default": 0.78}}
    settings["prior_against_default"] = {"residual": 0.55, "default": 0.78, "views": 4}
    assert "of the first 4 of them 55.0 %, the default prior 78.0 %" in prior_words(settings)[0]
    settings["prior_against_default"] = {"residual": 0.84, "default": 0.78, "views": 8}
    assert "of the first" not in prior_words(settings)[0]
    kept = {"prior": "default", "prior_trials": {"default": 0.2, "pixels": 0.1, "linear 0": 0.4}}
    assert "less than 1 of 2 others" in prior_words(kept)[0]


@pytest.mark.usefixtures("left_out_in_turn")
def test_an_outline_seen_from_its_side_gets_a_prior_that_predicts_better_than_backprojection() -> None:
    scans = rough(60)
    settings = fit_adapted(scans, GRID, AtsSettings()).image.settings
    tried, chosen = settings["prior_trials"], settings["prior"]
    assert {"default", "linear 0", *LINEAR} <= set(tried)
    assert tried[chosen] == min(tried.values()) or chosen == "default"
    field = Prior(chosen).field
    shaded = [name for name in SHADED if name in tried]
    assert set(shaded) <= set(SHADED) and all(SHADED[name] in tried for name in shaded)
    for name, value in asdict(field).items():
        assert settings[name] == value
    # On views that took no part in the choice, as the image is judged in the end.
    unseen = left_out(60)
    mine = fit(scans, GRID, FitSettings().with_prior(Prior(chosen)), unseen=unseen).held_out
    seen = np.setdiff1d(np.arange(60), unseen)
    plain = image_without_field(select_views(scans, seen), GRID, Prior.LINEAR_1)
    assert mine < 0.3 * residual(select_views(scans, unseen), plain)


def test_every_view_takes_part_often_enough_for_a_scene_whose_views_differ() -> None:
    """Of a dozen views a step the flashes of flat sides pull the field to and fro until the steps end."""
    scans = flat_sides(240)
    made = fit_adapted(scans, GRID, AtsSettings()).image.settings
    assert made["views_per_step"] == 24
    unseen = left_out(240)
    part = select_views(scans, np.setdiff1d(np.arange(240), unseen))
    test = select_views(scans, unseen)
    plain = min(residual(test, image_without_field(part, GRID, name)) for name in BACKPROJECTIONS)
    settings = settings_of(made, AtsSettings())
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


def test_few_views_of_an_outline_show_it_at_least_as_well_as_sparse_pixels_do() -> None:
    """A view that is left out is predicted by nothing, but views in between show which image is right."""
    scans, between = rough(18), rough(180)
    image = fit_adapted(scans, GRID, AtsSettings()).image
    assert image.settings["prior"] == Prior.MEAN and "prior_trials" not in image.settings
    assert prior_words(image.settings) == []
    remaining = residual(between, image)
    assert remaining < residual(between, image_without_field(scans, GRID, Prior.PIXELS)) - 0.02
    assert remaining < residual(between, image_without_field(scans, GRID, Prior.LINEAR_0)) - 0.03


def test_few_views_are_shown_hardly_worse_than_by_the_better_of_dense_field_and_pixels() -> None:
    scans, between = two_cans(12), two_cans(180)
    remaining = residual(between, fit_adapted(scans, GRID, AtsSettings()).image)
    dense = fit(scans, GRID, FitSettings().with_prior(Prior.DENSE)).image
    pixels = residual(between, image_without_field(scans, GRID, Prior.PIXELS))
    assert remaining < min(pixels, residual(between, dense)) + 0.02


def test_a_prior_given_by_hand_is_not_changed() -> None:
    scans = rough(24)
    for settings in (AtsSettings(steps=5, prior="default"), AtsSettings(steps=5, prior="sparse")):
        assert "prior" not in fit_adapted(scans, GRID, settings).image.settings


@pytest.mark.parametrize("views", [8, 11, 33, 110, 330])
def test_groups_of_views_do_not_overlap_and_are_spread(views: int) -> None:
    groups = folds(views)
    together = np.concatenate(groups)
    assert len(np.unique(together)) == len(together) >= min(4, views - 2)
    for group in groups:
        assert len(group) <= max(2, views / 8)
        assert np.diff(group).max(initial=0) <= 1.6 * views / len(group)


def test_unrelated_predictions_of_several_groups_explain_nothing() -> None:
    """One complex factor for all groups: with one of its own each would seem to explain a part."""
    rng = np.random.default_rng(2)
    noise = rng.standard_normal((2, 2, 40, 1, 12))
    data, seen = noise[0] + 1j * noise[1]
    together, apart = Prediction.none(), 0.0
    for measured, predicted in zip(data, seen, strict=True):
        prediction = Prediction.of(measured, predicted)
        together, apart = together.and_of(prediction), apart + float(prediction.misfits.sum())
    assert together.residual > 0.99
    assert apart / float(together.measured.sum()) < 0.95


@pytest.mark.usefixtures("left_out_in_turn")
def test_a_field_is_tried_once_where_noise_sets_two_priors_alike() -> None:
    scans = rough(24)
    peak = float(np.abs(ForwardOperator(scans, GRID).adjoint(scans.samples)).max())
    loud = replace(scans, noise_std=0.2 * peak / column_norm(scans))
    weights = [sparsity_weight(loud, peak, p) for p in (FieldPrior(), Prior.SPARSE.field)]
    assert weights[0] == weights[1]
    tried = fit_adapted(loud, GRID, QUICK).image.settings
    assert "sparse" not in tried.get("prior_trials", {})


@pytest.mark.usefixtures("left_out_in_turn")
def test_the_views_of_the_last_judgement_take_no_part_in_the_choice() -> None:
    """Whatever they hold, the same prior is chosen."""
    scans = rough(36)
    wild = scans.samples.copy()
    wild[left_out(36)] *= -3j
    tried = fit_adapted(replace(scans, samples=wild), GRID, QUICK).image.settings["prior_trials"]
    assert tried == quick_facts()["prior_trials"]


@pytest.mark.usefixtures("left_out_in_turn")
def test_priors_that_are_compared_on_the_same_views_share_their_first_image(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The sparse solution is up to half of a fit and does not depend on the prior."""
    made: list[int] = []
    plain = problem.first_image

    def counted(scans: BasebandScans, *rest: object) -> object:
        made.append(scans.aperture.views)
        return plain(scans, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(problem, "first_image", counted)
    scans = rough(60)
    settings = fit_adapted(scans, GRID, QUICK).image.settings
    fields = [name for name in settings["prior_trials"] if Prior(name).field]
    assert len(fields) > 2
    # One for the image, whatever its prior, and one for each group of unseen views.
    groups = folds(60 - len(left_out(60)))
    assert len(made) <= 1 + len(groups)


def test_a_shared_first_image_changes_nothing() -> None:
    scans, unseen = rough(36), np.array([3, 17, 30])
    images = FirstImages()
    fit(scans, GRID, QUICK, unseen=unseen, images=images)
    dense = FitSettings.of(QUICK).with_prior(Prior.DENSE)
    shared = fit(scans, GRID, dense, unseen=unseen, images=images).image
    np.testing.assert_array_equal(shared.values, fit(scans, GRID, dense, unseen=unseen).image.values)
    others = fit(scans, GRID, dense, unseen=unseen + 1, images=images).image
    np.testing.assert_array_equal(others.values, fit(scans, GRID, dense, unseen=unseen + 1).image.values)


@pytest.mark.usefixtures("left_out_in_turn")
def test_of_a_large_image_some_priors_are_left_out_and_the_result_says_which(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    every = quick_facts()
    assert "priors_not_tried" not in every
    assert "not tried" not in "".join(prior_words(every))
    monkeypatch.setattr(adapt, "LARGE_PAIRS", 36 * GRID.pixels**2 // 2)
    image = fit_adapted(rough(36), GRID, QUICK).image.settings
    skipped, tried = image["priors_not_tried"], image["prior_trials"]
    assert set(skipped) | set(tried) == set(every["prior_trials"])
    assert not set(skipped) & set(tried)
    better = min(("default", "dense"), key=tried.__getitem__)
    aspect = {"default": "aspect", "dense": "dense, aspect"}
    assert aspect[better] in tried
    assert [name for name in skipped if Prior(name).field and name not in SHADED] == [
        name for prior, name in aspect.items() if prior != better
    ]
    # Of the linear solution the highest numbers of iterations.
    assert "linear 1" in tried
    assert LINEAR[-len([name for name in LINEAR if name in skipped]) :] == [n for n in LINEAR if n in skipped]
    assert all(name in prior_words(image)[0] for name in skipped)


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
