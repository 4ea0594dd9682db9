"""What turns with the object but lies outside the image is fitted there, not along the image's edge; and the
figures beside the held-out residual: what neighbouring scans predict without any image, and noise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tagid.geometry import Aperture, ImageGrid
from tagid.imaging import outside
from tagid.imaging.heldout import left_out, neighbours_residual
from tagid.imaging.kernel import RangeGeometry
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.outside import find_outside
from tagid.imaging.preprocess import PreprocessSettings, preprocess, select_views
from tagid.imaging.types import BasebandScans, PointResponse
from tagid.operate.words import held_out_words, outside_words
from tagid.pipeline.reconstruct import reconstruct
from tagid.pipeline.settings import ImagingSettings
from tests.unit.imaging_scenes import record, scans_from, turn

INSIDE = [[0.05, 0.02], [-0.08, 0.06]]
GRID = ImageGrid(0.4, 64)
ALONE = record(INSIDE, [1, 0.8], turn(48), noise=0.05, bins=180)
BESIDE = record([*INSIDE, [0.33, 0.05]], [1, 0.8, 3], turn(48), noise=0.05, bins=180)
"""Both alone, and beside a strong reflector outside."""


def share_at_the_edge(values: np.ndarray) -> float:
    """Energy of the image within four pixels of its edge, over all of it."""
    power = np.abs(values) ** 2
    return float(1 - power[4:-4, 4:-4].sum() / power.sum())


@pytest.mark.parametrize(("method", "place"), [("sparse", [0.27, 0.25]), ("ats", [0.33, 0.05])])
def test_a_strong_reflector_outside_leaves_the_edge_dark(method: str, place: list[float]) -> None:
    capture = record([*INSIDE, place], [1, 0.8, 3], turn(48), noise=0.05, bins=180)
    image = reconstruct(capture, ImagingSettings(method, 0.4, 64, focus_m=0.0, restore=False)).image
    assert share_at_the_edge(image.values) < 0.01
    assert image.settings["outside"]["share"] > 0.5
    assert image.settings["held_out"]["residual"] < 0.3
    brightest = GRID.points[np.argsort(-np.abs(image.values).ravel())[:4]]
    assert np.hypot(*(brightest[:, None] - np.array(INSIDE)).T).min(axis=0).max() < 0.02


def test_the_place_and_strength_outside_are_found() -> None:
    result = find_outside(scans_from(BESIDE, 0.4), GRID)
    assert np.hypot(*(result.points - [0.33, 0.05]).T).max() < 0.015
    assert abs(result.amplitudes.sum()) == pytest.approx(3, rel=0.15)


@pytest.mark.parametrize("views", [12, 120])
def test_sidelobes_of_the_inside_are_no_reflector_outside(views: int) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        points, amplitudes = rng.uniform(-0.15, 0.15, (8, 2)), rng.uniform(0.3, 1, 8)
        capture = record(points, amplitudes, turn(views), noise=0.1, seed=seed)
        scans = preprocess(capture, settings=PreprocessSettings("mean", False, extent_m=0.4))
        assert find_outside(scans, GRID) is None


@pytest.mark.parametrize("method", ["bp", "range-doppler"])
def test_methods_without_a_fit_say_that_echoes_lie_outside(method: str) -> None:
    settings = ImagingSettings(method=method, extent_m=0.4, pixels=64, focus_m=0.0)
    result = reconstruct(BESIDE, settings).image.settings
    assert result["outside"]["share"] > 0.5 and not result["outside"]["subtracted"]
    (words,) = outside_words(result)
    assert "outside the image; use a larger `imaging.extent_m`" in words
    assert "outside" not in reconstruct(ALONE, settings).image.settings


def short_wave_scans(views: int) -> BasebandScans:
    """Two reflectors inside and a strong one outside an image of 0.4 m, wavelength 4 mm, noise-free."""
    points = np.array([*INSIDE, [0.33, 0.05]])
    response = PointResponse(np.exp(-((np.arange(-64, 65) * 0.002 / 0.03) ** 2)) + 0j, 0.002)
    empty = np.zeros((views, 40), dtype=np.complex64)
    known = {"independent_samples": 0.5 * empty.size, "noise_std": 1e-3}
    scans = BasebandScans(empty, 0.6, 0.02, 75e9, response, turn(views), **known)
    amplitudes = np.array([1, 0.8, 3], dtype=np.complex64)
    return replace(scans, samples=ForwardOperator(scans, points).forward(amplitudes))


@pytest.fixture
def pairs(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Of views and points, as the kernel visits them."""
    visited: list[int] = []
    gather = RangeGeometry.gather

    def counted(self: RangeGeometry, *args: Any) -> Any:
        visited.append(self.views * self.points)
        return gather(self, *args)

    monkeypatch.setattr(RangeGeometry, "gather", counted)
    return visited


def test_the_search_is_bounded_at_short_wavelengths(pairs: list[int]) -> None:
    reports: list[tuple[int, int]] = []
    scans = short_wave_scans(60)
    result = find_outside(scans, ImageGrid(0.4, 128), lambda done, of: reports.append((done, of)))
    assert np.hypot(*(result.points - [0.33, 0.05]).T).max() < 0.01
    assert result.share > 0.5
    # A single look at every pixel of the square of 1.2 m that the wavelength asks for takes more.
    assert sum(pairs) < 60 * (1.2 / 0.00047) ** 2 / 2
    assert reports and all(0 < done <= of for done, of in reports)


@pytest.mark.parametrize("extent", [30.0, 100.0])
def test_a_large_image_is_not_searched_for_longer_and_never_refused(extent: float, pairs: list[int]) -> None:
    """A flight: its cells outside the image are more than a grid may have, or than every view can visit."""
    flight = Aperture(extent * np.stack([np.linspace(-1, 1, 400), np.full(400, -1), np.full(400, 1)], axis=1))
    capture = record([[0.0, 0.0]], [1.0], flight, start_m=1.4 * extent, bins=300, noise=0.05)
    scans = scans_from(capture, extent)
    find_outside(scans, ImageGrid(extent, 64))
    assert sum(pairs) < 3e8


def test_the_search_has_a_switch() -> None:
    settings = ImagingSettings(method="sparse", extent_m=0.4, pixels=64, focus_m=0.0, held_out=False)
    assert "outside" in reconstruct(BESIDE, settings).image.settings
    image = reconstruct(BESIDE, replace(settings, outside=False))
    assert "outside" not in image.image.settings and "outside" not in image.seconds


def test_a_fit_whose_search_would_take_longer_than_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outside, "_LEAST_WORK", dict.fromkeys((True, False), 0.0))
    monkeypatch.setattr(outside, "_IMAGE_PASSES", dict.fromkeys((True, False), 1))
    for method, warned in (("sparse", True), ("bp", False)):
        settings = ImagingSettings(method, extent_m=0.4, pixels=64, focus_m=0.0, held_out=False)
        warnings = reconstruct(ALONE, settings).image.settings.get("warnings", ())
        assert (outside.NOT_SEARCHED in warnings) is warned


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
    old = {"residual": 0.2, "backprojection": 0.2, "noise": None, "views": 3}
    old["worse_than_backprojection"] = False
    assert held_out_words({"held_out": old}) == ["held-out residual 20.0 % of 3 held-out views"]


def test_pure_noise_is_called_noise() -> None:
    capture = record([(0.1, 0.05)], [1e-4], turn(36), noise=1.0, bins=300)
    held_out = reconstruct(capture, replace(SMALL, method="bp")).image.settings["held_out"]
    assert len(left_out(36)) == held_out["views"]
    assert held_out["noise"] > 0.7
    assert not any("far apart" in line for line in held_out_words({"held_out": held_out}))
