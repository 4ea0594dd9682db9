"""The figures beside the held-out residual: what neighbouring scans predict without any image, and noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tagid.geometry import Aperture
from tagid.imaging.heldout import left_out, neighbours_residual
from tagid.imaging.preprocess import preprocess, select_views
from tagid.operate.words import held_out_words
from tagid.pipeline.reconstruct import reconstruct
from tagid.pipeline.settings import ImagingSettings
from tests.unit.imaging_scenes import record, turn

SMOOTH = "no better than smoothness over angle"
SMALL = ImagingSettings("sparse", 0.5, 64, focus_m=0.0)


@pytest.mark.parametrize(
    "aperture", [turn(24), Aperture(np.c_[np.linspace(-1, 1, 24), np.full((24, 2), 1.0)])]
)
def test_neighbours_are_the_positions_on_both_sides_of_a_view(aperture: Aperture) -> None:
    """Whatever the order of the views; the last view of a turn is beside the first, that of a path is not."""
    scans = preprocess(record([(0.1, 0.05)], [1.0], aperture, noise=0.01))
    unseen = np.array([0, 7, 15])
    z = scans.samples.astype(complex)
    first = (z[1] + z[-1]) / 2 if aperture.angles is not None else z[1]
    predicted = np.stack([first, (z[6] + z[8]) / 2, (z[14] + z[16]) / 2])
    factor = np.vdot(predicted, z[unseen]) / np.vdot(predicted, predicted)
    expected = np.linalg.norm(z[unseen] - factor * predicted) ** 2 / np.linalg.norm(z[unseen]) ** 2
    assert neighbours_residual(scans, unseen) == pytest.approx(expected, rel=1e-5)
    order = np.random.default_rng(0).permutation(24)
    shuffled = select_views(scans, order)
    assert neighbours_residual(shuffled, np.argsort(order)[unseen]) == pytest.approx(expected, rel=1e-5)


def test_views_beside_each_other_are_predicted_by_views_that_stay() -> None:
    scans = preprocess(record([(0.1, 0.05)], [1.0], turn(24)))
    assert neighbours_residual(scans, np.array([4, 5])) > 0
    assert np.isnan(neighbours_residual(scans, np.arange(24)))


def test_an_image_of_dense_views_with_wrong_angles_is_called_no_better_than_smoothness() -> None:
    """Halved angles: smooth scans, and the picture is wrong."""
    right = record([(0.02, 0.01), (-0.03, 0.0)], [1.0, 0.8], turn(180), noise=0.01)
    assert right.angles_rad is not None
    wrong = reconstruct(replace(right, angles_rad=right.angles_rad / 2), SMALL).image.settings
    assert wrong["held_out"]["neighbours"] < 0.1 * wrong["held_out"]["residual"]
    assert wrong["held_out"]["worse_than_neighbours"]
    said = held_out_words(wrong)
    assert f"neighbouring scans {100 * wrong['held_out']['neighbours']:.1f} %" in said[0]
    assert SMOOTH in said[1]


def test_an_image_that_predicts_better_than_the_neighbours_is_not_warned_of() -> None:
    capture = record([(0.2, 0.01), (-0.15, 0.1)], [1.0, 0.8], turn(36), noise=0.01)
    held_out = reconstruct(capture, SMALL).image.settings["held_out"]
    assert held_out["residual"] < 0.1 < 0.5 < held_out["neighbours"]
    assert len(held_out_words({"held_out": held_out})) == 1


def test_views_too_far_apart_to_judge_an_image_say_so() -> None:
    """Few views of many points: no figure near 100 % stands alone."""
    points = np.random.default_rng(1).uniform(-0.2, 0.2, (60, 2))
    settings = reconstruct(record(points, np.ones(60), turn(18)), replace(SMALL, method="bp")).image.settings
    assert settings["held_out"]["residual"] > 0.9
    assert "views are far apart" in held_out_words(settings)[1]


def test_noise_that_exceeds_what_is_left_is_unknown() -> None:
    """Clutter before the object, as of a room about a rail, was taken for noise: 100 % beside 51 %."""
    capture = record([(0.1, 0.05)], [1.0], turn(36), bins=400, start_m=0.3)
    clutter = np.random.default_rng(1).standard_normal((36, 40)).astype(np.float32)
    samples = capture.samples.copy()
    samples[:, 5:45] += 5 * clutter
    settings = reconstruct(replace(capture, samples=samples), SMALL).image.settings
    assert settings["held_out"]["noise"] is None
    assert "noise" not in held_out_words(settings)[0]


def test_a_document_without_the_neighbours_is_shown_as_before() -> None:
    old = {
        "residual": 0.2,
        "backprojection": 0.2,
        "noise": None,
        "views": 3,
        "worse_than_backprojection": False,
    }
    assert held_out_words({"held_out": old}) == ["held-out residual 20.0 % of 3 held-out views"]


def test_pure_noise_is_called_noise() -> None:
    capture = record([(0.1, 0.05)], [1e-4], turn(36), noise=1.0, bins=300)
    held_out = reconstruct(capture, replace(SMALL, method="bp")).image.settings["held_out"]
    assert len(left_out(36)) == held_out["views"]
    assert held_out["noise"] > 0.7
    assert not any("far apart" in line for line in held_out_words({"held_out": held_out}))
