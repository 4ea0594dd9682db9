"""The fit of analysis through synthesis on simulated points: better than backprojection, and repeatable."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tagid.errors import UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.ats.fit import fit
from tagid.imaging.ats.problem import FieldShape, draw_weights
from tagid.imaging.ats.settings import AtsSettings, FitSettings, parse_settings
from tagid.imaging.backprojection import backproject
from tagid.imaging.heldout import check
from tagid.imaging.restore import restore
from tagid.imaging.sparse import sparse_recovery
from tagid.imaging.types import BasebandScans, Image
from tests.unit.imaging_scenes import record, scans_from, turn
from train.metrics import localise, pick_peaks, psnr, truth_image

GRID = ImageGrid(0.5, 64)
POINTS = np.array([[0.10, -0.05], [-0.07, 0.12]])


def simulate(points: np.ndarray, views: int, noise: float) -> BasebandScans:
    """Scans of unit points, complex noise of the given standard deviation a raw sample."""
    capture = record(points, np.ones(len(points)), turn(views), bins=142, noise=noise, seed=5, analytic=True)
    return scans_from(capture, GRID.extent)


def quality_db(image: Image) -> float:
    return psnr(image.values, truth_image(POINTS, GRID))


def test_two_points_at_36_views_beat_backprojection() -> None:
    scans = simulate(POINTS, 36, 0.3)
    image = fit(scans, GRID).image
    assert quality_db(image) > quality_db(backproject(scans, GRID)) + 6
    assert localise(pick_peaks(image, 2, 0.04), POINTS, GRID.step).detected == 2
    assert image.values.dtype == np.complex64
    assert image.settings["method"] == "ats"
    assert image.settings["seed"] == 0


def test_many_views_are_used_in_subsets() -> None:
    scans = simulate(POINTS, 144, 1.0)
    image = restore(fit(scans, GRID, FitSettings(views_per_step=36)).image, scans.wavenumber)
    assert quality_db(image) > quality_db(backproject(scans, GRID)) + 8


def test_the_first_image_is_what_the_field_shows() -> None:
    shape = FieldShape((8, 16, 64), features=2, width=8)
    axis = np.linspace(-0.25, 0.25, 65)
    first = np.exp(-((axis - 0.1) ** 2 + (axis[:, None] + 0.05) ** 2) / 2e-3) * 0.3j
    field = draw_weights(shape, GRID, 2.0, seed=1, first=first)
    places = [np.hypot(*(GRID.points - at).T).argmin() for at in ([0.1, -0.05], [-0.15, 0.15])]
    np.testing.assert_allclose(field.image().ravel()[places], [0.6j, 0], atol=0.06)


def test_a_single_point_of_a_full_turn_is_no_ring() -> None:
    """The four points that surround it explain its echoes nearly as well: a local minimum of the loss."""
    for seed, point in enumerate(([0.041, 0.095], [0.095, 0.192], [-0.12, 0.03])):
        truth = np.array([point])
        result = fit(simulate(truth, 360, 0.0), GRID, AtsSettings(seed=seed))
        assert np.linalg.norm(pick_peaks(result.image, 1) - truth) < GRID.step
        far = np.linalg.norm(GRID.points - truth, axis=1) > 0.016
        assert np.abs(result.image.values).ravel()[far].max() < 0.1 * np.abs(result.image.values).max()


def test_scaling_the_data_scales_the_image_and_another_seed_changes_it() -> None:
    scans = simulate(POINTS, 18, 0.1)
    louder = replace(scans, samples=scans.samples * np.float32(1024))
    short = AtsSettings(steps=20)
    first, thousand = fit(scans, GRID, short).image.values, fit(louder, GRID, short).image.values
    np.testing.assert_allclose(thousand / 1024, first, atol=1e-3 * np.abs(first).max())
    assert not np.array_equal(first, fit(scans, GRID, AtsSettings(steps=20, seed=1)).image.values)


def test_zero_data_gives_a_zero_image() -> None:
    scans = simulate(POINTS, 18, 0.0)
    dark = replace(scans, samples=np.zeros_like(scans.samples))
    image = fit(dark, GRID).image
    assert not image.values.any()
    assert image.settings["steps_done"] == 0


def test_a_silent_subset_of_views_does_no_harm() -> None:
    scans = simulate(POINTS, 72, 0.1)
    samples = scans.samples.copy()
    samples[1::2] = 0
    image = fit(replace(scans, samples=samples), GRID, AtsSettings(steps=20)).image
    assert np.isfinite(image.values).all()


def test_progress_is_told_every_step() -> None:
    reported: list[tuple[int, int, float]] = []
    fit(simulate(POINTS, 12, 0.1), GRID, AtsSettings(steps=7), lambda *step: reported.append(step))
    assert [step[:2] for step in reported] == [(i, 7) for i in range(1, 8)]
    assert reported[-1][2] < reported[0][2]


def test_few_views_get_more_steps_unless_the_number_is_given() -> None:
    small = ImageGrid(0.5, 8)
    took = [len(fit(simulate(POINTS, views, 0.1), small).losses) for views in (12, 18)]
    assert took == [150, 100]
    assert len(fit(simulate(POINTS, 12, 0.1), small, AtsSettings(steps=7)).losses) == 7


@pytest.mark.parametrize(
    "wrong",
    [
        {"steps": -1}, {"robust": float("nan")}, {"spreading": -1.0}, {"prior": "coupled"}, {"engine": "x"},
        {"calibrate": ("x",)},
    ],
)  # fmt: skip
def test_senseless_settings_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError) as caught:
        AtsSettings(**wrong)
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("word", "remedy"), [("l1=0.1", "prior=sparse"), ("levels=8", "8"), ("smoothness=1", "prior=dense")]
)
def test_a_setting_that_is_gone_says_what_takes_its_place(word: str, remedy: str) -> None:
    with pytest.raises(UsageError, match=f"no longer has the setting {word.partition('=')[0]}") as caught:
        parse_settings([word])
    assert remedy in caught.value.remedy


def test_no_trials_are_asked_for_as_before() -> None:
    assert parse_settings(["adapt=0,steps=9"]) == {"prior": "default", "steps": 9}
    assert AtsSettings(**parse_settings(["adapt=1"])) == AtsSettings()


def test_a_dozen_views_of_reflectors_are_predicted_better_than_by_fista() -> None:
    # From backprojection the fits kept sidelobes, and left twice as much as FISTA.
    remaining = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        points = rng.uniform(-0.22, 0.22, (4, 2))
        amplitudes = rng.uniform(0.5, 1, 4) * np.exp(2j * np.pi * rng.random(4))
        scans = scans_from(record(points, amplitudes, turn(12), noise=0.1, seed=seed, analytic=True), 0.7)
        grid = ImageGrid(0.7, 96)
        sparse = check(scans, scans, grid, lambda some, grid=grid: sparse_recovery(some, grid))
        ats = check(scans, scans, grid, lambda some, grid=grid: fit(some, grid).image)
        remaining.append((ats["residual"], sparse["residual"]))
    ours, theirs = np.sum(remaining, axis=0)
    assert ours < theirs
